"""The watch takes its own reference: from the present grasp, not from open fingers."""

import numpy as np
import pytest

from service.perception.slip.grasp import GraspWatch
from tests.service.perception.synthetic import FRAME_NS, patch_fields, pressed, rigid


def renumbered(*parts):
    fields = [field for part in parts for field in part]
    for k, field in enumerate(fields):
        object.__setattr__(field, "captured_ns", k * FRAME_NS)
    return fields


def at(field, frames, displacement):
    """The object held at rest where ``field`` left it."""
    rest, _ = patch_fields(lambda _k, rest: np.zeros_like(rest), frames=frames, seed=7)
    for one in rest:
        object.__setattr__(one, "displacement_px", one.displacement_px + displacement)
    return rest


def test_the_reference_is_taken_again_once_the_grasp_has_settled_elsewhere():
    opened, _ = patch_fields(rigid(), frames=20)
    closing, _ = patch_fields(rigid((0, 1.0), 0.3), frames=8, seed=2)
    lifting, _ = patch_fields(rigid((0.5, 1.2), 0.3), frames=8, seed=3)
    held = at(closing[-1], 20, closing[-1].displacement_px)
    for field in lifting:
        object.__setattr__(field, "displacement_px", field.displacement_px + closing[-1].displacement_px)
    lifted = at(lifting[-1], 20, lifting[-1].displacement_px)
    watch = GraspWatch()
    fields = renumbered(opened, closing, held, lifting, lifted)
    states = [watch.update(field) for field in fields]
    assert {state.state for state in states[:20]} == {"no_contact"}, "open fingers are no grasp to refer to"
    taken = [k for k, state in enumerate(states) if state.reason == "reference taken"]
    assert len(taken) == 2
    assert 27 < taken[0] < 48
    assert taken[1] > 55
    assert watch.detector.reference is fields[taken[1]]
    assert states[-1].state == "hold"


@pytest.mark.parametrize(("status", "begins"), [("lost", 9), ("duplicate", 0)])
def test_rest_is_counted_anew_after_the_markers_were_lost_but_not_after_a_repeated_frame(status, begins):
    fields, _ = patch_fields(pressed(rigid()), frames=30)
    object.__setattr__(fields[8], "status", status)
    watch = GraspWatch()
    states = [watch.update(field) for field in renumbered(fields)]
    taken = next(k for k, state in enumerate(states) if state.reason == "reference taken")
    assert (taken - begins - 1) * FRAME_NS < 0.4e9 <= (taken - begins + 1) * FRAME_NS


def test_slip_of_a_held_object_is_announced_without_a_robots_word():
    held, _ = patch_fields(pressed(rigid()), frames=20)
    sliding, _ = patch_fields(pressed(rigid((0, 1.5), 0.7)), hold_px=14, seed=3)
    watch = GraspWatch()
    states = [watch.update(field) for field in renumbered(held, sliding)]
    assert not any(state.slip for state in states[:24])
    assert any(state.slip for state in states[24:])
