"""The robot client's configuration for a simulated cell, as somebody would write it for a real one."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from simulation.scene.scene import APPROACH_MM, TOPS_LEVEL_MM

OPEN_MM, RETREAT_MM = 100.0, 40.0


def client_config(
    facts: dict[str, Any],
    service: str,
    token: Path | None,
    link: Literal["egm", "socket"] = "egm",
    chosen: Mapping[str, Any] | None = None,
) -> str:
    """The text of a ``cell.toml``. ``facts`` are those of ``cell.json``; the fixture is where the arm starts.

    ``service`` is the address of the service, ``token`` the file of its token; with None the client finds it itself.
    ``chosen``: tables that override these, as `choose` writes them; a lower approach is set lower here.
    """
    devices = {
        "egm": {"device": "abb_egm", "port": facts["egm_guide_port"]},
        "socket": {"device": "abb_rapid", **facts["rapid"]},
    }
    host, _, port = facts["gripper"].rpartition(":")
    url = service.replace("http://", "ws://").rstrip("/") + "/v1/insertion"
    tables: dict[str, dict[str, Any]] = {
        "robot": {**devices[link], "rws.url": facts["rws_url"]},
        "gripper": {"host": host, "port": int(port)},
        "service": {"url": url, **({"token_file": str(token)} if token else {})},
        "task": {
            "object": Path(facts["object"]).stem,
            "approach_z_mm": round(facts["approach"]["z_mm"], 4),
            "gap_width_mm": round(facts["gap_width_mm"], 3),
            "tops_level_mm": TOPS_LEVEL_MM,
            "neighbours_stay": facts["neighbours_stay"],
            "expected_depth_mm": round(facts["expected_depth_mm"], 3),
            "creep_allowance_mm": facts["creep_allowance_mm"],
        },
        "cycle": {"open_mm": OPEN_MM, "retreat_mm": RETREAT_MM},
        "cycle.pick": {key: round(float(value), 4) for key, value in facts["home"].items()},
    }
    if link == "socket":  # REACTION_S and the controller's stop ramp
        tables["lease"] = {"stop_lag_s": 0.07}
    for name, keys in flat(chosen or {}).items():
        tables[name] = tables.get(name, {}) | keys
    lower_mm = APPROACH_MM - tables["task"].get("approach_clearance_mm", APPROACH_MM)
    for key in ("approach_z_mm", "expected_depth_mm"):
        tables["task"][key] = round(tables["task"][key] - lower_mm, 4)
    lines = ["simulated = true"]
    for name, keys in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in keys.items())]
    return "\n".join(lines) + "\n"


def flat(tables: Mapping[str, Any], above: str = "") -> dict[str, dict[str, Any]]:
    """Nested tables by their dotted names, as the headings of a TOML file."""
    flattened: dict[str, dict[str, Any]] = {}
    for name, table in tables.items():
        inner = {key: value for key, value in table.items() if isinstance(value, Mapping)}
        if plain := {key: value for key, value in table.items() if key not in inner}:
            flattened[above + name] = plain
        flattened |= flat(inner, f"{above}{name}.")
    return flattened
