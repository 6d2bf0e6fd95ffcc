"""What an insertion does with the lateness that a commissioning has measured."""

import asyncio

import pytest

from robot_client.cli.check import examine_cameras, findings_of
from robot_client.cli.insert import with_commissioning
from robot_client.insertion.lease import PAUSE_S, Lease
from robot_client.insertion.limits import LimitError
from robot_client.insertion.pace import Pace
from robot_client.session.commission.lateness import LEAST_OPEN_S
from robot_client.session.commission.record import Record, keep_record
from robot_client.settings import Settings, SettingsError, Task
from service.contract import wire
from tests.robot_client.insertion.stories import PLAN
from tests.robot_client.session.test_lateness import series_of
from tests.robot_client.session.test_wiring import answers


@pytest.mark.parametrize(("late", "set_s", "counts_s"), [(0.09, 0.04, 0.09), (0.03, 0.04, 0.04), (None, 0.05, 0.05)])
def test_an_insertion_reckons_with_the_lateness_of_its_commissioning_where_that_is_longer(
    tmp_path, late, set_s, counts_s
):
    path = tmp_path / "commissioning.toml"
    made = series_of(late - LEAST_OPEN_S, frame_s=0.0) if late else ()
    keep_record(path, Record(begun="today", seed=1, signs=tuple(answers()), timed=tuple(made)))
    plan = PLAN.model_copy(update={"lease": Lease(stop_lag_s=set_s)})
    timed_plan = with_commissioning(Settings(commissioning=path, lease=plan.lease), plan, asked=True)
    assert timed_plan.lease.stop_lag_s == pytest.approx(counts_s)


def test_a_cell_whose_lateness_is_neither_measured_nor_set_inserts_nothing(tmp_path):
    path = tmp_path / "commissioning.toml"
    keep_record(path, Record(begun="today", seed=1, signs=tuple(answers())))
    with pytest.raises(SettingsError, match=r"does not show how late .* or set it"):
        with_commissioning(Settings(commissioning=path), PLAN, asked=True)


@pytest.mark.parametrize(
    ("late", "good", "says"),
    [
        (None, True, "not measured: for the 40 ms set, the lease lasts 260 ms"),
        (0.09, True, "late by at most 90 ms: the lease lasts 210 ms"),
        (0.2, True, "lasts 100 ms, too short for 10 mm/s: fast legs are slower, or there are none"),
        (0.29, False, "descend more slowly than 4.8 mm/s"),
    ],
)
async def test_check_tells_how_late_the_cell_is_and_refuses_one_that_is_too_late(tmp_path, late, good, says):
    path = tmp_path / "commissioning.toml"
    made = series_of(late - LEAST_OPEN_S, frame_s=0.0) if late else ()
    keep_record(path, Record(begun="today", seed=1, signs=tuple(answers()), timed=tuple(made)))
    real = Settings(commissioning=path, lease=Lease(stop_lag_s=0.04))
    (finding,) = [finding async for name, finding in findings_of(real) if name == "cell"]
    assert finding.good == good
    assert says in finding.text


@pytest.mark.parametrize(("gel", "good"), [("a", True), ("z", False), ("", False)])
def test_check_refuses_a_gel_with_which_the_cell_was_not_commissioned(tmp_path, gel, good):
    path = tmp_path / "commissioning.toml"
    gels = {"left": "a", "right": "b"}
    keep_record(path, Record(begun="today", seed=1, signs=tuple(answers()), gels=gels))
    cameras = [wire.CameraEntry(finger=f, source="s", state="live", gel=gel if f == "left" else "b") for f in gels]
    finding = examine_cameras(Settings(commissioning=path, lease=Lease(stop_lag_s=0.04)), cameras)
    assert finding.good is good
    assert good or "the left gel is not the one" in finding.text
    assert examine_cameras(Settings(), cameras).good, "nothing to compare with"
    assert "not known yet" in examine_cameras(Settings(), cameras).text
    timed = [camera.model_copy(update={"frame_rate_hz": 60.0}) for camera in cameras]
    assert examine_cameras(Settings(), timed).text == "cameras fast enough"


def test_a_lateness_that_uses_up_the_lease_is_refused_with_the_speed_that_would_do():
    late = PLAN.model_copy(update={"lease": PLAN.lease.late_by(0.14)})
    with pytest.raises(LimitError, match=r"140 ms of stop lag at 10 mm/s; descend more slowly than 9.4 mm/s"):
        late.check()
    late.at_speed(9.0).check()


@pytest.mark.parametrize(
    ("late", "rate_hz", "fast_mm_s"),
    [(0.1, None, 10.0), (0.15, None, None), (0.1, 200.0, 10.0), (0.15, 200.0, 8.45), (0.275, 200.0, None)],
)
def test_the_fast_legs_of_a_late_cell_are_as_slow_as_its_lease_demands(late, rate_hz, fast_mm_s):
    """Without the cameras' rate it is not known what the lease bears."""
    plan = PLAN.at_speed(5.0).model_copy(
        update={"lease": PLAN.lease.late_by(late), "pace": Pace(fast_mm_s=10.0), "pause_s": PAUSE_S}
    )
    plan.check()
    camera = wire.CameraEntry(finger="left", source="s", state="live", frame_rate_hz=rate_hz)
    legs = plan.with_legs_for([camera])
    assert legs.pace.fast_mm_s == (fast_mm_s and pytest.approx(fast_mm_s, abs=0.01))
    if fast_mm_s:
        assert fast_mm_s * (legs.lasts_s + late) <= 1.5 + 1e-2


@pytest.mark.parametrize("stay", [False, True])
def test_check_names_a_cell_that_will_confirm_nothing_after_a_blocked_attempt(stay):
    cell = Settings(task=Task(neighbours_stay=stay))

    async def plan():
        return [finding.text async for name, finding in findings_of(cell) if name == "plan"]

    warned = [text for text in asyncio.run(plan()) if "neighbours_stay" in text]
    assert len(warned) == (not stay)
