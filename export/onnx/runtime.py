"""ONNX Runtime sessions as the service opens them."""

from pathlib import Path
from typing import Any

import onnxruntime

from service.contract import ContractError


def session(file: Path, threads: int = 1) -> Any:
    """A CPU session with one intra-op thread; raise ContractError on a file that ONNX Runtime refuses."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    if not file.is_file():
        raise ContractError(f"no model at {file}")
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises its own pybind types for every kind of bad file
        raise ContractError(f"{file} is not a model this runtime can open: {str(error).splitlines()[0]}") from error
