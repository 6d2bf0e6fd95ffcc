"""Profiles of sensors: read whole, refused in one line."""

import re
from pathlib import Path

import pytest

from service.contract import ContractError, ModelCard, Sensor
from service.contract.sensor import SENSORS
from tests.service import tiny_models

GELSLIM, MINI = Sensor.load(), Sensor.load("gelsight_mini")
GELSLIM_TEXT = (SENSORS / "gelslim_2019.toml").read_text(encoding="utf-8")


def changed(**values: object) -> Sensor:
    return Sensor.model_validate(GELSLIM.model_dump() | values)


@pytest.mark.parametrize("path", SENSORS.glob("*.toml"), ids=lambda path: path.stem)
def test_every_profile_is_known_by_the_name_of_its_file(path: Path) -> None:
    sensor = Sensor.load(path.stem)
    assert (sensor.name, sensor) == (path.stem, Sensor.load(path))
    assert Sensor.model_validate_json(sensor.model_dump_json()) == sensor


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("marker_row = 20", "marker_row: unknown key; did you mean 'marker_rows'?"),
        ("fps = 5", "fps: expected a number >= 10 and <= 120 (given: 5)"),
        ("fps = 30.5", "fps: expected a whole number >= 10 and <= 120 (given: 30.5)"),
        ("mm_per_px = nan", "mm_per_px: expected a number >= 0.02 and <= 0.3 (given: nan)"),
        ("marker_rows = 21", "gel_margin_mm: the markers must lie on 22.05 x 21.0 mm"),
        ("first_marker_px = [-1.0, 17.0]", "first_marker_px: the markers must lie in 327 x 320 px"),
        ("gel_width_mm = 21.0", "gel_margin_mm: the markers must lie on 21.0 x 21.0 mm"),
        ("gel_margin_mm = [-0.1, 0.5]", "gel_margin_mm: the markers must lie on"),
        ("marker_diameter_px = 12.0", "marker_diameter_px: the pitch must be 1.4 to 8 diameters"),
        (
            "corners_raw_px = [[24.0, 6.0], [402.0, 6.0], [114.0, 311.0], [312.0, 311.0]]",
            "corners_raw_px: must be convex",
        ),
    ],
)
def test_a_profile_that_cannot_be_is_refused_by_file_and_key_in_one_line(
    tmp_path: Path, line: str, message: str
) -> None:
    key = line.split(" = ", maxsplit=1)[0]
    path = tmp_path / "mine.toml"
    path.write_text(re.sub(rf"^{key} = .*\n", "", GELSLIM_TEXT, flags=re.MULTILINE) + line + "\n")
    with pytest.raises(ContractError, match=rf"mine\.toml: {re.escape(message)}") as refused:
        Sensor.load(path)
    assert len(str(refused.value).splitlines()) == 1


def test_a_missing_key_and_an_unknown_name_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(GELSLIM_TEXT.replace("fps = 30\n", ""))
    with pytest.raises(ContractError, match=r"mine\.toml: fps: missing, expected a number"):
        Sensor.load(tmp_path / "mine.toml")
    with pytest.raises(ContractError, match=r"no sensor 'gelsite_mini': .*did you mean 'gelsight_mini'"):
        Sensor.load("gelsite_mini")
    with pytest.raises(ContractError, match=r"none\.toml: No such file"):
        Sensor.load(tmp_path / "none.toml")


def test_a_card_without_a_sensor_means_the_first_one() -> None:
    card = tiny_models.card("direction", "step")
    assert card.sensor is None
    assert card.profile == GELSLIM


def test_a_card_is_one_sensor_s_and_two_of_different_sensors_never_decide_together() -> None:
    card = tiny_models.card("direction", "step")
    mine = {"sensor": changed(name="mine", mm_per_px=0.065, gel_width_mm=22.0).model_dump()}
    other = ModelCard.model_validate(card.model_dump() | mine)
    assert [text.partition(":")[0] for text in card.disagreements(other)] == ["profile"]
    assert "gelslim_2019" in card.disagreements(other)[0]
    assert "mine" in card.disagreements(other)[0]
    with pytest.raises(ValueError, match="must be those of its sensor gelsight_mini"):
        ModelCard.model_validate(card.model_dump() | {"sensor": MINI.model_dump()})
