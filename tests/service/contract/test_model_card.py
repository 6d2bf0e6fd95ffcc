import json

import pytest

from service.contract import CARD_KEY, ContractError, ErrorClass, FrameSpec, ModelCard
from service.contract.model_card import Lattice, Pressing, Span

CARD = ModelCard(
    name="compact",
    role="direction",
    form="step",
    frame=FrameSpec(height_px=320, width_px=327),
    frames_per_decision=8,
    state_size=96,
    classes=(
        ErrorClass(name="1", sign_x=-1, sign_theta=0),
        ErrorClass(name="2", sign_x=1, sign_theta=0),
    ),
    training_data_sha256="0" * 64,
    git_commit="0" * 40,
    validation={"accuracy": 0.7},
    verified_on_cpu="test",
)


def test_a_card_survives_the_metadata_beside_strangers():
    assert ModelCard.from_props(CARD.to_props() | {"onnx.infer": "something else"}) == CARD


def test_a_missing_card_says_how_to_make_one():
    with pytest.raises(ContractError, match=r"m\.onnx carries no model card .*python -m export onnx"):
        ModelCard.from_props({}, "m.onnx")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"schema_version": 2}, "schema_version"),
        ({"frames_per_decision": 0}, "frames_per_decision"),
        ({"stranger": 1}, "stranger"),
        ({"classes": []}, "two classes"),
        ({"state_size": 0}, "state_size"),
        ({"threshold_x_mm": -1.0}, "threshold_x_mm"),
        ({"threshold_theta_deg": 15.0}, "threshold_theta_deg"),
        ({"classes": [{"name": name, "sign_x": 1, "sign_theta": 0} for name in "12"]}, "two have the same signs"),
        ({"role": "joint", "grid_x_mm": [1.0, 0.0], "grid_theta_deg": [0.0, 1.0]}, "must rise"),
        ({"role": "joint", "grid_x_mm": [0.0, 1.0], "grid_theta_deg": [0.0, 0.0]}, "must rise"),
        ({"validation": {"accuracy": None}}, "validation.accuracy"),
        ({"expectations": {"tolerance": [1e6, 3.5]}}, "expectations.tolerance"),  # its belief filled the memory
    ],
)
def test_a_bad_field_is_named(change, named):
    props = {CARD_KEY: json.dumps(json.loads(CARD.model_dump_json()) | change)}
    with pytest.raises(ContractError, match=named):
        ModelCard.from_props(props)


def test_cards_that_disagree_say_on_what():
    other = CARD.model_copy(update={"name": "other", "frames_per_decision": 4})
    assert CARD.disagreements(CARD) == []
    (sentence,) = CARD.disagreements(other)
    assert sentence == "frames_per_decision: compact says 8, other says 4"


def test_networks_trained_on_other_ranges_can_answer_beside_each_other_but_not_in_one_decision():
    spec = Pressing(lattice=Lattice(rows=9, columns=9, pitch_mm=1.5), step_mm=0.15, steps_n=8, trained={})
    wider = spec.model_copy(update={"trained": {"speed_mm_s": Span(low=3, high=40)}, "strangeness_limit": 4.0})
    ours, theirs, coarser = (
        CARD.model_copy(update={"pressing": one}) for one in (spec, wider, spec.model_copy(update={"step_mm": 0.2}))
    )
    assert ours.incomparable(theirs) == []
    assert len(ours.disagreements(theirs)) == 1
    assert ours.incomparable(coarser) == ["pressing: compact says step_mm 0.15, compact says step_mm 0.2"]
    assert ours.incomparable(CARD) == ["input: compact reads steps of depth, compact reads pictures"]
