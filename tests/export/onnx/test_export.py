import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest

from export.cli.commands import main
from export.onnx.golden import golden_frames
from export.onnx.model import open_model
from export.onnx.to_onnx import attach_card, export_checkpoint
from export.onnx.verify import decide, verify
from service.contract import ContractError, ModelCard
from service.contract.self_test import check_self_test
from service.decision.evidence import DecisionRun
from service.decision.models import load_models
from tests.export.conftest import export_tiny


@pytest.mark.slow
def test_every_role_is_written_in_its_forms(tmp_path):
    export_tiny(tmp_path)
    files = {str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*.onnx")}
    pair = {f"{role}.{form}.onnx" for role in ("direction", "magnitude") for form in ("step", "sequence")}
    assert files == pair | {"joint/joint.step.onnx", "joint/joint.sequence.onnx", "pair/pair.step.onnx"}
    assert sum(" = " in line for line in verify(tmp_path, STEPS) + verify(tmp_path / "joint", STEPS)) == 3


def test_files_are_written_with_their_cards(models):
    cards = {file.name: open_model(file).card for file in models.glob("*.onnx")}
    assert cards["direction.step.onnx"].disagreements(cards["magnitude.step.onnx"]) == []
    assert cards["magnitude.step.onnx"].has_sigma
    assert cards["direction.step.onnx"].state_size == 16
    assert cards["direction.sequence.onnx"].calibration.temperature == 1.5
    assert cards["direction.step.onnx"].validation == {"accuracy": 0.5}
    untrained = {"untrained": "its directions were never validated"}
    assert cards["direction.step.onnx"].training_run == {"seed": 0} | untrained


STEPS = 50


def test_the_released_networks_weigh_little():
    """All released networks stay; a cell loads those that read depth."""
    files = list((Path(__file__).parents[3] / "models").rglob("*.onnx"))
    assert len(files) == 12
    new = [file for file in files if "pressing" in file.parts]
    assert sum(file.stat().st_size for file in new) < 3e6
    assert sum(file.stat().st_size for file in files if file not in new) < 15e6


def test_exported_networks_verify(models):
    lines = verify(models, STEPS)
    assert sum(" = " in line for line in lines) == 1
    assert sum("1 against 64 in a batch" in line for line in lines) == 2
    assert sum("self-test passed" in line for line in lines) == 3


def copy_with(card, file, place):
    """A model under another card, which need not be true."""
    model = onnx.load(str(file))
    onnx.helper.set_model_props(model, card.to_props())
    onnx.save(model, str(place))


def of_another_role(card):
    return card.model_copy(update={"role": "magnitude", "has_sigma": True})


def of_another_threshold(card):
    return card.model_copy(update={"threshold_x_mm": 3.0})


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (of_another_role, r"direction\.step\.onnx gives .*, its card promises \['error', 'log_sigma'\]"),
        (of_another_threshold, r"direction\.step\.onnx and magnitude\.step\.onnx disagree on threshold_x_mm"),
    ],
)
def test_what_the_service_refuses_does_not_verify(models, tmp_path, edit, named):
    for role in ("direction", "magnitude"):
        shutil.copy(models / f"{role}.step.onnx", tmp_path)
    file = tmp_path / "direction.step.onnx"
    copy_with(edit(open_model(file).card), file, file)
    with pytest.raises(ContractError):
        load_models(tmp_path)
    with pytest.raises(ContractError, match=named):
        verify(tmp_path, STEPS)


@pytest.mark.slow
def test_the_shipped_networks_verify_over_a_stream_of_10000_steps():
    for folder in ("models", "models/joint", "models/pictures", "models/pressing", "models/pressing/joint"):
        assert any("stream of 10000" in line for line in verify(Path(folder)))


def test_both_networks_in_one_graph_say_what_they_say_apart(models):
    frames = golden_frames(open_model(models / "direction.step.onnx").card.frame, 8)[None]
    together = decide(open_model(models / "pair" / "pair.step.onnx"), frames)
    for role, names in (("direction", ["logits"]), ("magnitude", ["error", "log_sigma"])):
        alone = decide(open_model(models / f"{role}.step.onnx"), frames)
        for name in names:
            np.testing.assert_allclose(together[name], alone[name], atol=1e-5)


def test_the_service_decides_with_both_networks_in_one_graph(models):
    chosen = load_models(models / "pair")
    assert [step.card.role for step in chosen.steps] == ["pair"]
    frames = golden_frames(chosen.card.frame, 8)
    evidence = []
    for folder in (models / "pair", models):
        run = DecisionRun(load_models(folder), frames[0], 56.0)
        for frame in frames:
            run.step(frame)
        evidence.append(run.evidence())
    np.testing.assert_allclose(evidence[0].probabilities, evidence[1].probabilities, atol=1e-5)


def test_the_joint_density_verifies_in_a_folder_of_its_own(models):
    assert any("stream of 50" in line for line in verify(models / "joint", STEPS))
    card = open_model(models / "joint" / "joint.step.onnx").card
    assert (len(card.grid_x_mm), len(card.grid_theta_deg)) == (41, 40)


def test_the_graphs_weigh_little(models):
    assert all(file.stat().st_size < 4e6 for file in models.glob("*.onnx"))


def test_a_card_that_promises_other_inputs_is_refused(models, tmp_path):
    path = models / "direction.step.onnx"
    card = open_model(path).card.model_copy(update={"gap_width_input": False})
    copy_with(card, path, tmp_path / "liar.onnx")
    with pytest.raises(ContractError, match="its card promises"):
        verify(tmp_path)


def test_nothing_is_exported_into_a_folder_that_a_service_would_then_refuse(tmp_path):
    """A network that reads depth, exported without --out, would stop the networks of models/ from loading."""
    there = Path(shutil.copy("models/direction.step.onnx", tmp_path))
    with pytest.raises(ContractError, match=r"a service loads no pair\.step\.onnx beside direction\.step\.onnx"):
        export_checkpoint(Path("models/pressing/checkpoint.pt"), tmp_path)
    assert list(tmp_path.iterdir()) == [there]


KILLED = """
import os, sys
from export.onnx import to_onnx
from tests.export.conftest import export_tiny
from pathlib import Path
to_onnx.verify_forms = lambda _: os._exit(9)
export_tiny(Path(sys.argv[1]), ("direction.step",))
"""


@pytest.mark.slow
def test_what_a_killed_export_left_is_not_measured_and_goes_with_the_next(tmp_path, monkeypatch):
    folder = tmp_path / "models"
    assert subprocess.run([sys.executable, "-c", KILLED, str(folder)], check=False).returncode == 9
    left = [file for file in folder.rglob("*.onnx") if file.parent != folder]
    assert [file.name for file in left] == ["direction.step.onnx"], "it was killed in the middle"
    monkeypatch.chdir(tmp_path)
    assert main(["benchmark", "--seconds", "0.02"]) == 2, "there is nothing to measure"
    export_tiny(folder, ("direction.step",))
    assert list(tmp_path.rglob("*.onnx")) == [folder / "direction.step.onnx"]


def test_an_empty_folder_is_named(tmp_path):
    with pytest.raises(ContractError, match=r"no \.onnx file"):
        verify(tmp_path)


def test_a_model_whose_two_forms_differ_is_refused(models, tmp_path):
    for name in ("direction.step.onnx", "direction.sequence.onnx"):
        (tmp_path / name).write_bytes((models / name).read_bytes())
    path = tmp_path / "direction.step.onnx"
    model = onnx.load(str(path))
    for tensor in model.graph.initializer:
        if tensor.name.endswith("direction.bias"):
            shifted = onnx.numpy_helper.to_array(tensor) + 1
            tensor.CopyFrom(onnx.numpy_helper.from_array(shifted.astype(np.float32), tensor.name))
    card = open_model(path).card
    onnx.save(model, str(path))
    attach_card(path, card)
    with pytest.raises(ContractError, match="differ by"):
        verify(tmp_path, STEPS)


def test_a_wrong_dtype_or_shape_is_named(models):
    model = open_model(models / "direction.sequence.onnx")
    assert isinstance(model.card, ModelCard)
    for bad, message in (
        (np.zeros((1, 8, 2, 320, 327, 3), np.float32), r"frames is float32\[1, 8, 2, 320, 327, 3\], expected uint8"),
        (np.zeros((1, 8, 2, 319, 327, 3), np.uint8), r"319.*expected uint8\[B, 8, 2, 320, 327, 3\]"),
        (np.zeros((1, 8, 2, 320, 327), np.uint8), r"expected uint8\[B, 8, 2, 320, 327, 3\]"),
    ):
        with pytest.raises(ContractError, match=message):
            decide(model, bad)
    with pytest.raises(
        ContractError, match=r"was given \['frame'\], expected \['frames', 'gap_width_mm', 'grasp_height_mm'\]"
    ):
        model({"frame": np.zeros((1, 2, 320, 327, 3), np.uint8)})


def test_an_opset_that_old_runtimes_cannot_read_is_named(models, tmp_path):
    model = onnx.load(str(models / "direction.step.onnx"))
    model.opset_import[0].version = 21
    onnx.save(model, str(tmp_path / "old.onnx"))
    with pytest.raises(ContractError, match=r"old\.onnx is of opset 21, expected at most 20"):
        verify(tmp_path)
    model.opset_import[0].version = 99
    onnx.save(model, str(tmp_path / "old.onnx"))
    with pytest.raises(ContractError, match=r"old\.onnx is not a model this runtime can open"):
        verify(tmp_path)


def test_a_network_that_computes_otherwise_than_where_it_was_released_is_refused(models, tmp_path):
    path = models / "magnitude.step.onnx"
    card = open_model(path).card
    test = card.self_test.model_copy(update={"outputs": {"error": (9.0, 9.0), "log_sigma": (0.0, 0.0)}})
    copy_with(card.model_copy(update={"self_test": test}), path, tmp_path / path.name)
    with pytest.raises(ContractError, match="self-test output error is off by"):
        verify(tmp_path)
    with pytest.raises(ContractError, match="computes otherwise than the one it was released on"):
        load_models(tmp_path)


def test_an_int8_file_without_a_self_test_is_refused(models):
    card = open_model(models / "direction.step.onnx").card
    bare = card.model_copy(update={"quantisation": "int8", "self_test": None})
    with pytest.raises(ContractError, match=r"x\.onnx is int8 and its card holds no self-test"):
        check_self_test(bare, lambda _: {}, "x.onnx")
