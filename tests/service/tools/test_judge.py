"""`service judge` on recordings made here, and on real ones where they are."""

import json

import cv2
import numpy as np
import pytest

from service.__main__ import main
from service.cameras.recorded import clip_images
from service.perception.markers.tracker import MarkerTracker
from service.tools.live import stops_of
from tests.service.perception.real import real_data
from tests.service.perception.synthetic import draw, grid

KEYS = {
    "run", "frames_n", "contact_frame", "hold_frame", "slip_frame", "lost_frame", "released_frame",
    "borne_frames", "fingers", "largest_score", "open_frame", "ambiguous_n", "refused_n", "missing_n", "ms_a_frame",
    "live",
}  # fmt: skip


def record(folder, touched, frames=48, put_down=0, repeats=1, enlarged=1):
    """Two fingers' clips: an object touches both from frame ``touched[0]`` to ``touched[1]``.

    It pulls the markers down; in its last ``put_down`` frames it pushes them up. Each frame comes ``repeats`` times,
    under fresh noise, and ``enlarged`` times as large.
    """
    folder.mkdir(parents=True)
    rng = np.random.default_rng(1)
    rest = grid(jitter=0.1)
    away = (rest - rest.mean((0, 1))) / 50.0
    bulged = rest + 3.0 * away * np.exp(0.5 - 0.5 * np.square(away).sum(-1, keepdims=True))
    for name in ("camera_0", "camera_2"):
        height, width = (enlarged * side for side in draw(rest, rng).shape[:2])
        out = cv2.VideoWriter(str(folder / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, (width, height))
        for k in np.repeat(np.arange(frames), repeats):
            pull = np.array([0.0, 1.0 if k < touched[1] - put_down else -1.0])
            out.write(cv2.resize(draw(bulged + pull if touched[0] <= k < touched[1] else rest, rng), (width, height)))
        out.release()


def write(clip, pictures):
    out = cv2.VideoWriter(str(clip), cv2.VideoWriter_fourcc(*"MJPG"), 25, pictures[0].shape[1::-1])
    for picture in pictures:
        out.write(picture)
    out.release()


def write_black(clip, frames, size=(320, 240)):
    write(clip, [np.zeros((size[1], size[0], 3), np.uint8)] * frames)


def rows_of(runs, out, *options):
    """The rows of the runs by name, and what the command returned."""
    returned = main(["judge", str(runs), "--json", str(out), *options])
    return {row["run"]: row for row in json.loads(out.read_text())}, returned


def test_the_phases_of_a_recorded_grasp_are_found(tmp_path):
    record(tmp_path / "runs" / "box_1_slip", (18, 38))
    rows, returned = rows_of(tmp_path / "runs", tmp_path / "rows.json")
    row = rows["box_1_slip"]
    assert (set(rows), set(row), returned) == ({"box_1_slip"}, KEYS, 0)
    assert (row["frames_n"], row["contact_frame"]) == (48, 18)
    assert 18 < row["hold_frame"] < 28
    assert 38 <= row["lost_frame"] <= 40
    assert set(row["fingers"]) == {"camera_0", "camera_2"}
    armed = row["live"]["armed_frames"]
    assert row["hold_frame"] < armed[0] < armed[-1] < row["lost_frame"]


def test_an_object_that_is_put_down_and_let_go_is_released_and_not_lost(tmp_path):
    record(tmp_path / "runs" / "box_1_slip", (18, 38), put_down=4)
    rows, _ = rows_of(tmp_path / "runs", tmp_path / "rows.json")
    row = rows["box_1_slip"]
    assert row["borne_frames"][:4] == [34, 35, 36, 37]
    assert 38 <= row["released_frame"] <= 40
    assert (row["slip_frame"], row["lost_frame"]) == (None, None)


def test_a_folder_without_runs_is_refused_in_one_line(tmp_path, capsys):
    assert main(["judge", str(tmp_path), "--json", str(tmp_path / "rows.json")]) == 2
    assert "expected runs, folders of one video a finger" in capsys.readouterr().err


def test_a_file_that_cannot_be_written_is_refused_before_any_run_is_judged(tmp_path, capsys):
    record(tmp_path / "runs" / "box_1_slip", (18, 38))
    files = ["--json", str(tmp_path / "rows.json"), "--evidence", str(tmp_path)]
    assert main(["judge", str(tmp_path / "runs"), *files]) == 2
    assert capsys.readouterr().out == ""


def test_pictures_without_markers_show_no_grasp_and_a_run_that_cannot_be_read_is_named(tmp_path, capsys):
    for run in ("black", "unreadable"):
        (tmp_path / run).mkdir()
        for name in ("camera_0", "camera_2"):
            write_black(clip := tmp_path / run / f"{name}.avi", 6)
    clip.write_bytes(b"no video")
    rows, returned = rows_of(tmp_path, tmp_path / "rows.json")
    assert "unreadable" in capsys.readouterr().err
    row = rows["black"]
    assert (set(rows), row["refused_n"], returned) == ({"black"}, 12, 1)
    assert {row[f"{phase}_frame"] for phase in ("contact", "hold", "slip", "lost")} == {None}


def test_odd_runs_are_named_in_one_line_each_and_the_others_judged(tmp_path, capsys):
    runs = tmp_path / "runs"
    for name, frames in (("one frame", 1), ("una_caña_1_hold", 24), ("no one", 1), ("unnamed", 1)):
        record(runs / name, (10, 18), frames)
    (runs / "unnamed").rename(runs / "un\udcffnamed")
    (runs / "no one" / "camera_2.avi").unlink()
    rows, returned = rows_of(runs, tmp_path / "rows.json")
    assert returned == 1
    assert {name: (row["frames_n"], len(row["fingers"])) for name, row in rows.items()} == {
        "one frame": (1, 2), "una_caña_1_hold": (24, 2), "no one": (1, 1)
    }  # fmt: skip
    assert rows["una_caña_1_hold"]["lost_frame"] is not None
    assert [line.split(":")[0] for line in capsys.readouterr().err.splitlines()] == ["no one", "un\\udcffnamed"]


def test_a_video_without_a_gel_hides_no_loss(tmp_path, capsys):
    """A black camera, or one that overlooks the scene, is not a finger that sees nothing and so forbids every loss."""
    runs = tmp_path / "runs"
    record(runs / "overlooked", (18, 38))
    record(runs / "half blind", (18, 38))
    (runs / "half blind" / "camera_2.avi").unlink()
    for clip in ("overlooked/scene.avi", "half blind/camera_2.avi"):
        write_black(runs / clip, 48)
    (runs / "overlooked" / "._camera_0.avi").write_bytes(b"a file of another system")
    rows, returned = rows_of(runs, tmp_path / "rows.json")
    assert returned == 0
    assert all(38 <= row["lost_frame"] <= 40 for row in rows.values())
    assert sorted(capsys.readouterr().err.splitlines()) == [
        "half blind: camera_2 shows no marker grid, and is left out",
        "half blind: one finger's video alone: whether the object slides is not known",
        "overlooked: scene shows no marker grid, and is left out",
    ]


def test_a_run_without_an_open_gel_is_said_to_show_no_end(tmp_path, capsys):
    record(tmp_path / "held", (0, 24), frames=24)
    rows, returned = rows_of(tmp_path, tmp_path / "rows.json")
    assert (returned, rows["held"]["open_frame"], rows["held"]["lost_frame"]) == (0, None, None)
    assert "held: no frame shows open gels" in capsys.readouterr().err


def test_a_finger_that_goes_blind_in_a_run_hides_no_loss(tmp_path):
    record(tmp_path / "box", (18, 44), frames=56)
    clip = tmp_path / "box" / "camera_2.avi"
    frames = [image for image, _ in clip_images(clip)]
    write(clip, [image if k < 30 else np.zeros_like(image) for k, image in enumerate(frames)])
    rows, _ = rows_of(tmp_path, tmp_path / "rows.json")
    assert 44 <= rows["box"]["lost_frame"] <= 46


def test_grey_pictures_are_remarked_on(tmp_path, capsys):
    for run in ("coloured", "grey"):
        record(tmp_path / run, (5, 8), 10)
    clips = sorted((tmp_path / "grey").iterdir())
    for clip in clips:
        write(clip, [np.repeat(image[..., 1:2], 3, 2) for image, _ in clip_images(clip)])
    rows, returned = rows_of(tmp_path, tmp_path / "rows.json")
    grey = [line for line in capsys.readouterr().err.splitlines() if "grey pictures" in line]
    assert (set(rows), returned, grey) == (
        {"coloured", "grey"},
        0,
        ["grey: grey pictures: the limits were set in colour"],
    )


def test_a_damaged_video_is_named(tmp_path, capsys):
    record(tmp_path / "runs" / "cut", (18, 38))
    clip = tmp_path / "runs" / "cut" / "camera_0.avi"
    clip.write_bytes(clip.read_bytes()[: round(0.6 * clip.stat().st_size)])
    rows, returned = rows_of(tmp_path / "runs", tmp_path / "rows.json")
    assert returned == 1
    assert 12 < rows["cut"]["missing_n"] < 30
    assert "frames of its videos cannot be decoded" in capsys.readouterr().err


def test_large_pictures_and_fast_videos_are_judged_as_small_slow_ones(tmp_path):
    record(tmp_path / "large" / "box", (18, 38), enlarged=3)
    rows, _ = rows_of(tmp_path / "large", tmp_path / "rows.json")
    assert (rows["box"]["contact_frame"], rows["box"]["frames_n"]) == (18, 48)
    record(tmp_path / "fast" / "box", (18, 38), repeats=4)
    rows, _ = rows_of(tmp_path / "fast", tmp_path / "rows.json", "--fps", "30")
    assert (rows["box"]["contact_frame"], rows["box"]["frames_n"]) == (72, 192)
    assert 4 * 38 <= rows["box"]["lost_frame"] <= 4 * 40


@pytest.mark.parametrize(("fps", "rate_hz", "named"), [("6", 6, "6"), ("8", 8, ""), ("12", 6, "6"), ("20", 10, "10")])
def test_frames_have_the_stamps_of_the_rate_that_is_judged_and_it_is_named(
    tmp_path, capsys, monkeypatch, fps, rate_hz, named
):
    stamps_ns, rates_hz = [], []

    class Tracker(MarkerTracker):
        def update(self, image, captured_ns):
            stamps_ns.append(captured_ns)
            return super().update(image, captured_ns)

    def stops(pairs, open_frame, held, given_hz):
        rates_hz.append(given_hz)
        return stops_of(pairs, open_frame, held, given_hz)

    monkeypatch.setattr("service.tools.judge.MarkerTracker", Tracker)
    monkeypatch.setattr("service.tools.judge.stops_of", stops)
    record(tmp_path / "box", (18, 38), repeats=2 if rate_hz < int(fps) else 1)
    rows_of(tmp_path, tmp_path / "rows.json", "--fps", fps)
    assert stamps_ns[:3] == [round(k * 1e9 / rate_hz) for k in range(3)]
    assert rates_hz == [rate_hz]
    err = capsys.readouterr().err
    assert (f"{named} frames a second are judged; the limits were set at 8" in err) == bool(named)


def test_runs_of_one_name_are_told_apart_and_a_wrong_folder_destroys_no_rows(tmp_path):
    for day in ("monday", "tuesday"):
        record(tmp_path / "runs" / day / "box", (5, 8), 8)
    rows, _ = rows_of(tmp_path / "runs", tmp_path / "rows.json")
    assert set(rows) == {"monday/box", "tuesday/box"}
    kept, returned = rows_of(tmp_path / "no such", tmp_path / "rows.json")
    assert (kept, returned) == (rows, 2)


def test_a_run_is_named_as_its_link_and_not_as_what_that_links_to(tmp_path):
    record(tmp_path / "2024-05-01T10", (5, 8), 8)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "box_1_slip").symlink_to(tmp_path / "2024-05-01T10")
    rows, _ = rows_of(tmp_path / "runs", tmp_path / "rows.json")
    assert set(rows) == {"box_1_slip"}


def test_fingers_with_pictures_of_two_sizes_are_judged(tmp_path):
    record(tmp_path / "box", (18, 38))
    clip = tmp_path / "box" / "camera_2.avi"
    frames = [image[:-8, :-7] for image, _ in clip_images(clip)]
    write(clip, frames)
    rows, returned = rows_of(tmp_path, tmp_path / "rows.json")
    assert (returned, rows["box"]["contact_frame"]) == (0, 18)
    assert rows["box"]["live"]["armed_frames"]


def test_two_videos_of_one_name_are_not_mistaken_for_one_finger(tmp_path, capsys):
    record(tmp_path / "box", (5, 8), 8)
    (tmp_path / "box" / "camera_2.avi").rename(tmp_path / "box" / "camera_0.mkv")
    rows, returned = rows_of(tmp_path, tmp_path / "rows.json")
    assert (rows, returned) == ({}, 1)
    assert "two of its videos have one name" in capsys.readouterr().err


def test_help_says_which_pictures_show_no_open_gel(capsys):
    with pytest.raises(SystemExit):
        main(["judge", "--help"])
    assert "GelSlim 3 no frame counts as open" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("rate", ["2", "nan", "fast"])
def test_a_rate_that_cannot_be_is_refused(tmp_path, capsys, rate):
    with pytest.raises(SystemExit):
        main(["judge", str(tmp_path), "--fps", rate])
    assert "--fps" in capsys.readouterr().err


@pytest.mark.real_data
@pytest.mark.slow
def test_real_objects_that_leave_the_hand_are_lost(tmp_path):
    """Short runs: the loss is where the imprint disappears (frames found by eye on the touch curves)."""
    root = tmp_path / "runs"
    root.mkdir()
    leaves_at = {"ball_white_thread_6_slip": 90, "ball_white_thread_7_slip": 88, "marker_pen_2_slip": 44}
    for name in leaves_at:
        (root / name).symlink_to(real_data("gelsight_mini_slip") / name)
    assert main(["judge", str(root), "--json", str(tmp_path / "rows.json")]) == 0
    rows = {row["run"]: row for row in json.loads((tmp_path / "rows.json").read_text())}
    assert {name: abs(rows[name]["lost_frame"] - at) <= 3 for name, at in leaves_at.items()} == dict.fromkeys(
        leaves_at, True
    )


@pytest.mark.real_data
@pytest.mark.slow
def test_real_objects_that_are_put_down_are_not_lost_and_do_not_slip(tmp_path):
    """Gels empty by eye (`real_slips.json`); the avocado's left gel is never open, but shows that it is put down."""
    root = tmp_path / "runs"
    root.mkdir()
    emptied = {"blue_mug_1_hold": 201, "blue_mug_3_hold": 190, "avocado_real_6_hold": None}
    for name in emptied:
        (root / name).symlink_to(real_data("gelsight_mini_slip") / name)
    assert main(["judge", str(root), "--json", str(tmp_path / "rows.json")]) == 0
    rows = {row["run"]: row for row in json.loads((tmp_path / "rows.json").read_text())}
    assert {(row["slip_frame"], row["lost_frame"]) for row in rows.values()} == {(None, None)}
    for name, frame in emptied.items():
        assert frame is None or abs(rows[name]["released_frame"] - frame) <= 3
    assert min(rows["avocado_real_6_hold"]["borne_frames"]) < 297, "the witness speaks from here on"
