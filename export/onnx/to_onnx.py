"""Checkpoint -> ONNX: two roles in two forms, the card attached last, parity checked before a file is kept."""

import logging
import math
import shutil
import tempfile
import warnings
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
import torch
from onnx_ir.passes.common import DeduplicateInitializersPass
from onnxscript import opset18 as op
from torch import nn

from export.onnx.golden import golden_frames, golden_markers
from export.onnx.model import OUTPUTS, TOLERANCE, open_model
from export.onnx.runtime import session
from export.onnx.verify import verify_forms
from reporting.machine import cpu_name
from service.contract import Calibration, ContractError, ModelCard
from service.contract.model_card import UNTRAINED, Role
from service.contract.self_test import CONDITIONS, make_self_test
from training.data.labels import CLASSES, THRESHOLD_THETA_DEG, THRESHOLD_X_MM
from training.fit.checkpoint import OWN, Checkpoint
from training.networks.density import GRID_THETA_DEG, GRID_X_MM
from training.networks.forms import SequenceForm, StepForm
from training.networks.preprocessing import CHANNELS, selector
from training.networks.settings import FRAMES_PER_DECISION

STATE_TOLERANCE = 1e-4
"""Tolerance of the state that only the next step reads: torch itself rounds it by up to 1e-5."""
IR, OPSET = 8, 18  # onnxruntime 1.17 and later read them; the graphs need no newer form
FLOAT = onnx.TensorProto.FLOAT
LARGEST_SHARED = 10**7
"""Constants of up to this many elements are stored only once, however often the graph uses them."""
Form = Literal["sequence", "step"]
SCRATCH = ".export-"  # folders of files that are not checked yet
FORMS: tuple[Form, Form] = ("sequence", "step")


def export_checkpoint(path: Path, out: Path, only: tuple[str, ...] = ()) -> list[Path]:
    """Write ``<role>.<form>.onnx`` of every role and form, or of those in ``only``.

    Raises ContractError if any parity fails, or where a service would not load these beside the step models in ``out``.

    The two networks go to ``out``, the joint density to ``out/joint``, and both networks in one step graph to
    ``out/pair`` (for networks that read depth, to ``out`` itself): a service loads one folder and decides with it.
    Torch and ONNX, and step and sequence, agree to 1e-5.
    """
    checkpoint = Checkpoint.load(path)
    network = checkpoint.build()
    beside = ("joint",) if checkpoint.pressing else ("joint", "pair")
    _refuse_strangers(out, {f"{role}.step.onnx" for role in network.roles if role not in beside})
    out.mkdir(parents=True, exist_ok=True)
    for left in out.glob(f"{SCRATCH}*"):  # by an export that was killed
        shutil.rmtree(left, ignore_errors=True)
    written = []
    with tempfile.TemporaryDirectory(dir=out, prefix=SCRATCH) as scratch:
        for role in network.roles:
            for form in FORMS[1:] if role == "pair" or checkpoint.pressing else FORMS:
                file = Path(scratch) / f"{role}.{form}.onnx"
                if only and file.name.removesuffix(".onnx") not in only:
                    continue
                _export(network.of(role), checkpoint, role, form, file)
                written.append(file)
        verify_forms([open_model(file) for file in written])
        return [file.replace(_home(out, file.name, beside)) for file in written]


def _refuse_strangers(out: Path, own: set[str]) -> None:
    strangers = sorted({file.name for file in out.glob("*.step.onnx")} - own)
    if strangers:
        names = f"{', '.join(sorted(own))} beside {', '.join(strangers)}"
        raise ContractError(f"{out}: a service loads no {names}; expected another --out")


def why_untrained(checkpoint: Checkpoint) -> str:
    """Why a checkpoint's directions are no better than guessing on its validation; empty for a trained one.

    One that was adapted is as good as its release: few samples of one cell cannot tell it from a guess.
    """
    figures = checkpoint.as_trained
    if not {"accuracy", "chance", "trials"} <= figures.keys():
        return "its directions were never validated"
    accuracy, chance, trials_n = figures["accuracy"], figures["chance"], figures["trials"]
    if accuracy > chance + 3.0 * math.sqrt(chance * (1.0 - chance) / trials_n):
        return ""
    return f"{accuracy:.0%} of {trials_n:.0f} directions are right, and guessing gives {chance:.0%}"


def _home(out: Path, name: str, beside: tuple[str, ...]) -> Path:
    role = name.partition(".")[0]
    folder = out / role if role in beside else out
    folder.mkdir(exist_ok=True)
    return folder / name


def make_card(checkpoint: Checkpoint, role: Role, form: Form, network: Any) -> ModelCard:
    """The card of one file: figures of the validation split, all objects; it says so if the network only guesses."""
    why = why_untrained(checkpoint)
    joint = role == "joint"
    scales = checkpoint.joint_scales if joint else checkpoint.scales
    reads_geometry = network.uses_geometry and not checkpoint.pressing  # with steps of depth these are conditions
    return ModelCard(
        name=f"{checkpoint.name}-{role}",
        role=role,
        form=form,
        frame=checkpoint.sensor.rectified,
        markers=checkpoint.sensor.markers if network.reads_markers else None,
        sensor=checkpoint.sensor,
        pressing=checkpoint.pressing,
        frames_per_decision=checkpoint.pressing.steps_n if checkpoint.pressing else FRAMES_PER_DECISION,
        state_size=network.state_size if form == "step" else 0,
        classes=CLASSES,
        threshold_x_mm=THRESHOLD_X_MM,
        threshold_theta_deg=THRESHOLD_THETA_DEG,
        gap_width_input=reads_geometry,
        grasp_height_input=reads_geometry,
        has_sigma=role in ("magnitude", "pair"),
        grid_x_mm=GRID_X_MM if joint else (),
        grid_theta_deg=GRID_THETA_DEG if joint else (),
        calibration=Calibration(
            temperature=scales.temperature, sigma_scale_x=scales.sigma_x, sigma_scale_theta=scales.sigma_theta
        ),
        expectations=checkpoint.expectations,
        training_data_sha256=checkpoint.training_data_sha256,
        git_commit=checkpoint.git_commit,
        training_run=checkpoint.run | ({UNTRAINED: why} if why else {}),
        validation=checkpoint.figures.get(f"joint/{OWN}" if joint else OWN, {}),
        verified_on_cpu=cpu_name(),
    )


def _example(network: Any, checkpoint: Checkpoint, form: Form, batch: int) -> dict[str, torch.Tensor]:
    sensor, pressing = checkpoint.sensor, checkpoint.pressing
    grid = pressing.lattice if pressing else sensor.markers if network.reads_markers else None
    count = FRAMES_PER_DECISION
    golden = golden_markers(grid, count) if grid else golden_frames(sensor.rectified, count)
    frames = torch.from_numpy(golden)
    geometry = {"gap_width_mm": torch.full((batch, 1), 57.0), "grasp_height_mm": torch.full((batch, 1), 40.0)}
    geometry = geometry if network.uses_geometry else {}
    geometry = {"conditions": torch.tensor([CONDITIONS] * batch)} if pressing else geometry
    if form == "sequence":
        return {"frames": frames[None].repeat(batch, 1, 1, 1, 1, 1), **geometry}
    state = torch.linspace(-0.5, 0.5, network.state_size).repeat(batch, 1)
    frame, reference = frames[5:6].repeat(batch, 1, 1, 1, 1), frames[:1].repeat(batch, 1, 1, 1, 1)
    return {"frame": frame, "reference": reference, "state": state, **geometry}


def _export(network: Any, checkpoint: Checkpoint, role: Role, form: Form, file: Path) -> None:
    wrapped: nn.Module = (SequenceForm if form == "sequence" else StepForm)(network, role).eval()
    example = _example(network, checkpoint, form, 2)
    strange = ["strangeness"] if checkpoint.pressing else []
    outputs = [*OUTPUTS[role], *strange, *(["next_state"] if form == "step" else [])]
    batch = torch.export.Dim("batch", min=1, max=1024)
    with warnings.catch_warnings(), torch.inference_mode(mode=False), torch.no_grad():
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            wrapped,
            kwargs=example,
            dynamo=True,
            opset_version=OPSET,
            input_names=list(example),
            output_names=outputs,
            dynamic_shapes={name: {0: batch} for name in example},
            custom_translation_table={torch.ops.tactile_insertion.block_sums.default: _block_sums},
            verbose=False,
        )
    assert program is not None
    DeduplicateInitializersPass(LARGEST_SHARED)(program.model)  # the same matrix sums both frames
    program.save(str(file))
    _check_parity(wrapped, example, file)
    attach_card(file, make_card(checkpoint, role, form, network))


def _block_sums(frames: Any, block: int) -> Any:
    """:func:`training.networks.preprocessing.block_sums` as one integer product: exact on every processor.

    The matrix for a block's rows is written as one row's and expanded when the file is loaded.
    """
    height, width = (int(size) for size in frames.shape[1:3])
    rows, columns = height // block, width // block
    if height % block:
        frames = op.Slice(frames, [0], [rows * block], [1])
    strips = op.Reshape(frames, op.Constant(value_ints=[-1, block * width * 3]))
    row = op.Constant(value=onnx.numpy_helper.from_array(selector(width, block)))
    sums = op.Cast(op.MatMulInteger(strips, op.Tile(row, op.Constant(value_ints=[block, 1]))), to=FLOAT)
    return op.Transpose(op.Reshape(sums, op.Constant(value_ints=[-1, rows, CHANNELS, columns])), perm=[0, 2, 1, 3])


def _check_parity(wrapped: nn.Module, example: dict[str, torch.Tensor], file: Path) -> None:
    onnx.checker.check_model(str(file), full_check=True)
    with torch.no_grad():
        expected = wrapped(**example)
    run = session(file)
    got = run.run(None, {name: value.numpy() for name, value in example.items()})
    for output, tensor, array in zip(run.get_outputs(), expected, got, strict=True):
        gap = float(np.abs(tensor.numpy() - array).max() / max(1.0, np.abs(array).max()))
        most = STATE_TOLERANCE if output.name == "next_state" else TOLERANCE
        if not gap <= most:
            what = f"{file.name}: {output.name} of torch and onnxruntime"
            raise ContractError(f"{what} differ by {gap:.2e}, expected at most {most:g}")


def attach_card(file: Path, card: ModelCard) -> None:
    """Write the card, with the network's self-test answers, into the file's metadata, as the file's last change."""
    run = session(file)
    names = [output.name for output in run.get_outputs()]
    tested = make_self_test(card, lambda inputs: dict(zip(names, run.run(names, inputs), strict=True)))
    model = onnx.load(str(file))
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, card.model_copy(update={"self_test": tested}).to_props())
    model.ir_version = min(model.ir_version, IR)
    for part in (model.graph, *model.graph.node, *model.graph.value_info, *model.graph.input, *model.graph.output):
        del part.metadata_props[:]  # traces of the exporter, which older formats do not know
    onnx.save(model, str(file))
    open_model(file)
