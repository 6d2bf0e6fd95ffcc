"""The record of a commissioning, which `insert --live` demands: one that was edited or cut off is refused."""

import hashlib
import json
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.cli.insert import with_commissioning
from robot_client.insertion.lease import Lease
from robot_client.session.commission.record import RECORD, Record, keep_record, read_record
from robot_client.settings import Settings
from service.contract.frames import ContractError
from service.contract.toml import read_toml, toml_text
from tests.full_disk import fill_before
from tests.robot_client.insertion.stories import PLAN
from tests.robot_client.session.test_lateness import series_of
from tests.robot_client.session.test_wiring import all_went_in, answers


def test_a_real_cell_inserts_only_with_the_record_of_its_commissioning(tmp_path):
    path = tmp_path / "commissioning.toml"
    real = Settings(commissioning=path, lease=Lease(stop_lag_s=0.04))

    def asked(settings):
        return with_commissioning(settings, PLAN, asked=True)

    for settings, says in ((Settings(), "--uncommissioned"), (real, "no such file")):
        with pytest.raises(ContractError, match=says):
            asked(settings)
    record = Record(begun="today", seed=1, signs=tuple(answers()), gels={"left": "a", "right": "b"})
    keep_record(path, record.model_copy(update={"named": ("swapped",)}))
    with pytest.raises(ContractError, match="swapped"):
        asked(real)
    keep_record(path, record.model_copy(update={"signs": tuple(answers((-1, 1)))}))  # broken off before it was named
    with pytest.raises(ContractError, match="names mistakes"):
        asked(real)
    keep_record(path, record)
    assert asked(real).gels == record.gels
    simulated, unasked = asked(Settings(simulated=True)), with_commissioning(Settings(), PLAN, asked=False)
    assert not simulated.gels
    assert unasked == PLAN
    tilts = [plan.most_tilt_deg for plan in (asked(real), simulated, unasked)]
    assert tilts == [1.5, 1.5, 0.0], "whose signs nobody has checked never tilts"


@pytest.mark.parametrize("text", ["", "{", "version = 3", 'version = 9\nbegun = "x"\nseed = 0'])
def test_a_file_that_is_no_record_is_refused_by_name(tmp_path, text):
    path = tmp_path / "record.toml"
    path.write_text(text)
    with pytest.raises(ContractError, match=r"no record of a commissioning.*; move its folder away"):
        read_record(path)
    keep_record(path, Record(begun="today", seed=1))
    assert read_record(path).seed == 1


def test_a_record_is_read_as_it_was_written(tmp_path):
    path, presses = tmp_path / RECORD, series_of(0.05, slips={3})
    signs = (*answers(), *answers(reason="stale"), *all_went_in())
    record = Record(begun="today", seed=1, signs=signs, timed=tuple(presses), gels={"left": "a", "right": 'b"\n'})
    keep_record(path, record)
    assert read_record(path).model_copy(update={"sha256": ""}) == record
    assert len(path.read_text().splitlines()) < 20 + len(signs) + len(presses), "a line for each probe"


@pytest.mark.parametrize(("key", "value"), [("seed", 2), ("timed", None), ("approach_z_mm", 35.0), ("object", "")])
def test_the_record_of_an_older_release_has_fewer_fields_and_is_read_but_not_if_edited(tmp_path, key, value):
    """In its presses, too; and to remove a field is to edit it, or to add one, even with its default."""
    path, record = tmp_path / RECORD, Record(begun="then", seed=1, signs=tuple(answers()), timed=tuple(series_of(0.05)))
    written = record.model_dump(mode="json", exclude={"sha256": True, "object": True, "timed": {"__all__": {"afresh"}}})
    older = tomllib.loads(toml_text(written))
    older["sha256"] = hashlib.sha256(json.dumps(older, sort_keys=True).encode()).hexdigest()
    path.write_text(toml_text(older))
    read = read_record(path)
    assert read.model_copy(update={"sha256": ""}) == record
    keep_record(path, read)
    assert read_record(path).model_copy(update={"sha256": ""}) == record, "and this release goes on with it"
    path.write_text(toml_text({**older, key: value}))
    with pytest.raises(ContractError, match="not as it was written"):
        read_record(path)


def test_a_full_disk_leaves_the_record_of_the_probe_before(tmp_path):
    path = tmp_path / "record.toml"
    keep_record(path, Record(begun="today", seed=1))
    fill_before(path)
    with pytest.raises(ContractError, match="No space left on device; the last probe is not in it"):
        keep_record(path, Record(begun="today", seed=2))
    assert read_record(path).seed == 1


@given(st.sampled_from(["seed", "object", "named", "gels"]))
def test_a_record_that_was_edited_is_refused(tmp_path_factory, key):
    path = tmp_path_factory.mktemp("record") / "record.toml"
    keep_record(path, Record(begun="today", seed=1, named=("x",), gels={"left": "a", "right": "b"}))
    edited = {"seed": 2, "object": "another", "named": [], "gels": {"left": "z", "right": "b"}}
    path.write_text(toml_text({**read_toml(path), key: edited[key]}))
    with pytest.raises(ContractError, match="not as it was written"):
        read_record(path)
