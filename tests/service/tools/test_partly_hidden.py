"""Where a tenth of a gel is hidden, its calibration keeps the rows that it keeps of the open gel, or says otherwise."""

import json

import cv2
import numpy as np
import pytest

from service.__main__ import main
from service.contract import Sensor
from service.tools.calibrate import find_grid
from service.tools.calibration_output import profile_of
from service.tools.grid_fit import GridFit, fit_grid
from tests.service.perception.real import real_data
from tests.service.tools.test_calibrate import REST, renderer
from tests.service.tools.test_grid_fit import CELLS, printed

HIDDEN_SHARE, PLACES = 0.1, 20
MANY = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))]


def hidden(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The frame with a grey square somewhere, of a tenth of its area."""
    height, width = image.shape[:2]
    side = round((HIDDEN_SHARE * height * width) ** 0.5)
    v, u = rng.integers(0, height - side + 1), rng.integers(0, width - side + 1)
    image = image.copy()
    image[v : v + side, u : u + side] = rng.integers(60, 200)
    return image


def centre(grid: GridFit) -> np.ndarray:
    """Raw px [2] in the middle of the rectified frame."""
    return grid.projection.raw((np.array(grid.shape[::-1]) - 1)[None] / 2)[0]


def moved(grid: GridFit, other: GridFit) -> float:
    """How far the middle of the frame is from that of another fit, in pitches along columns or rows."""
    return float(np.abs(grid.projection.plane(centre(other)[None])[0] - (np.array(grid.shape[::-1]) - 1) / 2).max())


def mini(shift_px: tuple[float, float]) -> np.ndarray:
    """A GelSight Mini's frame with 8 x 10 markers in view, of which the profile has 7 x 9."""
    scale = 31 / 24
    change = np.array([[scale, 0, 159.5 + shift_px[0]], [0, scale, 119.5 + shift_px[1]]])
    change[:, 2] -= scale * np.array([30 + 24 * 4.5, 30 + 24 * 3.5])
    cells = CELLS[(CELLS[:, 0] < 10) & (CELLS[:, 1] < 8)]
    return cv2.warpAffine(printed(cells, 0.7), change, (320, 240), borderMode=cv2.BORDER_REPLICATE)


@pytest.mark.parametrize("seed", MANY)
def test_the_frame_of_a_partly_hidden_gel_stays_where_the_profile_has_it(seed: int):
    """The profile was made where the last row and the first column of the gel are out of view."""
    known = (CELLS[:, 0] > 0) & (CELLS[:, 1] < 10)
    picture = printed(CELLS[known], 0.7)
    sensor = profile_of(picture, find_grid(picture, "a", None), "mine", 1.5, 30)
    assert (sensor.marker_rows, sensor.marker_columns) == (10, 14)
    whole, rng = printed(CELLS, 0.7), np.random.default_rng(seed)
    for _ in range(PLACES // len(MANY)):
        grid = find_grid(hidden(whole, rng), "a", sensor)
        assert (grid.shape, grid.in_view) == ((10, 14), (11, 15))
        assert np.abs(centre(grid) - (30 + 24 * np.array([7.5, 4.5]))).max() < 1


@pytest.mark.parametrize("shift_px", [(4, -3), (-3, 5)])
def test_a_picture_turned_by_half_a_turn_keeps_the_same_rows(shift_px: tuple[float, float]):
    sensor, upright = Sensor.load("gelsight_mini"), mini(shift_px)
    grid = find_grid(upright, "a", sensor)
    other = find_grid(np.ascontiguousarray(upright[::-1, ::-1]), "a", sensor)
    assert (grid.shape, grid.in_view) == ((7, 9), (8, 10))
    assert np.abs(centre(grid) + centre(other) - (319, 239)).max() < 1
    assert np.abs(centre(grid) - (159.5, 119.5)).max() < 31 / 2 + 1


@pytest.mark.parametrize("away_px", [120, -120])
def test_a_profile_with_the_view_of_another_camera_leaves_the_frame_in_the_middle_of_the_picture(away_px: int):
    sensor, image = Sensor.load("gelsight_mini"), mini((4, -3))
    elsewhere = [[u, v + away_px] for u, v in sensor.corners_raw_px]
    other = find_grid(image, "a", sensor.model_copy(update={"corners_raw_px": elsewhere}))
    assert moved(find_grid(image, "a", sensor), other) < 0.1


def test_the_row_says_how_far_the_frame_may_be_off(tmp_path):
    picture, row = tmp_path / "a.png", tmp_path / "a.json"
    cv2.imwrite(str(picture), mini((4, -3)))
    assert main(["calibrate", "--picture", str(picture), "--sensor", "gelsight_mini", "--json", str(row)]) == 0
    figures = json.loads(row.read_text())
    assert (figures["rows"], figures["columns"], figures["in_view"]) == (7, 9, [8, 10])
    rows, columns = figures["remarks"]
    assert rows.startswith("8 rows in view, 7 kept")
    assert columns.startswith("10 columns in view, 9 kept")
    assert rows.endswith("up to 1 pitch off")
    cv2.imwrite(str(picture), np.full((240, 320, 3), 120, np.uint8))
    assert main(["calibrate", "--picture", str(picture), "--json", str(row)]) == 2
    empty = json.loads(row.read_text())
    assert (empty["in_view"], empty["remarks"]) == ([0, 0], [])


@pytest.mark.parametrize(
    "there",
    [
        (CELLS[:, 1] < 8) | (CELLS[:, 1] > 9),
        (CELLS[:, 1] < 8) | (CELLS[:, 0] > 10),
        (CELLS[:, 0] < 12) | (CELLS[:, 0] > 13) | (CELLS[:, 1] == 0),
    ],
    ids=["two rows hidden before the last", "the last rows mostly hidden", "two columns mostly hidden before the last"],
)
def test_rows_beyond_hidden_ones_are_counted(there: np.ndarray):
    grid = fit_grid(printed(CELLS[there], 0.7))
    assert grid is not None
    assert grid.shape == (11, 15)


def test_a_profile_whose_own_fit_is_refused_is_not_written(tmp_path, capsys):
    """What is made of a gel that something presses would state a wrong view."""
    picture, profile, row = tmp_path / "a.png", tmp_path / "mine.toml", tmp_path / "a.json"
    pressed = REST.copy()
    pressed[5:15, 5:16, 0] = 0.5
    cv2.imwrite(str(picture), renderer("left", 0).raw(pressed, 0))
    arguments = ["calibrate", "--new-profile", str(profile), "--pitch-mm", "1.05"]
    assert main([*arguments, "--picture", str(picture), "--json", str(row)]) == 2
    refused = json.loads(row.read_text())["refused"]
    assert "touches the gel" in refused
    assert f"{refused}; {profile} is not written" in capsys.readouterr().err
    cameras = [f"--camera-{finger}=file:{tmp_path}" for finger in ("left", "right")]
    assert main([*arguments, *cameras, "--frames", "1", "--out", str(tmp_path / "c.toml")]) == 2
    assert not profile.exists()


@pytest.mark.parametrize("fps", ["0", "-5"])
def test_an_impossible_frame_rate_is_refused_by_name(fps: str, tmp_path, capsys):
    picture, profile = tmp_path / "a.png", tmp_path / "mine.toml"
    cv2.imwrite(str(picture), printed(CELLS, 0.7))
    assert main(["calibrate", "--picture", str(picture), "--new-profile", str(profile), "--fps", fps]) == 2
    assert "fps: " in capsys.readouterr().err
    assert not profile.exists()
    assert main(["calibrate", "--picture", str(picture), "--fps", fps]) == 2
    assert "expected with --new-profile" in capsys.readouterr().err


@pytest.mark.real_data
@pytest.mark.parametrize("seed", MANY)
def test_the_frame_and_the_counts_of_a_real_gel_stay_with_a_tenth_hidden(seed: int):
    """Of 24 x 23 markers in view the profile has 21 x 20; towards one edge they are weak."""
    image = np.asarray(cv2.imread(str(real_data("gelslim_raw") / "finger_1_427x320.png")), np.uint8)
    rng, whole = np.random.default_rng(seed), find_grid(image, "a", Sensor.load())
    for _ in range(PLACES // len(MANY)):
        frame = hidden(image, rng)
        grid = find_grid(frame, "a", Sensor.load())
        assert (grid.shape, grid.in_view) == ((20, 21), (23, 24))
        assert moved(whole, grid) < 0.5
        assert find_grid(frame, "a", None).shape == (23, 24)
