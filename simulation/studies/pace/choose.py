"""The choice of settings for an integrator's needs: seconds per box, success, force."""

from typing import NamedTuple

from reporting.statistics import Estimate, wilson
from simulation.closed_loop.statistics import Row
from simulation.scene.drawn import toml


class Wanted(NamedTuple):
    """A cell's needs: seconds per box at most, share of boxes inserted at least, force at most (95 %).

    A need is met if the results leave no doubt of it: by the end of the 95 % interval that is against it.
    """

    seconds_a_box: float
    success: float
    force_n: float

    def check(self) -> None:
        """Raise ValueError if nothing could meet these needs."""
        if not (self.seconds_a_box > 0 and self.force_n > 0 and 0 < self.success <= 1):
            raise ValueError(f"{self}: expected seconds and force above 0, and a share above 0 up to 1")

    def short(self, point: Row, count: int) -> float:
        """Shortfall of a choice, relative to the needs."""
        shares = (
            Estimate(*point["seconds_a_box"]).high / self.seconds_a_box - 1.0,
            (self.success - wilson(point["inserted"], count).low) / max(1.0 - self.success, 0.01),
            Estimate(*point["force_95_n"]).high / self.force_n - 1.0,
        )
        return float(sum(max(0.0, share) for share in shares))


def choose(data: Row, wanted: Wanted) -> tuple[Row, bool]:
    """The fastest choice that meets all three, and True; else the nearest, and False.

    A choice with a false claim meets nothing, and is nearest only if no other has fewer.
    """
    count = data["insertions"]
    best = min(data["points"], key=lambda p: (p["claimed_wrongly"], wanted.short(p, count), p["seconds_a_box"][0]))
    return best, not best["claimed_wrongly"] and wanted.short(best, count) == 0.0


def summary(point: Row, count: int, wanted: Wanted, *, kept: bool) -> str:
    """The choice and its results, simulated."""
    asked = f"{wanted.seconds_a_box:g} s a box, {wanted.success:.1%} inserted, {wanted.force_n:g} N"
    answer = "meets" if kept else f"the NEAREST; {count} insertions show no choice to meet (more may)"
    return (
        f"{point['name']}: {answer} {asked}\n"
        f"  simulated, {count} insertions: {Estimate(*point['seconds_a_box']):.2f} s a box,"
        f" {wilson(point['inserted'], count):.1%} inserted, {point['claimed_wrongly']} false claims,"
        f" force below {point['force_n']['95']:.1f} N in 95 %, largest {point['force_n']['largest']:.1f} N"
        + "".join(f"\n  {line}" for line in _needs(point))
    )


def settings_toml(point: Row, count: int) -> str:
    """The client's tables as a file, with the evidence for them."""
    seconds, share = Estimate(*point["seconds_a_box"]), wilson(point["inserted"], count)
    comment = (
        f"{point['name']}: {seconds:.2f} s a box, {share:.1%} inserted, in {count} simulated insertions.",
        *_needs(point),
        "Where the cameras or the arm do not bear its fast legs, the descent probes all the way.",
    )
    return toml(point["client"], "\n# ".join(comment))


def _needs(point: Row) -> list[str]:
    """What the choice needs beside the client's settings."""
    needs = [f"needs {point['needs']}"] if point["needs"] else []
    return needs + [f'the service needs {key} = "{value}"' for key, value in point.get("service", {}).items()]
