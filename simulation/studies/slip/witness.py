"""The slide witness on real grasps: fitted without each object in turn, and its limit chosen without it, too.

A run counts by its most suspicious frame, so only the frames that look most like a slide are fitted: in a lost run,
those between the visible slide and five frames before the loss; in a held one, all until the release.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.perception.slip.phases import EMPTY_N, ENDED
from service.perception.slip.slide import READ_N, TERMS, slide_score

Row = Mapping[str, Any]
Float64 = NDArray[np.float64]
SETTLED_N = 4  # frames after contact, or after the start of a recording in contact
AHEAD_N = 5  # frames by which a slide has to be reported before the loss
LET_GO_N = 6  # last frames before the release of a held object, which count as neither
FURTHER = 1.25  # a motion this many times the largest of any held object is too far
FALSE_RUNS = 2  # alarms in the held runs for choosing a limit; one more may come from others
WINDOW_N = 16  # frames in 2 s
_RIDGE = 1.0
_ROUNDS, _POSITIVE_N, _NEGATIVE_N, _EVERY = 8, 2, 4, 25


def object_of(run: str) -> str:
    """The object of a run, whose name is OBJECT_NUMBER_KIND."""
    return run.rsplit("_", 2)[0]


@dataclass(frozen=True, slots=True)
class Run:
    """One grasp's terms [frames, terms], the frames for fitting, and the start of its slide if it is lost.

    ``live``: the frames in which a slide turns the phase to slip, without those of ``borne``, in which something else
    bears the object; ``before``: from where on an alarm is too late.
    """

    name: str
    terms: Float64
    begin: int
    end: int
    slide: int | None
    live: tuple[int, int]
    borne: tuple[int, ...]
    before: int

    @property
    def object(self) -> str:
        return object_of(self.name)

    def alarms(self, scores: Float64) -> NDArray[np.intp]:
        """Frames with an alarm."""
        frames = np.arange(*self.live)[scores[slice(*self.live)] >= 0]
        return frames[~np.isin(frames, self.borne)]


def runs_of(rows: Sequence[Row], labels: Row, evidence: Mapping[str, Any]) -> list[Run]:
    """Held runs, and those with a visible slide before a loss."""
    runs = []
    for row in rows:
        name, hold = row["run"], row["hold_frame"]
        terms = np.array([[np.nan] * len(TERMS) if one is None else one for one in evidence[name]])
        known = int(np.isfinite(terms).all(1).argmax())
        if label := labels["slip"].get(name):
            if label["lost"] is None or label["slide"] is None:
                continue
            begin, end = label["contact"] + SETTLED_N, label["lost"] - AHEAD_N + 1
        else:
            emptied = labels["held"].get(name, {}).get("emptied") or len(terms)
            begin, end = hold if hold is not None and hold < 60 else SETTLED_N, emptied - LET_GO_N
        begin = max(begin, known + 1, 6)
        live = (0, 0) if hold is None else (hold + 1, _over(row, len(terms)))
        slide = label["slide"] if label else None
        runs.append(Run(name, terms, begin, max(begin, end), slide, live, tuple(row["borne_frames"]), end))
    return runs


def _over(row: Row, frames_n: int) -> int:
    """The first empty frame of a grasp that has ended, or else the end of the recording."""
    ends = [row[f"{end}_frame"] for end in ENDED if row[f"{end}_frame"] is not None]
    return min([end - EMPTY_N + 1 for end in ends], default=frames_n)


def fitted(runs: Sequence[Run]) -> Float64:
    """The model of `slide_score`; by its logistic, at most ``FALSE_RUNS`` of the held runs score above 0."""
    slides = [run.terms[max(run.begin, run.slide) : run.end, :READ_N] for run in runs if run.slide is not None]
    slides = [one for one in slides if len(one)]
    held = [run.terms[run.begin : run.end] for run in runs if run.slide is None]
    furthest = max(float(one[:, -1].max()) for one in held)
    holds = [one[:, :READ_N] for one in held]
    every = np.concatenate([*slides, *holds])
    mean, spread = every.mean(0), every.std(0)
    slides, holds = ([(one - mean) / spread for one in ones] for ones in (slides, holds))
    weights = np.eye(every.shape[1])[0]
    for _ in range(_ROUNDS):
        positive = np.concatenate([_most(one, weights, _POSITIVE_N) for one in slides])
        negative = np.concatenate([_most(one, weights, _NEGATIVE_N) for one in holds])
        usual = np.concatenate([one[::_EVERY] for one in holds])
        shares = np.repeat([1 / _POSITIVE_N, 1 / _NEGATIVE_N, 0.02], [len(positive), len(negative), len(usual)])
        labels = np.arange(len(shares)) < len(positive)
        weights = _logistic(np.concatenate([positive, negative, usual]), labels, shares)
    raw = weights / spread
    highest = np.sort([float((one @ weights).max()) for one in holds])[::-1]
    limit = highest[min(FALSE_RUNS, len(highest) - 1)]
    return np.array([*raw, -raw @ mean - limit, furthest + np.log(FURTHER)])


def _most(frames: Float64, weights: Float64, count: int) -> Float64:
    return np.asarray(frames[np.argsort(-(frames @ weights))[:count]])


def _logistic(terms: Float64, labels: NDArray[np.bool_], shares: Float64) -> Float64:
    """Weights of a ridge logistic regression, by Newton's method; the limit provides its bias."""
    columns = np.column_stack([terms, np.ones(len(terms))])
    ridge = np.diag([_RIDGE] * terms.shape[1] + [1e-6])
    weights = np.zeros(columns.shape[1])
    for _ in range(60):
        chance = 1 / (1 + np.exp(-np.clip(columns @ weights, -30, 30)))
        slope = columns.T @ (shares * (chance - labels)) + ridge @ weights
        bend = (columns * (shares * chance * (1 - chance) + 1e-9)[:, None]).T @ columns + ridge
        weights -= np.linalg.solve(bend, slope)
    return weights[:-1]


def without_each_object(runs: Sequence[Run]) -> dict[str, Any]:
    """Every run evaluated with a model and limits that never saw its object."""
    scores: dict[str, Float64] = {}
    for left_out in sorted({run.object for run in runs}):
        model = fitted([run for run in runs if run.object != left_out])
        scores |= {run.name: slide_score(run.terms, model) for run in runs if run.object == left_out}
    slides = [run for run in runs if run.slide is not None]
    holds = [run for run in runs if run.slide is None]
    alarms = {run.name: run.alarms(scores[run.name]) for run in runs}
    alarmed = {run.name: bool((alarms[run.name] < run.before).any()) for run in runs}
    frames_n = sum(run.end - run.begin for run in holds)
    counted = {run.name: scores[run.name][run.begin : run.end] for run in runs}
    return {
        "warned": [alarmed[run.name] for run in slides],
        "early": sum(bool(alarms[run.name][0] < (run.slide or 0)) for run in slides if alarmed[run.name]),
        "untellable": sum(max(run.begin, run.slide or 0) >= run.end for run in slides),
        "false": [alarmed[run.name] for run in holds],
        "false_anywhere": [len(alarms[run.name]) > 0 for run in holds],
        "over": {run.name: np.flatnonzero(scores[run.name] >= 0).tolist() for run in runs},
        "false_runs": sorted(run.name for run in holds if alarmed[run.name]),
        "false_frames_per_1000": 1000 * sum(int((alarms[run.name] < run.before).sum()) for run in holds) / frames_n,
        "auc": _auc(*([counted[run.name] for run in some] for some in (slides, holds))),
        "short": _of(alarmed, slides, holds, short=True),
        "long": _of(alarmed, slides, holds, short=False),
    }


def _of(alarmed: Mapping[str, bool], slides: Sequence[Run], holds: Sequence[Run], *, short: bool) -> list[list[bool]]:
    """Alarms of slides and holds among the recordings of one kind: cut to the grasp, or of 450 frames."""
    return [[alarmed[run.name] for run in runs if (len(run.terms) < 450) == short] for runs in (slides, holds)]


def _auc(slides: Sequence[Float64], holds: Sequence[Float64]) -> float:
    """Chance that the last 2 s before a loss score higher than any 2 s of a held run."""
    last = [float(one[-(WINDOW_N - AHEAD_N) :].max()) for one in slides if len(one)]
    held = [
        [float(one[k : k + WINDOW_N - AHEAD_N].max()) for k in range(0, max(1, len(one) - WINDOW_N), WINDOW_N)]
        for one in holds
        if len(one)
    ]
    return float(np.mean([np.mean([np.mean(np.array(one) < score) for one in held]) for score in last]))
