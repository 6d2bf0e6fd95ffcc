"""What the slip path costs a finger: rectify, track, detect contact, slip and onset, on raw simulated frames."""

import time

import numpy as np

from service.contract import FINGERS
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import Rectifier
from service.perception.slip.detector import SlipDetector
from service.perception.slip.onset import OnsetDetector
from service.perception.slip.open_gel import OpenGel
from simulation.optics.renderer import Appearance, Renderer
from simulation.studies.slip.trials import draw_trials


def cost_ms(trials: int, seed: int, fps: int) -> dict[str, float]:
    """CPU ms a frame of one finger, one thread: median and 95th percentile over ``trials`` descents."""
    spent = []
    for trial in draw_trials(trials, seed, fps):
        for finger, name in enumerate(FINGERS):
            renderer = Renderer(Appearance.draw(trial.scene, name, trial.seed))
            rectifier = Rectifier(renderer.calibration)
            tracker, free, slip, onset = MarkerTracker(), OpenGel(), SlipDetector(), OnsetDetector()
            for k, gel in enumerate(trial.gel):
                raw = renderer.raw(gel[finger], trial.seed + k)
                begun = time.process_time()
                field = tracker.update(rectifier.apply(raw), round(k * 1e9 / fps))
                if k == 0:
                    slip.rearm(field)
                    onset.rearm(field)
                    continue
                slip.update(free.mark(field))
                onset.update(field)
                spent.append(1e3 * (time.process_time() - begun))
    return {"median": float(np.median(spent)), "p95": float(np.percentile(spent, 95)), "frames": len(spent)}
