"""Records of a commissioning that an earlier version has written."""

import asyncio
import hashlib
import json

from robot_client.session.commission.record import read_record
from tests.robot_client.session.test_commission import Cell, commissioning


def test_a_record_of_before_touches_were_kept_is_still_as_it_was_written(tmp_path):
    path = tmp_path / "record.json"
    record = asyncio.run(commissioning(Cell(), path).run(6))
    assert record.late_s is None
    older = json.loads(path.read_text())
    for entry in (*older["signs"], *older["probes"]):
        assert entry.pop("below_mm") is None
    press = {"fast": False, "stop": None}
    older |= {"timed": [press]}
    content = {name: value for name, value in older.items() if name not in ("sha256", "presses")}
    older["sha256"] = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    path.write_text(json.dumps(older))
    assert read_record(path).signs == record.signs
