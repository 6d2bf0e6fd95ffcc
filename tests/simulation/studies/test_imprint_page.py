"""The picture of docs/imprint.md is what the renderer draws today."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from simulation.__main__ import main

DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.slow
def test_the_published_imprints_are_drawn_by_the_command(tmp_path: Path) -> None:
    path = tmp_path / "imprint.png"
    assert main(["imprint", "--out", str(path)]) == 0
    drawn, published = cv2.imread(str(path)), cv2.imread(str(DOCS / "imprint.png"))
    assert drawn.shape == published.shape
    assert np.abs(drawn.astype(float) - published).mean() < 2.0
    text = " ".join((DOCS / "imprint.md").read_text().split())
    assert "imprint.png" in text
    assert "python -m simulation imprint" in text
