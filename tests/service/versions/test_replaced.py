"""Networks that are exported over the folder that a service serves never decide without a trial."""

import contextlib
import shutil
from pathlib import Path

import pytest

from service.contract import ContractError
from service.decision.models import load_models
from service.versions.store import version_of
from service.versions.versions import Versions
from tests.service import tiny_models


def quiet(_: str, __: object) -> None:
    """A listener that does nothing."""


@pytest.fixture
def served(tmp_path: Path) -> Path:
    return tiny_models.write_models(tmp_path / "served", git_commit="a" * 40)


@pytest.fixture
def apart(tmp_path: Path) -> Path:
    return tiny_models.write_models(tmp_path / "apart", git_commit="b" * 40)


def export_over(folder: Path) -> None:
    tiny_models.write_models(folder, git_commit="c" * 40)


REFUSED = "no longer holds the networks that this service was started with"


@pytest.mark.parametrize("promoted", [False, True])
def test_a_shadow_that_was_exported_over_the_served_folder_is_refused_at_once(
    tmp_path: Path, served: Path, apart: Path, promoted: bool
) -> None:
    """``promoted``: another version decides, but the next start would begin anew with that folder."""
    with contextlib.closing(Versions(tmp_path / "versions", load_models(served), quiet)) as versions:
        if promoted:
            versions.give(apart)
            versions.promote()
        export_over(served)
        for _ in range(2):
            with pytest.raises(ContractError, match=f"{REFUSED}.*export the new ones to another folder"):
                versions.give(served)
        assert versions.state().shadow is None


@pytest.mark.parametrize("how", ["replaced", "added to", "removed"])
def test_no_shadow_is_tried_while_the_served_folder_is_not_as_it_was_loaded(
    tmp_path: Path, served: Path, apart: Path, how: str
) -> None:
    with contextlib.closing(Versions(tmp_path / "versions", load_models(served), quiet)) as versions:
        if how == "replaced":
            export_over(served)
        elif how == "added to":
            shutil.copy(apart / "direction.step.onnx", served / "another.step.onnx")
        else:
            shutil.rmtree(served)
        versions.give(apart, at_start=True)
        assert REFUSED in versions.state().problem
        assert versions.state().shadow is None
        with pytest.raises(ContractError, match=REFUSED):
            versions.give(apart)


def test_a_shadow_is_promoted_although_the_served_folder_was_replaced_during_its_trial(
    tmp_path: Path, served: Path, apart: Path
) -> None:
    release = version_of(load_models(served))
    with contextlib.closing(Versions(tmp_path / "versions", load_models(served), quiet)) as versions:
        versions.give(apart)
        export_over(served)
        versions.promote()
        assert versions.state().previous.version == release
        assert version_of(load_models(tmp_path / "versions" / release)) == release
