"""Four probes show how a cell is wired."""

from dataclasses import replace

import numpy as np
import pytest

from robot_client.session.commission.wiring import SIDES
from service.contract.shipped import released_models
from simulation.cli.drawn_worlds import drawn_worlds_of
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import insert, models_of
from simulation.scene.unstated import Unstated
from simulation.scene.worlds import load_objects
from simulation.studies.wiring import by_corner, named_mistakes, named_wirings, probes


def test_the_part_with_the_farthest_corner_is_probed_first_and_a_round_one_last(tmp_path):
    """A narrow part grows more when turned, but its corner is near the fingers' axis."""
    sizes = {"narrow": ("rectangle", 33.5, 96.7), "wide": ("rectangle", 113.1, 82.7), "round": ("ellipse", 90.9, 85.0)}
    for name, (shape, x_mm, y_mm) in sizes.items():
        text = (
            f'[object]\nshape = "{shape}"\nsize_x_mm = {x_mm}\nsize_y_mm = {y_mm}\nmass_kg = 0.2\ntexture = "smooth"\n'
        )
        (tmp_path / f"{name}.toml").write_text(text)
    order = by_corner(load_objects((str(tmp_path),)))
    assert [next(part for part in sizes if part in name) for name in order] == ["wide", "narrow", "round"]


def test_an_object_that_goes_in_from_a_probes_error_comes_last(tmp_path):
    """Its four probes would touch nothing."""
    box = '[object]\nshape = "rectangle"\nsize_x_mm = {}\nsize_y_mm = 100.0\n[blocks]\ngap_mm = {}\n'
    for name, sizes in {"wide": (80.0, 110.0), "tight": (60.0, 64.0)}.items():
        (tmp_path / f"{name}.toml").write_text(box.format(*sizes))
    order = by_corner(load_objects((str(tmp_path),)))
    assert [name.rpartition("/")[2] for name in order] == ["tight.toml", "wide.toml"]


def probe(x_mm, theta_deg, felt, sigma=1.5):
    """A row of a probe at a known error with the networks' answer ``said``."""
    estimate = {
        "dx_mm": felt[0],
        "dtheta_deg": felt[1],
        "sigma_x_mm": sigma,
        "sigma_theta_deg": sigma,
        "interval_x_mm": [felt[0] - 2, felt[0] + 2],
        "interval_theta_deg": [felt[1] - 2, felt[1] + 2],
    }
    return {"x_mm": x_mm, "theta_deg": theta_deg, "reason": "", "trials": [{"decision": {"estimate": estimate}}]}


def cell(sign_x, sign_theta, seed):
    rng = np.random.default_rng(seed)
    return [
        probe(x, theta, (sign_x * x + rng.normal(0, 1.5), sign_theta * theta + rng.normal(0, 2.0)))
        for x, theta in SIDES
    ]


@pytest.mark.parametrize("seed", range(20))
def test_a_good_cell_is_not_accused(seed):
    assert named_mistakes(cell(1, 1, seed)) == []


@pytest.mark.parametrize(
    ("signs", "cause"), [((-1, 1), "x reach the arm reversed"), ((1, -1), "yaw reach"), ((-1, -1), "mirrored")]
)
def test_a_reversed_cell_is_named(signs, cause):
    for seed in range(10):
        assert cause in named_mistakes(cell(*signs, seed))[0]


def test_probes_that_nobody_decided_are_told_and_a_refusal_names_its_cause():
    def undecided(reason, detail):
        return {"reason": "", "trials": [{"decision": {"reason": reason, "detail": detail}}]}

    refused, strange = (
        undecided("contradictory", "one picture is mirrored"),
        undecided("out_of_distribution", "strange"),
    )
    assert named_mistakes([refused] * 4) == ["contradictory: one picture is mirrored"]
    assert named_mistakes([strange] * 4) == ["out_of_distribution: strange"]
    assert named_mistakes([strange, *cell(1, 1, 0)[1:]]) == []
    went_in = {"reason": "", "trials": []}
    assert "nothing was felt" in named_mistakes([went_in] * 4)[0]


def test_a_cell_in_which_a_probe_was_not_carried_out_is_not_accused():
    not_held = {"reason": "service: refused: nothing_held", "trials": []}
    assert named_mistakes([not_held, *cell(-1, 1, 0)[1:]]) == []


@pytest.mark.parametrize(("up_mm", "named"), [(-1.0, False), (-5.0, True)])
def test_blocks_lower_than_taught_are_named_before_anything_is_inserted_between_them(up_mm, named):
    """Full depth would be reached 15 mm below the tops as they were taught, and claimed."""
    world = replace(drawn_worlds_of(50, 112, 0.0)[41], unstated=Unstated(blocks_up_mm=up_mm))
    networks = models_of(released_models())
    rows = [insert(Job(**job), networks) for job in probes(world, "rectangle", 112)]
    causes = [cause for cause in named_wirings(rows) if "block tops" in cause]
    assert bool(causes) == named
