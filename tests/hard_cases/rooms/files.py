"""Hard files: cards, recordings, calibrations, scenes and clips that are damaged or foreign are refused by name."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime

from export.onnx.model import open_model
from service.contract import ContractError, ModelCard, Sensor
from service.contract.model_card import CARD_KEY
from service.perception.rectification import Calibration, CalibrationError, CameraCalibration
from service.recordings.reader import Recording, RecordingError
from service.tools.finger_run import FingerRun
from service.tools.judge import RunError, watched
from simulation.scene.parts import Gel
from simulation.scene.scene import Scene, SceneError
from simulation.scene.worlds import load_scene
from tests.hard_cases.instead import with_globals
from tests.hard_cases.registry import ROOT, Guard, case, not_refused
from training.fit.checkpoint import Checkpoint

SENSOR = Sensor.load()


def believed(_read: object) -> object:
    """Cards are taken as they stand, also none at all."""

    def read(cls: type[ModelCard], props: dict[str, str], _source: str = "") -> ModelCard:
        return cls.model_construct(**json.loads(props.get(CARD_KEY, "{}")))

    return classmethod(read)


def without_ranges(gel: type[Gel]) -> type[Gel]:
    """The gel's values may be anything that is a number."""
    for field in gel.model_fields.values():
        field.metadata.clear()
    gel.model_rebuild(force=True)
    Scene.model_rebuild(force=True)
    return gel


def _with_card(change: Callable[[dict[str, object]], object] | None) -> Callable[[], object]:
    import onnx

    def call() -> object:
        with tempfile.TemporaryDirectory() as scratch:
            model = onnx.load(str(ROOT / "models" / "magnitude.step.onnx"))
            card = json.loads(model.metadata_props[0].value)
            if change is None:
                del model.metadata_props[:]
            else:
                change(card)
                model.metadata_props[0].value = json.dumps(card)
            path = Path(scratch) / "magnitude.step.onnx"
            onnx.save(model, str(path))
            return open_model(path)

    return call


@case(
    "data",
    why="a model without its card decides with unknown thresholds",
    holds="a missing, foreign, inconsistent or non-finite card is refused: not refused",
    guard=Guard("service.contract.model_card:ModelCard.from_props", "a card is trusted unchecked", believed),
)
def models_with_a_foreign_card(_seed: int) -> float:
    def put(name: str, value: object) -> Callable[[dict[str, object]], object]:
        return lambda card: card.update({name: value})

    edits = [
        None,
        put("schema_version", 99),
        put("role", "pilot"),
        put("stranger", 1),
        put("threshold_x_mm", float("nan")),
    ]
    edits += [put("state_size", 0), put("calibration", {"temperature": -1.0}), put("form", "sequence")]
    missed = not_refused([_with_card(edit) for edit in edits], ContractError)
    return missed + not_refused([lambda: ModelCard.from_props({}, "x")], ContractError, "no model card")


@case(
    "data",
    why="a file that ends early may still parse",
    holds="truncated and random model, checkpoint and recording files are refused: not refused",
    guard=Guard(
        "export.onnx.runtime:session",
        "the runtime raises its own errors",
        lambda _: lambda file, *_, **__: onnxruntime.InferenceSession(str(file)),
    ),
)
def files_that_end_early(seed: int) -> float:
    rng = np.random.default_rng(seed)
    whole = (ROOT / "models" / "direction.step.onnx").read_bytes()
    with tempfile.TemporaryDirectory() as scratch:
        calls: list[Callable[[], object]] = []
        for index, content in enumerate((b"", whole[: len(whole) // 2], rng.bytes(5000))):
            path = Path(scratch) / f"{index}.bin"
            path.write_bytes(content)
            calls += [lambda p=path: open_model(p), lambda p=path: Checkpoint.load(p)]
        missed = not_refused(calls, ContractError)
        return missed + not_refused([lambda: Recording(Path(scratch) / "2.bin")], RecordingError)


@case(
    "data",
    why="a homography has nine numbers, and most choices fold, flip or empty the picture",
    holds="NaN, singular, folding and empty calibrations are refused: not refused",
    guard=Guard("service.perception.rectification:_MIN_AREA_SHARE", "no part of the raw frame need be in view", -1.0),
)
def calibrations_that_show_nothing(_seed: int) -> float:
    identity = np.eye(3)
    far, horizon, nan = identity.copy(), identity.copy(), identity.copy()
    far[:2, 2] = 1e4
    beside = np.array([[1.0, 0.0, -600.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    horizon[2, 0] = -1 / 150
    horizon = np.linalg.inv(horizon)
    nan[1, 1] = np.nan
    bad = [np.zeros((3, 3)), nan, far, beside, horizon, np.ones((3, 3)), np.eye(2), np.diag([1.0, 1.0, 1e-14])]
    return not_refused([lambda m=m: CameraCalibration(m, SENSOR.raw, SENSOR.rectified) for m in bad], CalibrationError)


@case(
    "data",
    why="users edit calibration files by hand",
    holds="unknown keys, missing tables and wrong types are refused in one line: not refused",
    guard=Guard(
        "service.perception.rectification:Calibration.parse",
        "unknown keys are ignored",
        with_globals(set=lambda _: frozenset()),
    ),
)
def calibration_files_edited_by_hand(_seed: int) -> float:
    with tempfile.TemporaryDirectory() as scratch:
        good = Path(scratch) / "good.toml"
        Calibration(*2 * [CameraCalibration(np.eye(3), SENSOR.raw, SENSOR.rectified)]).save(good)
        text = good.read_text()
        edits = [
            "",
            "schema_version = 1",
            "x = 1\n" + text,
            text.replace("homography", "homograph"),
            text.replace("0.0", "nan", 1),
        ]
        edits += [text.replace("schema_version = 1", "schema_version = 2"), text.replace("[left]", "[middle]"), "\x00"]
        paths = []
        for index, edit in enumerate(edits):
            path = Path(scratch) / f"{index}.toml"
            path.write_text(edit)
            paths.append(path)
        return not_refused([lambda p=p: Calibration.load(p) for p in paths], CalibrationError)


@case(
    "data",
    why="a scene with a negative stiffness or a part wider than its gap has no equilibrium to find",
    holds="impossible scenes are refused with the key and its range: not refused",
    guard=Guard("simulation.scene.parts:Gel", "the gel's values have no range", without_ranges),
)
def scenes_that_cannot_be(_seed: int) -> float:
    changes = [
        {"gel__friction": -0.1},
        {"gel__friction": float("nan")},
        {"blocks__gap_mm": -4.0},
        {"blocks__gap_mm": float("inf")},
    ]
    changes += [
        {"grasp__force_n": 0.0},
        {"object__mass_kg": -1.0},
        {"camera__fps": 9},
        {"numerics__load_step_mm": 0.0},
    ]
    missed = not_refused([lambda c=c: load_scene("rectangle", **c) for c in changes], SceneError)
    return missed + not_refused(
        [lambda: load_scene("nope"), lambda: load_scene("rectangle", gel__colour="red")], SceneError
    )


@case(
    "data",
    why="a clip may be a text file or an empty folder",
    holds="each is refused in one line: not refused",
    guard=Guard("service.tools.judge:watched", "a clip that cannot be read is empty", lambda _: lambda _: FingerRun()),
)
def clips_that_hold_nothing(_seed: int) -> float:
    with tempfile.TemporaryDirectory() as scratch:
        text = Path(scratch) / "x.avi"
        text.write_text("no video")
        return not_refused([lambda: watched(text), lambda: watched(Path(scratch) / "none.avi")], RunError)
