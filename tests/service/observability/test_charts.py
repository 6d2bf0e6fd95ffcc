"""An unchanged cell alarms as rarely as stated; a drifting one alarms soon, with its cause."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from service.observability.charts import CAUSES, LEARNT_N, LIMIT, OBJECTS_N, SIDES, Chart, Charts

STEADY = {"light": (90.0, 2.0), "markers": (0.97, 0.01), "gel": (0.05, 0.02), "reach": (0.4, 0.08)}


def alarms_within(chart: Chart, values: np.ndarray, sides: tuple[int, ...] = (-1, 1)) -> int | None:
    """After how many values it alarms."""
    for number, value in enumerate(values, 1):
        chart.add(float(value), "box")
        if max(chart.sum(side) for side in sides) >= LIMIT:
            return number
    return None


def learnt(rng: np.random.Generator, draw) -> Chart:
    chart = Chart()
    assert alarms_within(chart, draw(LEARNT_N)) is None
    return chart


DRAWS = {
    "normal": lambda rng, n: rng.normal(0.4, 0.08, n),
    "trials": lambda rng, n: rng.geometric(0.45, n),
    "coverage": lambda rng, n: rng.binomial(2, 0.9, n) / 2,
    "never changes": lambda _, n: np.ones(n),
}


@pytest.mark.parametrize("name", DRAWS)
@pytest.mark.parametrize(("charts_n", "values_n"), [(12, 300), pytest.param(200, 1000, marks=pytest.mark.slow)])
def test_at_most_one_steady_chart_of_twenty_alarms_within_a_thousand(name: str, charts_n: int, values_n: int) -> None:
    rng = np.random.default_rng(1)
    draw = partial(DRAWS[name], rng)
    alarmed = [alarms_within(learnt(rng, draw), draw(values_n)) for _ in range(charts_n)]
    assert sum(number is not None for number in alarmed) <= max(1, charts_n // 20)


@pytest.mark.parametrize("shift", [-1.0, 1.0])
def test_a_shift_by_one_deviation_alarms_after_some_25_insertions(shift: float) -> None:
    rng = np.random.default_rng(2)
    needed = [alarms_within(learnt(rng, rng.standard_normal), shift + rng.standard_normal(200)) for _ in range(25)]
    assert 10 <= np.median(needed) <= 40


def test_objects_that_differ_are_no_drift(tmp_path: Path) -> None:
    rng, charts = np.random.default_rng(3), Charts(tmp_path / "charts.json")
    usual = {"box": 0.3, "can": 0.9}
    for of in ("box", "can") * 3:  # a hundred of one, then of the other
        for _ in range(LEARNT_N):
            assert charts.add({"reach": float(rng.normal(usual[of], 0.05))}, of, "gel") == []
    assert charts.level("reach") < 1.0


def cell(rng: np.random.Generator, charts: Charts, n: int, **shifts: float) -> list[tuple[str, str]]:
    """Insertions of a cell in which some values have shifted by so many deviations: the alarms, by chart and cause."""
    alarms = []
    for _ in range(n):
        values = {name: mean + sd * (shifts.get(name, 0.0) + rng.normal()) for name, (mean, sd) in STEADY.items()}
        values["coverage"] = float(rng.random() < shifts.get("holds", 0.9))
        values["trials"] = float(rng.geometric(shifts.get("goes_in", 0.45)))
        alarms += [(name, cause.what) for name, cause in charts.add(values, "box", "gel")]
    charts.keep()
    return alarms


@pytest.mark.parametrize(
    ("shifts", "cause"),
    [
        ({"markers": -2.0, "gel": 1.0, "reach": -1.0}, "worn gel"),
        ({"gel": 3.0}, "new gel"),
        ({"light": 3.0, "markers": -1.0}, "changed light"),
        ({"light": -3.0}, "changed light"),
        ({"reach": -1.5}, "slipping fingers"),
        ({"goes_in": 0.2, "holds": 0.4}, "networks that fit no longer"),
    ],
)
def test_what_drifts_is_named(tmp_path: Path, shifts: dict[str, float], cause: str) -> None:
    rng, charts = np.random.default_rng(4), Charts(tmp_path / "charts.json")
    assert cell(rng, charts, LEARNT_N + 100) == []
    alarms = cell(rng, Charts(tmp_path / "charts.json"), 80, **shifts)  # the service was started again
    assert alarms
    assert {what for _, what in alarms} == {cause}
    assert len({name for name, _ in alarms}) == len(alarms)  # each once, not at every insertion


def test_a_remedy_names_every_step_until_the_cell_inserts_again() -> None:
    for cause in CAUSES:
        renamed = "calibrate" in cause.remedy.lower()  # gels, which the client then refuses
        assert not renamed or "commission again, in a new folder" in cause.remedy, cause
        if cause.what == "networks that fit no longer":  # their own work proves nothing, nor do the probes of before
            assert cause.remedy.startswith("Commission again, in a new folder, and adapt"), cause


def test_what_is_over_ends_and_another_gel_is_learnt_anew(tmp_path: Path) -> None:
    rng, charts = np.random.default_rng(5), Charts(tmp_path / "charts.json")
    cell(rng, charts, LEARNT_N)
    assert cell(rng, charts, 100, reach=-3.0)
    assert charts.level("reach") > 1.0
    assert cell(rng, charts, 100) == []
    assert charts.level("reach") < 1.0
    charts.add({"reach": 0.1}, "box", "another gel")
    assert [charts.level(name) for name in SIDES] == [0.0] * len(SIDES)


def test_a_broken_file_or_too_many_objects_stop_nothing(tmp_path: Path) -> None:
    (tmp_path / "charts.json").write_text('{"charts": {}}')
    charts = Charts(tmp_path / "charts.json")
    for number in range(2 * OBJECTS_N):
        assert charts.add({"reach": 0.4}, f"object-{number}", "gel") == []
