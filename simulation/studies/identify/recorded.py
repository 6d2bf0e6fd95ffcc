"""The probes of a commissioning from their recordings, sorted for identifying the gel."""

import json
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from robot_client.session.commission.run import PRESSES, STALE
from robot_client.session.commission.wiring import SIDES
from service.contract import ContractError, Sensor
from service.contract.model_card import CONDITIONS
from simulation.scene.scene import Scene
from simulation.studies.identify.evidence import Floats, Touch, numbers_of

GRIPS_N = (10.0, 40.0)
GRIPS_APART = (1.8, 2.2)
"""Ratio of the firmer to the lighter grip."""
SPEED_MM_S = (4.8, 5.2)
"""Of the probes: the posterior was fitted to the client's own descent, and one of 4 mm/s shows a third more reach."""
WIDTH_MM, DEPTH_MM = (40.0, 110.0), (40.0, 100.0)
"""Least size of the pressing rectangle: its faces cover the pads, and turned it lies on both sides of its gap."""
AT_MM, AT_DEG = 1e-3, 1e-3
"""Tolerance of the start of a press or of a wiring probe: probes to learn from begin nearby, and are neither."""


class Sorted(NamedTuple):
    """Wiring probes, and presses by grip: first the cell's own, used by the first wiring probes."""

    signs: Sequence[Touch]
    presses: Mapping[float, Sequence[Touch]]

    def numbers(self, scene: Scene) -> Floats:
        """Their numbers, for a part that the posterior was fitted for. Raises ContractError."""
        body = scene.object
        for name, value, (low, high) in (
            ("size_x_mm", body.size_x_mm, WIDTH_MM),
            ("size_y_mm", body.size_y_mm, DEPTH_MM),
        ):
            if body.shape != "rectangle" or not low <= value <= high:
                raise ContractError(f"object {scene.name}: expected a rectangle with {name} {low:g} to {high:g}")
        return numbers_of(self.signs, self.presses, (body.size_x_mm, body.size_y_mm))


def read(folder: Path) -> Sorted:
    """The probes of the newest commissioning below ``folder``. Raises ContractError if they cannot identify a gel."""
    touches = list[Touch]()
    for path in sorted(folder.glob("*/summary.json")):
        start, touched = _probed(path)
        if _begins(start, SIDES[:1]):  # the first probe of a commissioning: those before may be of another gel
            touches.clear()
        touches += touched
    signs = [one for one in touches if _begins((one.x_mm, one.yaw_deg), SIDES)]
    signs = [one for one in signs if one.grip_n == signs[0].grip_n]
    presses = defaultdict[float, list[Touch]](list)
    for one in touches:
        if _begins((one.x_mm, one.yaw_deg), PRESSES):
            presses[one.grip_n].append(one)
    return sorted_out(signs, presses)


def sorted_out(signs: Sequence[Touch], presses: Mapping[float, Sequence[Touch]]) -> Sorted:
    """Probes sorted by kind. Raises ContractError if some are missing, or made at other grips."""
    if not signs:
        raise ContractError("no probe for signs that touched; expected the recordings of a commissioning")
    own = signs[0].grip_n
    grips = sorted(presses, key=lambda grip: abs(grip - own))
    if len(grips) != 2 or grips[0] != own:
        raise ContractError(
            f"presses at {', '.join(f'{grip:g} N' for grip in grips) or 'no grip'}; expected some at the cell's own"
            f" {own:g} N and some at twice or half of it"
        )
    apart = max(grips) / min(grips)
    if not (GRIPS_N[0] <= min(grips) and max(grips) <= GRIPS_N[1] and GRIPS_APART[0] <= apart <= GRIPS_APART[1]):
        raise ContractError(
            f"presses at {grips[0]:g} and {grips[1]:g} N; expected {GRIPS_N[0]:g} to {GRIPS_N[1]:g} N,"
            " one twice the other"
        )
    slowest, *_, fastest = sorted(one.speed_mm_s for one in (*signs, *presses[own], *presses[grips[1]]))
    if not SPEED_MM_S[0] <= slowest <= fastest <= SPEED_MM_S[1]:
        raise ContractError(
            f"probes at {slowest:g} to {fastest:g} mm/s; expected {SPEED_MM_S[0]:g} to {SPEED_MM_S[1]:g}, as"
            " [ramps.descend] has it by default"
        )
    shape, usual = signs[0].markers_px.shape, Sensor.load()
    if any(one.markers_px.shape != (2, usual.marker_rows, usual.marker_columns, 2) for one in (*signs, *presses[own])):
        raise ContractError(f"markers {list(shape)}; expected those of the sensor {usual.name} on both fingers")
    return Sorted(signs, {grip: presses[grip] for grip in grips})


def _begins(start: tuple[float, float] | None, places: Sequence[tuple[float, float]]) -> bool:
    return start is not None and any(abs(start[0] - x) < AT_MM and abs(start[1] - yaw) < AT_DEG for x, yaw in places)


def _probed(summary: Path) -> tuple[tuple[float, float] | None, list[Touch]]:
    """The start of a probe, None of what was none; and its observations, none if it touched nothing."""
    try:
        content = json.loads(summary.read_text(encoding="utf-8"))
        if content.get("purpose") != "probe":
            return None, []
        x_mm, yaw_deg = float(content["approach"]["x_mm"]), float(content["approach"]["yaw_deg"])
        if not (path := summary.with_name("attempt_01.npz")).exists():
            return (x_mm, yaw_deg), []
        if path.read_bytes()[:2] != b"PK":  # numpy takes anything else for data that may run code
            raise zipfile.BadZipFile("its beginning is lost")
        with path.open("rb") as stream, np.load(stream) as stored:
            if "held_px" not in stored.files or json.loads(str(stored["decision"])).get("reason") == STALE:
                return (x_mm, yaw_deg), []  # of a paused press the depths are not known; it was made again
            steps, held = stored["steps"].astype(np.float64), stored["held_px"].astype(np.float64)
            conditions = dict(zip(CONDITIONS, map(float, stored["conditions"]), strict=True))
        touch = Touch(x_mm, yaw_deg, conditions["grip_n"], conditions["speed_mm_s"], steps, held)
        return (x_mm, yaw_deg), [touch]
    except (zipfile.BadZipFile, zlib.error) as error:
        raise ContractError(f"{path} is damaged ({error}); remove it, and the other probes are read") from error
    except (OSError, ValueError, KeyError) as error:
        raise ContractError(f"{summary.parent} is no recording of a probe: {error}") from error
