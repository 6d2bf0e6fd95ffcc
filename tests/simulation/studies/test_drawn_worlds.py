"""Every variant begins from the same starts, and the page counts what the rows hold."""

from reporting.statistics import wilson
from simulation.scene import drawn
from simulation.studies import drawn_worlds
from simulation.studies.drawn_worlds import Start, Variant

WORLDS = [drawn.world(tables, f"w{number}") for number, tables in enumerate(drawn.draw_worlds(6, 2))]


def variants(tmp_path):
    return [
        Variant("reach given", tmp_path, "belief", given_reach=True),
        Variant("reach not given", tmp_path, "belief", given_reach=False),
    ]


def test_variants_play_the_same_starts_and_another_seed_other_ones(tmp_path):
    objects = ["circle", "can", "white_box"]
    first, again, other = (drawn_worlds.starts(WORLDS, objects, 12, seed) for seed in (3, 3, 4))
    assert first == again != other
    assert [start.world.name for start in first] == [f"w{n % 6}" for n in range(12)]
    todo = [task.job for task in drawn_worlds.tasks(variants(tmp_path), first, 3)]
    for stated, unstated in zip(todo[::2], todo[1::2], strict=True):
        assert (stated["given_reach"], unstated["given_reach"]) == (True, False)
        ignored = {"condition": "", "given_reach": ""}
        assert stated | ignored == unstated | ignored
    assert len({job["condition"] + str(job["index"]) for job in todo}) == len(todo)


def test_networks_that_read_pictures_play_beside_those_that_read_markers(tmp_path):
    ours, recipe = (
        variants(tmp_path)[0],
        Variant("paper", tmp_path, "heuristic", given_reach=False, perception="pictures"),
    )
    begun = drawn_worlds.starts(WORLDS, ["circle"], 2, 3)
    todo = [task.job for task in drawn_worlds.tasks([ours, recipe], begun, 3)]
    assert [job["perception"] for job in todo] == ["fields", "pictures"] * 2
    assert [job["x_mm"] for job in todo[::2]] == [job["x_mm"] for job in todo[1::2]]


def row(name, *, inserted, claimed=True, estimate=2.0):
    interval = [estimate - 1.0, estimate + 1.0]
    decision = {
        "type": "correction",
        "estimate": {"dx_mm": estimate, "dtheta_deg": 0.0, "interval_x_mm": interval, "interval_theta_deg": interval},
        "class_probabilities": {"A": 0.1},
    }
    return {
        "condition": f"{name}: reach given",
        "scene": "circle",
        "changes": {"gel.tier": "bristle"},
        "inserted": inserted,
        "claimed": claimed,
        "void": False,
        "attempts": 2,
        "course": {"force_n": 12.0},
        "final_error": [0.0, 0.0],
        "trials": [{"error_before": [2.5, 0.5], "decision": decision}],
    }


def test_untrue_claims_come_first_and_deciles_hold_every_row(tmp_path):
    begun = [Start(WORLDS[0], "circle", 1.0, 1.0, 0.2 + 0.1 * number) for number in range(20)]
    played = [*variants(tmp_path), Variant("before", tmp_path / "before", "belief", given_reach=False)]
    rows = [row("w0", inserted=number != 7) for number in range(20) for _ in played]
    data = drawn_worlds.report_of(rows, played, begun, {})
    assert [entry["claimed_wrongly"] for entry in data["variants"]] == [1, 1, 1]
    assert sum(entry["insertions"] for entry in data["deciles"]) == 20
    assert [entry["claimed_wrongly"] for entry in data["deciles"]].count(1) == 1
    assert data["variants"][0]["covered_x"] == 1.0
    assert data["variants"][0]["covered_theta"] == 0.0
    text = drawn_worlds.drawn_worlds_page(data)
    prose = " ".join(text.split())
    assert "**2 of 40 insertions of the release ended in a false claim" in prose
    assert "with the errors of each world, up to 2 and 5 mm, and grip and speed as they are" in prose
    assert f"at worst {wilson(1, 20):.2%} were false claims" in prose, "variants of one start are not so many starts"
