"""What the figures of the page show: seconds a box, decisions, builds and physics, each against what it costs."""

from collections.abc import Sequence
from collections.abc import Set as AbstractSet

from reporting.statistics import Estimate, wilson
from simulation.closed_loop.statistics import Row
from simulation.studies.pace.panels import Mark, Panel, Series, exact
from simulation.studies.pace.points import SHIPPED

FRONT = "on the front"
FAMILIES = FRONT, "beaten", "not for every cell"
EARLY = ("test, 0.6", "test, 0.8")  # from how sure on a decision might be made at once


def figures(data: Row, front: AbstractSet[str]) -> list[Panel]:
    """All panels of the page, from its data and the names of the choices on the front."""
    kept = data["kept"]
    return [*_boxes(data, front), _pressing(data), _networks(kept), _builds(kept), _transfer(kept)]


def _family(point: Row, front: AbstractSet[str]) -> str:
    if point["needs"]:
        return FAMILIES[2]
    return FAMILIES[0] if point["name"] in front else FAMILIES[1]


def _boxes(data: Row, front: AbstractSet[str]) -> list[Panel]:
    count, points = data["insertions"], data["points"]

    def series(y: str) -> list[Series]:
        def mark(point: Row) -> Mark:
            share = wilson(point["inserted"], count)
            up = Estimate(*point["force_95_n"]) if y == "force" else _percent(share)
            short = point["name"].split(":")[0]
            return Mark(short, Estimate(*point["seconds_a_box"]), up, point["name"] == SHIPPED)

        def marks(family: str) -> list[Mark]:
            return [mark(point) for point in points if _family(point, front) == family]

        return [Series(name, marks(name), joined=name == FRONT and y == "force") for name in FAMILIES if marks(name)]

    seconds = "seconds a box"
    return [
        Panel("(a) force against time", seconds, "largest force of 95 % of boxes, N", series("force")),
        Panel("(a) success against time", seconds, "inserted, %", series("share"), y_from=94.0),
    ]


def _percent(right: Sequence[float]) -> Estimate:
    return Estimate(*(100 * value for value in right))


def _pressing(data: Row) -> Panel:
    """Direction over the time that pressing takes, and what deciding as soon as it is sure would give."""
    speed = next(p for p in data["points"] if p["name"] == SHIPPED)["client"]["ramps"]["descend"]["speed_mm_s"]
    kept, reads_mm = data["kept"], data["kept"]["reads_mm"]
    fixed = []
    for name, right in kept["depths"].items():
        depth = float(name.removeprefix("test, ").removesuffix(" mm"))
        fixed.append(Mark(f"{depth:g} mm", exact(depth / speed), _percent(right), depth == kept["press_mm"]))
    sure = [
        Mark(_how_sure(name), exact(reads_mm * (1 - row["saved"]) / speed), _percent(row["right"]))
        for name, row in kept["sure"].items()
        if name in EARLY
    ]
    title = "(b) pressing less, or deciding when sure"
    return Panel(
        title,
        f"seconds of pressing at {speed:g} mm/s",
        "direction right, %",
        [Series("always as deep", fixed, joined=True), Series("as soon as this sure", sure)],
        y_from=40.0,
    )


def _how_sure(name: str) -> str:
    return f"{float(name.removeprefix('test, ')):.0%} sure"


def _networks(kept: Row) -> Panel:
    def series(*, deep: bool) -> list[Mark]:
        return [
            Mark(row["name"], exact(row["cpu_ms"]), _percent(row["right"]), ships=row["name"] == "steps of depth")
            for row in kept["networks"]
            if row["deep"] == deep
        ]

    both = [Series("any cell", series(deep=True)), Series("gels as narrow as the object", series(deep=False))]
    return Panel("(c) networks, fp32", "CPU ms after the last frame", "direction right, %", both)


def _builds(kept: Row) -> Panel:
    marks = [
        Mark(row["name"], exact(row["cpu_ms"]), _percent(row["same"]), row["name"] == "fp32") for row in kept["builds"]
    ]
    return Panel(
        "(c) precisions, networks of pictures",
        "CPU ms a step",
        "same command as fp32, %",
        [Series("builds", marks)],
    )


def _transfer(kept: Row) -> Panel:
    """Networks of one tier each, tested in a physics that none of them was trained in."""

    def marks(presses: int) -> list[Mark]:
        return [
            Mark(row["name"], exact(row["cpu_ms"]), _percent(row["right"]))
            for row in kept["transfer"]
            if row["presses"] == presses
        ]

    counts = sorted({row["presses"] for row in kept["transfer"]})
    return Panel(
        "(d) training physics, tested in another",
        "CPU ms of collecting a press",
        "direction right, %",
        [Series(f"{count:,} presses", marks(count)) for count in counts],
        y_from=40.0,
    )
