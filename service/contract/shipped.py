"""Where the files lie that a release ships beside its code: in a checkout, or where the wheel puts its data."""

import sysconfig
from pathlib import Path


def released_models() -> Path:
    """Folder of the released networks: `models` here, else the checkout's, else the installed ones.

    Where none holds an ONNX file the answer is `models`, so that an error names the folder a user would expect.
    """
    here = Path("models")
    checkout = Path(__file__).parents[2] / "models"
    installed = Path(sysconfig.get_path("data")) / "share" / "tactile-insertion" / "models"
    return next((folder for folder in (here, checkout, installed) if any(folder.glob("*.onnx"))), here)
