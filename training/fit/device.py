"""The device that computes the steps of a run; calibration and figures are computed on the CPU, as a cell would."""

import torch

from service.contract import ContractError
from training.config import AnyRun


def on_device(config: AnyRun) -> torch.device:
    """The run's device, with its threads set. ContractError if there is none of that kind."""
    torch.set_num_threads(config.threads)
    if config.device == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise ContractError(f"device is cuda, but torch {torch.__version__} has no GPU here; expected cpu")
    return torch.device("cuda")
