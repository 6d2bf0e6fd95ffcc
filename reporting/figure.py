"""Figures of one style: colours for colour-blind readers, labels at the data, honest axes, same bytes."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from service.durable import write_durably

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PALETTE = (BLUE, ORANGE, GREEN, RED, "#CC79A7", "#56B4E9", "#F0E442", "#000000")
"""Okabe and Ito 2008."""
GREY = "#777777"
STYLE: dict[str, Any] = {
    "axes.grid": True,
    "axes.prop_cycle": f"cycler('color', {list(PALETTE)})",
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 10,
    "font.size": 9,
    "grid.alpha": 0.3,
    "legend.fontsize": 8,
}


@contextmanager
def drawing(
    path: Path, rows: int = 1, columns: int = 1, *, size: tuple[float, float] = (11, 4.5), dpi: int = 90, **panels: Any
) -> Iterator[NDArray[Any]]:
    """Yield panels [rows, columns]; on leaving, write them as PNG, durably and without date or version.

    ``size`` is in inches, ``panels`` goes to matplotlib's ``subplots``. A linear axis that does not begin at zero is
    marked, and so is a logarithmic one.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=size, dpi=dpi, layout="constrained")
        axes: NDArray[Any] = figure.subplots(rows, columns, squeeze=False, **panels)
        yield axes
        for panel in axes.flat:
            for axis in (panel.xaxis, panel.yaxis):
                _tell_scale(axis)
        stream = io.BytesIO()
        figure.savefig(stream, format="png", metadata={"Software": None})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_durably(path, stream.getvalue())


def _tell_scale(axis: Any) -> None:
    text = axis.get_label_text()
    if text and axis.get_scale() == "log":
        axis.set_label_text(f"{text} (log)")
    elif text and min(axis.get_view_interval()) > 0:
        axis.set_label_text(f"{text} (not from 0)")


def label(panel: Any, point: tuple[float, float], text: str, *, colour: str = "black") -> None:
    """Write a name above and beside its point."""
    panel.annotate(text, point, color=colour, fontsize=7, xytext=(4, 4), textcoords="offset points")
