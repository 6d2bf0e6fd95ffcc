"""The figures of the page, declared as data and drawn as one picture."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from reporting.figure import GREY, PALETTE, drawing
from reporting.statistics import Estimate

COLUMNS = 3
PANEL_IN = 4.4  # width of a panel, inches
SHAPES = "osD"  # of the marks of each family, for whoever sees no colours
OFFSETS = tuple((dx, dy) for dy in (6, -13, 17, -24, 28, -35) for dx in (5, -30, -60))
"""Where a name may stand, points from its mark: the first of those that cover least is taken."""


class Mark(NamedTuple):
    """A point with its name; an axis without an interval has a figure that is its own ends."""

    name: str
    x: Estimate
    y: Estimate
    ships: bool = False


class Series(NamedTuple):
    """Marks of one family; ``joined`` by a line."""

    name: str
    marks: Sequence[Mark]
    joined: bool = False


class Panel(NamedTuple):
    """One figure."""

    title: str
    x: str
    y: str
    series: Sequence[Series]
    y_from: float = 0.0


def exact(value: float) -> Estimate:
    """A figure without an interval."""
    return Estimate(value, value, value)


def _bars(estimates: Sequence[Estimate]) -> tuple[list[float], list[float]]:
    return [of.value - of.low for of in estimates], [of.high - of.value for of in estimates]


def draw(panels: Sequence[Panel], path: Path) -> None:
    """As PNG. What ships is a star, as the key says; both axes begin at zero, or say otherwise."""
    rows = -(-len(panels) // COLUMNS)
    with drawing(path, rows, COLUMNS, size=(PANEL_IN * COLUMNS, 3.6 * rows)) as axes:
        for axis, panel in zip(axes.flat, panels, strict=True):
            axis.set(xlabel=panel.x, ylabel=panel.y)
            axis.set_title(panel.title)
            for series, colour, shape in zip(panel.series, PALETTE, SHAPES, strict=False):
                _draw_series(axis, series, colour, shape)
            axis.legend(loc="lower left")
            axis.margins(0.15)
            axis.set_ylim(panel.y_from, None)
            axis.set_xlim(0, None)
        axes[0, 0].figure.draw_without_rendering()  # where a mark stands is known once the panels are laid out
        for axis, panel in zip(axes.flat, panels, strict=True):
            _name(axis, [mark for series in panel.series for mark in series.marks])


def _draw_series(axis: Any, series: Series, colour: str, shape: str) -> None:
    marks = sorted(series.marks, key=lambda mark: mark.x.value)
    x, y = [mark.x for mark in marks], [mark.y for mark in marks]
    at = [of.value for of in x], [of.value for of in y]
    style: dict[str, Any] = {
        "fmt": f"{shape}-" if series.joined else shape,
        "capsize": 2,
        "elinewidth": 0.8,
        "ecolor": GREY,
    }
    axis.errorbar(*at, xerr=_bars(x), yerr=_bars(y), color=colour, label=series.name, **style)
    ships = [mark for mark in marks if mark.ships]
    where = [mark.x.value for mark in ships], [mark.y.value for mark in ships]
    axis.plot(*where, "*", color=colour, markersize=13, label="what ships" if ships else None)


def _name(axis: Any, marks: Sequence[Mark]) -> None:
    """Write each name beside its mark where it covers least of other names, marks and bars, and stays in the panel."""
    taken = [box for mark in marks for box in _covered(axis, mark)]
    taken.append(axis.get_legend().get_window_extent())
    for mark in sorted(marks, key=lambda mark: -mark.y.value):
        at = mark.x.value, mark.y.value
        text = axis.annotate(mark.name, at, OFFSETS[0], fontsize=7, textcoords="offset points")
        text.set_in_layout(False)
        offset = min(OFFSETS, key=partial(_covers, axis, text, taken))
        text.set_position(offset)
        taken.append(text.get_window_extent().padded(3))
        line = {"arrowstyle": "-", "color": GREY, "linewidth": 0.4}
        axis.annotate("", at, offset, textcoords="offset points", arrowprops=line)


def _covers(axis: Any, text: Any, taken: Sequence[Any], offset: tuple[float, float]) -> int:
    """How many of the boxes a name would cover at an offset; outside of the panel it is worse than any."""
    text.set_position(offset)
    box = text.get_window_extent()
    inside = axis.bbox.x0 <= box.x0 and box.x1 <= axis.bbox.x1 and box.y1 <= axis.bbox.y1
    return sum(box.overlaps(other) for other in taken) if inside else len(taken) + 1


def _covered(axis: Any, mark: Mark) -> list[Any]:
    """Boxes, in pixels, of a mark and of its two bars."""
    from matplotlib.transforms import Bbox

    def box(x: tuple[float, float], y: tuple[float, float], room_px: float) -> Any:
        return Bbox(axis.transData.transform([(x[0], y[0]), (x[1], y[1])])).padded(room_px)

    x, y = (mark.x.value, mark.x.value), (mark.y.value, mark.y.value)
    return [box(x, y, 5), box((mark.x.low, mark.x.high), y, 2), box(x, (mark.y.low, mark.y.high), 2)]
