"""Recordings of a cell as training data: what is known of each attempt's error, and what is refused."""

import json
import math

import numpy as np
import pytest

from service.contract import ContractError, Sensor
from service.contract.toml import toml_text
from training.data.episodes import cells_of, read_episodes, recordings_of
from training.networks.pressing import LATTICE

CONDITIONS = np.array([56, 30, 20, 0, 10, 0.3], np.float32)
V, U = np.mgrid[-1 : 1 : LATTICE.rows * 1j, -1 : 1 : LATTICE.columns * 1j]


def steps_of(x_mm, theta_deg, rng):
    """Steps of a gel whose turn follows x and whose shear follows yaw."""
    out = np.ones((8, 2, LATTICE.rows, LATTICE.columns, 3), np.float32)
    for finger, side in ((0, 1.0), (1, -1.0)):
        ramp = np.linspace(0.1, 0.8, 8)[:, None, None]
        out[:, finger, ..., 0] = ramp * (-side * x_mm * V * 0.02)
        out[:, finger, ..., 1] = ramp * (side * x_mm * U * 0.02 + 0.01 * theta_deg)
    out[..., :2] += rng.normal(0, 0.002, out[..., :2].shape)
    return out


def recorded(root, count, off_mm=0.0, seed=0, *, stated_right=True, work=False, first=0):
    """Recordings of probes by a tool that is off by ``off_mm``, or of ``work`` that went in at the next attempt.

    Unless ``stated_right``, of something else. They are numbered from ``first``.
    """
    rng = np.random.default_rng(seed)
    for index in range(first, first + count):
        x_mm, theta_deg = (float(value) for value in rng.uniform(-12, 12, 2))
        felt = (x_mm - off_mm, theta_deg) if stated_right else rng.uniform(-12, 12, 2)
        attempts = [(steps_of(*felt, rng), {"dx_mm": -x_mm, "dtheta_deg": -theta_deg})]
        keep(
            root / f"{index:04d}", attempts, *(("insert", "inserted") if work else ("probe", "failed")), x_mm, theta_deg
        )
    return root


def lost(whole):
    """As long as it was, and nothing of it on the disk."""
    return bytes(len(whole))


def zeroed(whole):
    """As long as it was, with a part that never reached the disk."""
    return whole[: len(whole) // 2] + bytes(50) + whole[len(whole) // 2 + 50 :]


def keep(folder, attempts, purpose, outcome, x_mm, theta_deg, **facts):
    folder.mkdir(parents=True)
    for number, (steps, decision) in enumerate(attempts, 1):
        path = folder / f"attempt_{number:02d}.npz"
        np.savez(path, steps=steps, conditions=CONDITIONS, decision=np.array(json.dumps(decision)))
    summary = {"purpose": purpose, "outcome": outcome, "approach": {"x_mm": x_mm, "yaw_deg": theta_deg}}
    summary |= {"insertion_id": folder.name, **facts}
    (folder / "summary.json").write_text(json.dumps(summary))


def test_errors_are_those_told_of_probes_and_the_moves_that_were_left_of_insertions(tmp_path):
    rng, blank = np.random.default_rng(0), {}
    shown = [steps_of(1, 1, rng) for _ in range(3)]
    keep(tmp_path / "a", [(shown[0], {"dx_mm": 9.0, "dtheta_deg": 0.0})], "probe", "failed", -7.0, 3.0)
    moves = [{"dx_mm": -4.0, "dtheta_deg": 2.0}, {"dx_mm": -1.0, "dtheta_deg": 0.5}]
    keep(tmp_path / "b", list(zip(shown, moves, strict=False)), "insert", "inserted", 5.5, -2.0)
    keep(tmp_path / "c", [(shown[0], blank)], "insert", "failed", 5.5, -2.0)
    keep(tmp_path / "d", [(shown[0], blank)], "timing", "failed", 8.0, 8.0)
    keep(tmp_path / "e", [(shown[0], moves[1])], "insert", "inserted", 1.0, 0.0, continues="b")
    read = read_episodes(tmp_path, Sensor.load())
    assert read.error.tolist() == [[-7.0, 3.0], [5.0, -2.5], [1.0, -0.5], [1.0, -0.5]]
    assert read.length.tolist() == [8, 8, 8, 8]
    assert read.objects.tolist() == ["probe", "work", "later", "later"]


def test_each_attempt_of_a_probe_has_the_error_of_its_own_start_and_may_evaluate(tmp_path):
    rng = np.random.default_rng(0)
    starts = [{"x_mm": 4.0, "yaw_deg": -6.0}, {"x_mm": -9.0, "yaw_deg": 1.0}]
    shown = [(steps_of(1, 1, rng), {"dx_mm": 2.0, "dtheta_deg": 1.0}) for _ in range(4)]
    keep(tmp_path / "a", shown, "probe", "failed", -7.0, 3.0, starts=starts)
    read = read_episodes(tmp_path, Sensor.load())
    assert read.error.tolist() == [[-7.0, 3.0], [4.0, -6.0], [-9.0, 1.0]], "of the fourth nothing is known"
    assert set(read.objects.tolist()) == {"probe"}
    assert set(read.groups.tolist()) == {"a"}, "one grasp"
    (tmp_path / "a" / "attempt_02.npz").unlink()
    assert read_episodes(tmp_path, Sensor.load()).error.tolist() == [[-7.0, 3.0], [-9.0, 1.0]]


def test_recordings_say_whether_their_cell_is_real_and_older_ones_do_not(tmp_path):
    rng, samples = np.random.default_rng(0), Sensor.load()
    for name, stated in (
        ("a", {"simulated": False}),
        ("b", {"simulated": True}),
        ("c", {"simulated": True}),
        ("d", {}),
    ):
        keep(tmp_path / name, [(steps_of(1, 1, rng), {})] * 2, "probe", "failed", 1.0, 1.0, **stated)
        assert sum(cells_of(tmp_path, read_episodes(tmp_path, samples)).values()) == len([*tmp_path.iterdir()])
    assert cells_of(tmp_path, read_episodes(tmp_path, samples)) == {"real": 1, "simulated": 2, "not stated": 1}


@pytest.mark.parametrize("lost", [0, 2, 3])
def test_a_file_that_a_full_disk_lost_changes_no_label_of_another_attempt(tmp_path, lost):
    rng = np.random.default_rng(0)
    moves = [(-4.0, 3.0), (9.0, -6.0), (1.0, 0.0)]
    decided = [{"dx_mm": x, "dtheta_deg": theta} for x, theta in moves]
    decisions = [{"attempt": number, "correction": move} for number, move in enumerate(moves, 1)]
    folder = tmp_path / "a"
    shown = [(steps_of(1, 1, rng), move) for move in decided]
    keep(folder, shown, "insert", "inserted", 5.5, -2.0, decisions=decisions)
    (folder / f"attempt_{lost:02d}.npz").unlink(missing_ok=True)
    errors = {1: [-6.0, 3.0], 2: [-10.0, 6.0], 3: [-1.0, 0.0]}
    assert read_episodes(tmp_path, Sensor.load()).error.tolist() == [errors[n] for n in errors if n != lost]


@pytest.mark.parametrize(
    "damage",
    [lambda whole: whole[:0], lambda whole: whole[:200], zeroed, lost],
    ids=["empty", "cut", "zeros", "only zeros"],
)
def test_a_file_that_a_power_cut_damaged_is_named_and_the_others_are_read_without_it(tmp_path, damage):
    rng = np.random.default_rng(0)
    starts = [{"x_mm": 4.0, "yaw_deg": -6.0}]
    keep(tmp_path / "a", [(steps_of(1, 1, rng), {}) for _ in range(2)], "probe", "failed", -7.0, 3.0, starts=starts)
    path = tmp_path / "a" / "attempt_02.npz"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(
        ContractError, match=r"a is no recording.*: attempt_02\.npz is damaged .*; remove it, and the other"
    ):
        read_episodes(tmp_path, Sensor.load())
    path.unlink()
    assert read_episodes(tmp_path, Sensor.load()).error.tolist() == [[-7.0, 3.0]]


@pytest.mark.parametrize(
    "changed",
    [
        {"conditions": CONDITIONS[:5]},
        {"conditions": CONDITIONS * np.float32(np.nan)},
        {"conditions": np.full(6, "25 N")},
        {"steps": np.zeros((0, 2, LATTICE.rows, LATTICE.columns, 3), np.float32)},
        {"steps": np.zeros((8, 2, 11, 11, 3), np.float32)},
        {"steps": np.array("lost")},
        {"steps": np.full((8, 2, LATTICE.rows, LATTICE.columns, 3), np.float32(np.nan))},
        {"steps": np.full((8, 2, LATTICE.rows, LATTICE.columns, 3), np.float32(1e5))},
    ],
    ids=["five conditions", "NaN", "texts", "no step", "another lattice", "no array", "NaN steps", "steps of 100 m"],
)
def test_an_attempt_that_holds_no_input_of_such_networks_is_named(tmp_path, changed):
    keep(tmp_path / "a", [(steps_of(1, 1, np.random.default_rng(0)), {})], "probe", "failed", -7.0, 3.0)
    (path,) = tmp_path.glob("a/attempt_*.npz")
    with np.load(path) as stored:
        kept = {name: stored[name] for name in stored.files}
    np.savez(path, **kept | changed)
    with pytest.raises(ContractError, match=r"a is no recording of an insertion: (attempt_01\.npz holds|could not)"):
        read_episodes(tmp_path, Sensor.load())


@pytest.mark.parametrize(
    "facts",
    [
        {"approach": None},
        {"approach": {"x_mm": math.nan, "yaw_deg": 1.0}},
        {"approach": {"x_mm": 8000.0, "yaw_deg": 1.0}},  # in micrometres
        {"starts": [{"x_mm": 1.0}]},
        {"decisions": 5},
        {"decisions": [5]},
    ],
    ids=str,
)
def test_a_summary_that_states_no_error_is_named(tmp_path, facts):
    keep(tmp_path / "a", [(steps_of(1, 1, np.random.default_rng(0)), {})], "probe", "failed", -7.0, 3.0, **facts)
    with pytest.raises(ContractError, match="a is no recording of an insertion"):
        read_episodes(tmp_path, Sensor.load())


def test_no_folder_is_said_so_and_a_copied_file_is_no_attempt(tmp_path):
    recorded(tmp_path / "runs", 2)
    kept = tmp_path / "runs" / "0001" / "attempt_01.npz"
    kept.with_name("attempt_01 (copy).npz").write_bytes(kept.read_bytes())
    assert len(read_episodes(tmp_path / "runs", Sensor.load())) == 2
    with pytest.raises(ContractError, match="rums: no such folder, expected one with recordings"):
        read_episodes(tmp_path / "rums", Sensor.load())


def test_a_press_in_which_the_arm_paused_teaches_nothing(tmp_path):
    """How deep it was in each picture is not known, so its steps are of other depths than they say."""
    rng, moved = np.random.default_rng(0), {"dx_mm": -4.0, "dtheta_deg": 3.0}
    stale = {"type": "no_decision", "reason": "stale", "detail": "the arm paused in the press"}
    keep(tmp_path / "a", [(steps_of(1, 1, rng), stale), (steps_of(1, 1, rng), moved)], "insert", "inserted", 5.5, -2.0)
    keep(tmp_path / "b", [(steps_of(1, 1, rng), stale)], "probe", "failed", 8.0, 8.0)
    read = read_episodes(tmp_path, Sensor.load())
    assert (read.error.tolist(), read.objects.tolist()) == ([[4.0, -3.0]], ["later"])


def test_a_recording_that_is_there_twice_is_named(tmp_path):
    """As after a month was merged with its backup: the copy would be held out of what was fitted to it."""
    recorded(tmp_path, 3)
    read_episodes(tmp_path, Sensor.load())
    (tmp_path / "0001 (copy)").symlink_to(tmp_path / "0001")
    with pytest.raises(ContractError, match=r"0001 \(copy\) is a copy of 0001; expected each recording once"):
        read_episodes(tmp_path, Sensor.load())


def test_of_all_probes_only_those_count_that_the_record_of_a_commissioning_lists(tmp_path):
    recorded(tmp_path / "runs", 5)
    record = tmp_path / "commissioning.toml"

    def read(**stated):
        record.write_text(toml_text({"named": [], "signs": [], "probes": [], **stated}))
        return read_episodes(tmp_path / "runs", Sensor.load(), record)

    listed = [{"insertion_id": "0001"}, {"insertion_id": "0004"}]
    assert read(signs=listed[:1], probes=listed[1:]).groups.tolist() == ["0001", "0004"]
    assert read(signs=listed, probes=[{"insertion_id": "gone"}]).groups.tolist() == ["0001", "0004"]
    with pytest.raises(ContractError, match=r"5 other probes among 5 .* none of the 1 insertions that .*\.toml lists"):
        read(signs=[{"insertion_id": "gone"}])
    recorded(tmp_path / "runs", 2, work=True, first=5)
    with pytest.raises(ContractError, match=r"5 other probes among 7 .* none of the 1 insertions that .*\.toml lists"):
        read(signs=[{"insertion_id": "gone"}])
    with pytest.raises(ContractError, match="names mistakes, and its probes have wrong labels: x reversed"):
        read(signs=listed, named=["x reversed"])
    record.write_text("")
    with pytest.raises(ContractError, match="is no record of a commissioning"):
        read_episodes(tmp_path / "runs", Sensor.load(), record)


def test_work_before_the_listed_probes_was_perhaps_done_with_another_gel_and_teaches_nothing(tmp_path):
    for name, purpose in (("a", False), ("b", True), ("c", False), ("d", True), ("e", True), ("f", False)):
        recorded(tmp_path / name, 1, seed=ord(name), work=not purpose)
        (tmp_path / name / "0000").rename(tmp_path / f"2026010{ord(name) - ord('a')}T000000_{name}")
        (tmp_path / name).rmdir()
        summary = tmp_path / f"2026010{ord(name) - ord('a')}T000000_{name}" / "summary.json"
        summary.write_text(json.dumps({**json.loads(summary.read_text()), "insertion_id": name}))
    record = tmp_path / "commissioning.toml"
    listed = [{"insertion_id": name} for name in "dex"]
    record.write_text(toml_text({"named": [], "begun": "2030-01-01T00:00:00", "signs": listed, "probes": []}))
    read = read_episodes(tmp_path, Sensor.load(), record)
    assert [name[-1] for name in read.groups.tolist()] == ["d", "e", "f"]
    _, there = recordings_of(tmp_path, record)
    assert there is not None
    expected = f"2 of 3 listed insertions are in {tmp_path}, 2 recordings of earlier work are skipped"
    assert there.text() == expected
    assert len(read_episodes(tmp_path, Sensor.load())) == 6, "without a record all count"
    (timing := tmp_path / "20260101T000001_t").mkdir()
    (timing / "summary.json").write_text(json.dumps({"insertion_id": "t", "purpose": "timing", "outcome": "failed"}))
    _, still = recordings_of(tmp_path, record)
    assert still == there, "presses that time a cell are no work"


def test_an_unseen_point_counts_for_nothing(tmp_path):
    steps = steps_of(5, 1, np.random.default_rng(0))
    steps[:, 0, 3, 4] = (9.0, 9.0, 0.0)
    keep(tmp_path / "a", [(steps, {})], "probe", "failed", 5.0, 1.0)
    batch = read_episodes(tmp_path, Sensor.load()).batch(np.arange(1), None)
    assert batch.fields[0, :8, 0, :, 3, 4].abs().max() == 0.0
    assert batch.fields[0, :8, 1, 2].min() == 1.0
