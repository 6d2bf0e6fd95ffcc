"""One insertion as a picture: the frames of both fingers in each attempt, and the belief of the controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from simulation.closed_loop.figures import draw_filmstrip
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import Insertion, models_of, stage


class _Album:
    """Listens to a session: pictures at the end of each attempt, and the belief that led to its move."""

    def __init__(self, play: Insertion) -> None:
        self.pages: list[dict[str, Any]] = []
        self._play = play
        self._command: Any = None
        play.session.on_attempt = self.attempt
        play.session.on_command = self.command

    def command(self, command: Any) -> None:
        """The move comes before its attempt is closed."""
        self._command = command

    def attempt(self, attempt: Any) -> None:
        """Keep the reference and the last frames of a `service.decision.attempt.Attempt`."""
        if attempt.reference is None:
            return
        last = attempt.decision_pairs[-1] if attempt.decision_pairs else attempt.ring[-1]
        inserted = attempt.outcome == "inserted"
        frames = [
            ("left, held", attempt.reference.left.image),
            ("left, inserted" if inserted else "left, stopped", last.left.image),
            ("right, inserted" if inserted else "right, stopped", last.right.image),
        ]
        page: dict[str, Any] = {"frames": frames, "belief": None, "error": self._play.before.object_error, "move": None}
        if self._command is not None and not inserted:
            belief = self._command.belief
            page["move"] = self._command.dx_mm, self._command.dtheta_deg
            page["belief"] = None if belief is None else (belief.x_mm, belief.theta_deg, belief.probability)
        self._command = None
        self.pages.append(page)


def film(job: Job, models: Path, path: Path) -> None:
    """Play a job with pictures and draw its filmstrip."""
    play = stage(job, models_of(models))
    album = _Album(play)
    outcome = play.run()
    end = f"inserted after {outcome.attempts} attempts" if outcome.inserted else f"not inserted: {outcome.reason}"
    start = f"start error {job.x_mm:+.1f} mm, {job.theta_deg:+.1f} deg"
    draw_filmstrip(album.pages, f"{Path(job.scene).stem} (simulated), {start}, {end}", path)
