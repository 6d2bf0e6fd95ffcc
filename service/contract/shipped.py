"""Locates the files that a release ships beside its code: in a checkout, or where the wheel puts its data."""

from pathlib import Path


def released_models() -> Path:
    """Folder of the released networks: in `models` here, else in the checkout's, else in the installed ones.

    Those that read depth lie in its folder `pressing`. If none holds an ONNX file the answer is `models`, so that an
    error names the folder a user would expect.
    """
    here = Path("models")
    checkout, *around = Path(__file__).parents[2:]
    # How far above the packages `share` lies depends on pip: an environment, a user's home, or a folder of its own.
    installed = [folder / "share" / "tactile-insertion" / "models" for folder in (checkout, *around)]
    folders = [folder for root in (here, checkout / "models", *installed) for folder in (root / "pressing", root)]
    return next((folder for folder in folders if any(folder.glob("*.onnx"))), here)
