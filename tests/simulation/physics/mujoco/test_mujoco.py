"""An independent engine on the same pokes: contact force and rotation in the hand. docs/mujoco.md has the figures."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.simulation.physics.mujoco.bench import COARSER, LOAD_STEPS_MM, compare, mujoco_table, ours, theirs
from tests.simulation.physics.mujoco.scenes import DEEP, SHALLOW, Poke

DOCS = Path(__file__).parents[4] / "docs"
PUBLISHED = json.loads((DOCS / "mujoco.json").read_text())
POKES = (*SHALLOW, *DEEP)
AGREEING = [poke for poke, row in zip(POKES, PUBLISHED, strict=True) if row["agree"]]
OTHERS = [poke for poke in POKES if poke not in AGREEING]


def named(poke: Poke) -> str:
    return f"{poke.scene} {poke.x_mm:g}, {poke.theta_deg:g}, {poke.varied}, tips apart: {poke.apart}"


@pytest.mark.slow
def test_a_quick_mujoco_run_agrees_within_a_hundredth() -> None:
    poke = Poke("hexagon", 10.0, 0.0)
    cell, mine = ours(poke, LOAD_STEPS_MM[0])
    other = theirs(poke, cell, COARSER[0])
    np.testing.assert_allclose(other.force_n, mine.force_n, atol=0.01 * np.linalg.norm(mine.force_n))
    np.testing.assert_allclose(other.turn_deg, mine.turn_deg, atol=0.01 * np.linalg.norm(mine.turn_deg))


def test_the_published_comparison_covers_every_poke_and_at_least_four_differing_scenes_agree() -> None:
    assert [(row["scene"], row["varied"], row["tips_apart"]) for row in PUBLISHED] == [
        (poke.scene, poke.varied, poke.apart) for poke in POKES
    ]
    for row in PUBLISHED:
        force = row["force_apart_n"] <= sum(row["force_errors_n"])
        assert row["agree"] == (force and row["turn_apart_deg"] <= sum(row["turn_errors_deg"]))
    page = (DOCS / "mujoco.md").read_text()
    assert mujoco_table(PUBLISHED[: len(SHALLOW)]).markdown() in page
    assert mujoco_table(PUBLISHED[len(SHALLOW) :]).markdown() in page
    scenes = {(poke.scene, poke.x_mm, poke.theta_deg, tuple(poke.changes.items())) for poke in AGREEING}
    assert len(scenes) >= 4


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("poke", AGREEING, ids=named)
def test_both_engines_agree_within_the_sum_of_their_refinement_errors(poke: Poke) -> None:
    assert compare(poke).agree


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("poke", OTHERS, ids=named)
def test_where_they_do_not_they_are_within_a_few_hundredths(poke: Poke) -> None:
    comparison = compare(poke)
    assert comparison.force_apart_n < 0.05 * comparison.force_n[0]
    assert comparison.turn_apart_deg < 0.01 * comparison.turn_deg[0]
