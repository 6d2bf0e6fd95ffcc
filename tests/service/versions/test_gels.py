"""Networks that took over with other gels go on deciding, and the service says so and what to do."""

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from service.contract import Finger
from service.decision.models import ModelSet, load_models
from service.perception.rectification import Calibration, CameraCalibration, Measured
from service.session.station import Station
from service.settings import Settings
from service.versions.store import version_of
from service.versions.versions import Versions
from tests.service import drawn, tiny_models

OLD: Mapping[Finger, str] = {"left": "aaaa", "right": "bbbb"}
NEW: Mapping[Finger, str] = {"left": "aaaa", "right": "cccc"}


def quiet(_: str, __: object) -> None:
    """A listener that does nothing."""


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    return [tiny_models.write_models(tmp_path / name, git_commit=name * 40) for name in "abc"]


def opened(three: list[Path], gels: Mapping[Finger, str]) -> contextlib.closing[Versions]:
    return contextlib.closing(Versions(three[0].parent / "versions", load_models(three[0]), quiet, gels))


def problem(three: list[Path], gels: Mapping[Finger, str]) -> str:
    """What a start with these gels says."""
    with opened(three, gels) as versions:
        assert versions.problem == versions.state().problem
        return versions.problem


def adapted(three: list[Path], gels: Mapping[Finger, str], *folders: Path) -> None:
    """Let networks take over, one after the other."""
    with opened(three, gels) as versions:
        for folder in folders:
            versions.give(folder)
            versions.promote()
        assert versions.problem == ""


def test_networks_that_took_over_with_another_gel_are_named_with_the_way_back(three: list[Path]) -> None:
    adapted(three, OLD, three[1])
    assert problem(three, OLD) == ""
    shown = problem(three, NEW)
    assert f"version {version_of(load_models(three[1]))} took over with other gels" in shown
    assert "(right bbbb, now cccc)" in shown, "the left one is as before"
    assert "(`versions rollback`), then commission and adapt" in shown
    with opened(three, NEW) as versions:
        versions.roll_back()
        assert versions.problem == "", "the release belongs to no gel"
    adapted(three, NEW, three[2])
    assert problem(three, NEW) == ""
    assert "(right cccc, now bbbb)" in problem(three, OLD)


def test_where_the_version_before_is_no_release_the_way_back_leads_to_the_release(three: list[Path]) -> None:
    adapted(three, OLD, three[1], three[2])
    assert f"(`versions shadow {three[0]}` and `versions promote`)" in problem(three, NEW)
    with opened(three, NEW) as versions:
        versions.roll_back()
        assert version_of(load_models(three[1])) in versions.problem, "it took over with the old gels, too"
    adapted(three, NEW, three[0])
    assert problem(three, OLD) == ""


@pytest.mark.parametrize("then", [{}, {"left": "aaaa"}])
def test_a_gel_without_a_name_speaks_against_nothing(three: list[Path], then: Mapping[Finger, str]) -> None:
    adapted(three, then, three[1])
    assert problem(three, NEW) == ""
    adapted(three, OLD, three[2])
    assert problem(three, then) == ""


def test_a_shadow_that_runs_does_not_hide_what_speaks_against_the_one_that_decides(three: list[Path]) -> None:
    adapted(three, OLD, three[1])
    with opened(three, NEW) as versions:
        versions.give(three[2])
        assert "took over with other gels" in versions.problem
        versions.promote()
        assert versions.problem == ""


def named(camera: CameraCalibration, fingerprint: str) -> CameraCalibration:
    return replace(camera, measured=Measured("2026-03-02", "", 0.1, 1.0, fingerprint))


def test_a_station_knows_versions_by_the_gels_that_its_client_is_given(tmp_path: Path, models: ModelSet) -> None:
    plain = drawn.calibration()
    calibration = Calibration(named(plain.left, "one"), named(plain.right, "two"))
    text = tmp_path / "calibration.toml"
    text.write_text("")
    settings = Settings(
        models=tmp_path,
        camera_left="push:",
        camera_right="push:",
        recordings=tmp_path,
        state=tmp_path,
        calibration=text,
    )
    station = Station(settings, models, calibration)
    station._networks.shutdown()
    with contextlib.closing(station.versions) as versions:
        versions.give(tiny_models.write_models(tmp_path / "other", git_commit="b" * 40))
        versions.promote()
        kept = versions._now.wiring.gels[versions.state().active.version]
    assert kept == {camera.finger: camera.gel for camera in station.manager.camera_entries()}
    assert len(set(kept.values())) == 2
