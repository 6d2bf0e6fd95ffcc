"""`insert` with more than one grasp: each has its name and its log, and how the last one ended is always shown."""

import json
from dataclasses import replace

import pytest

from robot_client.__main__ import main
from robot_client.grippers.dry_run.driver import DryGripper
from robot_client.ports import DriverError
from robot_client.session.recorder import read_log
from robot_client.session.rehearsal import rehearsal_ports

NOT_BACK, NOT_AGAIN = "arm: tracking: on the way back", "gripper: is not referenced"


class BreaksInItsSecondGrasp(DryGripper):
    async def start(self, _post):
        raise DriverError(NOT_AGAIN)


@pytest.fixture(params=["goes on", NOT_BACK, NOT_AGAIN])
def regrasp(request, monkeypatch):
    """A rehearsed object never turns in the hand, so it is regrasped here as if it had."""

    def ports(plan):
        arm, gripper, service = rehearsal_ports(plan)
        breaks = request.param == NOT_AGAIN and plan.insertion_id == "the-second"
        return arm, BreaksInItsSecondGrasp() if breaks else gripper, service

    monkeypatch.setattr("robot_client.cli.insert.rehearsal_ports", ports)

    async def twice(plan, run, *_):
        first = await run(plan)
        if request.param == NOT_BACK:
            raise DriverError(NOT_BACK)
        state = await run(plan.model_copy(update={"insertion_id": "the-second", "continues": plan.insertion_id}))
        return replace(state, attempt=first.attempt + state.attempt)

    monkeypatch.setattr("robot_client.cli.insert.upright", twice)
    return request.param


def test_each_grasp_is_named_with_its_log_and_the_result_is_that_of_the_last(regrasp, tmp_path, capsys):
    first = tmp_path / "first.jsonl"
    goes_on = regrasp == "goes on"
    code = main(["insert", "--x-mm", "8", "--insertion-id", "the-first", "--log", str(first), "--json"])
    out, err = capsys.readouterr()
    lines, result = err.splitlines(), json.loads(out)
    assert code == (0 if goes_on else 1)
    logs = {"the-first": first} | ({"the-second": tmp_path / "the-second.jsonl"} if regrasp != NOT_BACK else {})
    for name, path in logs.items():
        assert read_log(path)[0].insertion_id == name
        assert any(line.startswith(f"insertion {name}") for line in lines)
        assert path.name in "".join(line.strip() for line in lines)
    assert sorted(tmp_path.iterdir()) == sorted(logs.values())
    assert sum(line.startswith("INSERTED after") for line in lines) == (regrasp != NOT_AGAIN)
    if goes_on:
        last = {"insertion_id": "the-second", "log": str(tmp_path / "the-second.jsonl"), "lost": "", "grasps": 2}
        assert last.items() <= result.items()
    else:
        assert lines[-1].startswith(f"FAILED SAFE: {regrasp}")
