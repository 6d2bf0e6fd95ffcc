"""One finger of a live session over a simulated clip: fingers that close on an object, hold it and open again."""

import time

import numpy as np
import pytest

from service.contract import FrameSpec, Sensor, TactileFrame, wire
from service.decision.models import ModelSet
from service.perception.finger import TactileFinger
from service.perception.observation import Observation
from service.perception.rectification import Rectifier
from service.session.factory import make_session
from simulation.optics.renderer import Appearance, Renderer
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.worlds import load_scene
from tests.service import drawn

FREE, FREE_MINI = np.zeros((20, 21, 3), np.float32), np.zeros((7, 9, 3), np.float32)


@pytest.mark.parametrize(("name", "noise"), [("circle", 2.0), ("white_box", 6.0)])
def test_the_live_state_says_no_contact_while_the_gel_is_untouched_and_hold_while_it_is_not(name, noise) -> None:
    scene = load_scene(name, camera__noise_grey=noise)
    cell = QuasiStaticCell(scene, 1)
    cell.regrasp(3.0, 2.0)
    held = cell.look().gel[0].astype(np.float32)
    clip = [FREE] * 4 + [held * np.float32(share) for share in (0.3, 0.6)] + [held] * 6 + [FREE] * 4
    renderer = Renderer(Appearance.draw(scene, "left", 5))
    finger = TactileFinger("left", FrameSpec(height_px=320, width_px=327), renderer.calibration)
    observations: list[Observation] = []
    for k, gel in enumerate(clip):
        if k == 8:
            finger.rearm()
        pixels = renderer.raw(gel, k)
        observations.append(finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, pixels)))
    states = [observation.slip.state for observation in observations]
    assert set(states[:4]) == {"no_contact"}
    assert "no_contact" not in states[5:12]
    assert set(states[8:12]) == {"hold"}
    assert observations[12].slip.stop, "an object that is gone stops the arm, whatever it is called"
    assert set(states[13:]) == {"no_contact"}


def test_a_raw_frame_of_the_rectified_size_is_rectified() -> None:
    """Both have one size on the GelSight Mini. Unrectified, two real fingers of one gel show different grids."""
    scene = load_scene("circle", camera__sensor="gelsight_mini")
    renderer = Renderer(Appearance.draw(scene, "left", 4))
    sensor, raw = scene.sensor, renderer.raw(FREE_MINI, 0)
    assert raw.shape == sensor.rectified.shape
    finger = TactileFinger("left", sensor.rectified, renderer.calibration)
    observation = finger.observe(TactileFrame("left", 0, 0, raw))
    assert np.array_equal(observation.image, Rectifier(renderer.calibration).apply(raw))
    off_px = np.linalg.norm(observation.field.rest_px - sensor.marker_rest_px(), axis=-1)
    assert np.median(off_px) < 0.3
    plain = TactileFinger("left", sensor.rectified).observe(TactileFrame("left", 0, 0, raw))
    assert plain.image is raw, "without a calibration the camera delivers rectified frames"


def test_a_finger_has_no_reference_until_it_is_asked_for_one() -> None:
    renderer, finger = drawn.renderer("left"), drawn.watch()
    for k, asked in enumerate((False, False, True)):
        if asked:
            finger.rearm()
        slip = finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, renderer.raw(drawn.gel(0.0), k))).slip
        assert (slip.state, slip.reason) == (("hold", "reference taken") if asked else ("unknown", "not armed"))


@pytest.mark.parametrize(("bulge", "state"), [(1.8, "no_contact"), (2.2, "release")])
def test_a_gel_that_comes_to_rest_has_let_go_of_what_bulged_it_by_twice_an_open_ones_limit(bulge, state) -> None:
    """Less may have been no object at all."""
    renderer, finger = drawn.renderer("left"), drawn.watch()
    finger.learn_open(TactileFrame("left", 0, 0, renderer.raw(FREE, 0)))
    finger.rearm()
    gripped = FREE + np.float32([bulge * 0.019, 0.0, 0.0])  # mm, of which an open gel's limit is that much
    held, free = (
        finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, renderer.raw(gel, k)))
        for k, gel in enumerate((gripped, FREE), 1)
    )
    assert held.bulge == pytest.approx(bulge, abs=0.1)
    assert free.slip.state == state


def test_the_parts_of_a_frames_cost_are_no_more_than_its_time() -> None:
    renderer, finger = drawn.renderer("left"), drawn.watch()
    for k in range(3):
        frame = TactileFrame("left", k, k * drawn.PERIOD_NS, renderer.raw(FREE, k))
        began_s = time.perf_counter()
        parts_ms = finger.observe(frame).cost_ms
        whole_ms = 1e3 * (time.perf_counter() - began_s)
        assert parts_ms.keys() == {"rectify", "markers", "slip", "imprint"}
        assert min(parts_ms.values()) >= 0.0
        assert 0.0 < sum(parts_ms.values()) < whole_ms


def test_a_push_that_brings_home_markers_which_a_weight_had_moved_is_no_release() -> None:
    """The object still presses the gel, as its picture shows; only open, the gel is let go."""
    renderer, finger = drawn.renderer("left"), drawn.watch()
    pressed, sagging = FREE.copy(), FREE.copy()
    pressed[..., 2] = drawn.gel(0.0)[..., 2]
    sagging[..., 1] = 0.05 * Sensor.load().marker_pitch_mm
    finger.learn_open(TactileFrame("left", 0, 0, renderer.raw(FREE, 0)))
    finger.rearm()
    stops = []
    for k, gel in enumerate([*[pressed + share * sagging for share in (1.0, 1.0, 0.6, 0.3, 0.0)], FREE, FREE], 1):
        observation = finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, renderer.raw(gel, k)))
        stops.append(observation.slip.stop)
    assert stops[:5] == [False] * 5
    assert any(stops[5:])


def test_a_gel_that_hides_rows_when_it_is_gripped_keeps_the_grid_of_the_open_gel() -> None:
    finger = drawn.watch()
    assert finger.learn_open(TactileFrame("left", 0, 0, drawn.untouched("left"))) == ""
    shapes = []
    for k in range(1, 6):
        pixels = drawn.raw("left", k, 10, 16).copy()
        if k < 4:
            pixels[:, : pixels.shape[1] // 3] = 90  # a third of the gel is stretched until nothing is round
        shapes.append(finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, pixels)).field)
    assert {field.valid.shape for field in shapes} == {(20, 21)}
    assert shapes[0].valid[:, :4].mean() < 0.3, "what is hidden is not measured"
    assert shapes[-1].valid.mean() > 0.9, "and is found again"
    assert np.abs(shapes[-1].displacement_px[shapes[-1].valid]).max() < 0.6 * shapes[-1].pitch_px


def test_an_empty_hand_is_not_armed(models: ModelSet) -> None:
    session, messages = make_session(models, drawn.calibration()), []
    session.handle(wire.ClientHello(insertion_id="empty", client="test"), 0)
    session.handle(wire.LearnOpen(insertion_id="empty"), 0)
    for index in range(4):
        stamp_ns = index * drawn.PERIOD_NS
        frames = (TactileFrame(f, index, stamp_ns, drawn.renderer(f).raw(FREE, index)) for f in ("left", "right"))
        messages += session.on_pair(drawn.FramePair(*frames), stamp_ns)
        if index == 0:
            messages += session.handle(
                wire.Arm(insertion_id="empty", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), 1
            )
    assert [message.type for message in messages] == ["open_learnt", "refused"]
    assert (messages[-1].reason, messages[-1].detail) == (
        "nothing_held",
        "both gels look as they do when nothing touches them",
    )


def gripped() -> np.ndarray:
    cell = QuasiStaticCell(load_scene("circle"), 1)
    cell.regrasp(3.0, 2.0)
    return cell.look().gel.astype(np.float32)


def test_a_gripped_gel_that_was_taken_for_an_open_one_looks_touched_once_that_is_forgotten() -> None:
    renderer, finger, held = drawn.renderer("left"), drawn.watch(), gripped()[0]
    assert finger.learn_open(TactileFrame("left", 0, 0, renderer.raw(held, 0))) == ""
    feels = []
    for k, gel in enumerate([held, held, held, FREE], 1):
        if k == 3:
            finger.forget_open()
        feels.append(finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, renderer.raw(gel, k))).feels)
    assert feels == [False, False, True, False]


def weight_alone() -> np.ndarray:
    """A light object in stiff gels, which bulge by less than an open gel may show."""
    down = np.stack([FREE, FREE])
    down[..., 1] = 0.012 * Sensor.load().marker_pitch_mm
    return down


@pytest.mark.parametrize(
    ("grasp", "pushed_pitch", "gone"),
    [(gripped, 0.0, 5), (weight_alone, 0.0, 5), (gripped, 0.1, 5), (gripped, 0.0, 2)],
    ids=["grip", "weight", "pushed", "at once"],
)
def test_an_emptied_hand_stops_the_arm_within_three_frames(grasp, pushed_pitch, gone, models: ModelSet) -> None:
    """Even if the object was pushed up before, as one is that is put down, or falls as soon as the attempt is armed."""
    held, pushed = grasp(), np.zeros(3, np.float32)
    pushed[1] = pushed_pitch * Sensor.load().marker_pitch_mm
    session = make_session(models, drawn.calibration())
    messages: dict[int, list[str]] = {}
    session.handle(wire.ClientHello(insertion_id="drop", client="test"), 0)
    session.handle(wire.LearnOpen(insertion_id="drop"), 0)
    for index in range(9):
        stamp_ns = index * drawn.PERIOD_NS
        gels = held + pushed * (1 if index < 3 else -1) if 1 <= index < gone else np.stack([FREE, FREE])
        frames = (
            TactileFrame(finger, index, stamp_ns, drawn.renderer(finger).raw(gel, index))
            for finger, gel in zip(("left", "right"), gels, strict=True)
        )
        answers = session.on_pair(drawn.FramePair(*frames), stamp_ns)
        messages[index] = [getattr(answer, "code", answer.type) for answer in answers]
        if index == 0:
            session.handle(wire.Arm(insertion_id="drop", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), 1)
        if index == 1:
            session.handle(wire.Descending(insertion_id="drop", attempt=1, speed_mm_s=10.0), stamp_ns)
    assert messages[1] == ["armed"]
    assert not any("part_lost" in messages[index] for index in range(gone))
    lost = [index for index in range(9) if "part_lost" in messages[index]]
    assert lost == [gone + 1], "within three frames, and said once"
