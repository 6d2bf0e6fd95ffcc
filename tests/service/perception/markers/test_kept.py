"""The same pictures give the same marker fields as they did: no limit of the tracker moves unnoticed."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import pytest

from service.perception.markers.field import MarkerField
from service.perception.markers.tracker import MarkerTracker, TrackerSettings
from tests.kept import is_as_kept
from tests.service.perception.markers.test_tracker import borderless, shifted, torn_once
from tests.service.perception.synthetic import FRAME_NS, draw, grid, stretched, twist

Pictures = list[np.ndarray]
REST = grid()
BESIDE_PX = 10.0  # added to what is kept, of which a thousandth may differ: a hundredth of a pixel


def drawn(*places: np.ndarray, **options: float) -> Pictures:
    rng = np.random.default_rng(11)
    return [draw(points, rng, **options) for points in places]


def covered(image: np.ndarray, columns: slice) -> np.ndarray:
    image[:, columns] = 90
    return image


def carried_away() -> Pictures:
    """Shifted to the border and beyond, then back with a leap."""
    steps = [REST + np.array([0.0, -3.5 * k]) for k in range(7)]
    return drawn(*steps, REST)


def jumps() -> Pictures:
    """By nearly a pitch, by just below half of one, by two, home, and by one and a half."""
    places = [(0, 0), (13.5, 0), (13.5, 7.2), (-16.5, 7.2), (0, 0), (22.5, 0), (22.5, 0.2)]
    return drawn(*(REST + np.array(place) for place in places), noise=4.0)


def hidden_and_jumped() -> Pictures:
    """A third is covered, then the rest jumps, then all is seen again."""
    images = drawn(REST, *(shifted(REST, *by) for by in ((0, 0), (0.4, 0), (12, 0), (12, 0.3))))
    return [images[0], covered(images[1], slice(0, 110)), covered(images[2], slice(0, 110)), *images[3:]]


def smeared_and_strewn() -> Pictures:
    """Markers drawn long, spots between them, and some that merge."""
    merged, strewn = REST.copy(), REST[3:9, 4:9] + 7.5
    merged[12:15, 12:16:2] = merged[12:15, 13:17:2]
    images = drawn(REST, np.concatenate([REST.reshape(-1, 2), strewn.reshape(-1, 2)]), merged, REST + 0.5)
    images[3][100:112, 150:153] = images[3][104, 151]
    return images


def darkened() -> Pictures:
    """Half the light, a twentieth of it, and nothing but a corner of the grid."""
    bright, dim, dark, corner, back = drawn(REST, REST + 0.6, REST + 0.6, REST[:2, :1], REST + 1.0)
    return [bright, (dim * 0.5).astype(np.uint8), (dark * 0.05).astype(np.uint8), corner, back]


def large() -> Pictures:
    """Markers of 14 px, found in a smaller picture; turned and torn apart."""
    rest = grid(7, 9, 34.0, 320, 240)
    turned = [twist(rest, 2.5 * k, centre=(160, 120), shift=(0.7 * k, 0)) for k in range(5)]
    turned[4][2:4, 3:5] += (0.0, 11.0)
    rng = np.random.default_rng(12)
    return [draw(points, rng, 320, 240, 14.0) for points in turned]


def disturbed(seed: int) -> Pictures:
    """Twelve pictures that jump, turn, stretch, hide, dim and strew by chance, near what a tracker can still follow."""
    rng, small = np.random.default_rng(seed), seed % 3 == 0
    rest = grid(7, 9, 34.0, 320, 240, 0.8) if small else REST
    size, diameter, pitch = ((320, 240), 13.0, 34.0) if small else ((327, 320), 5.0, 15.0)
    images, place, turn_deg = [draw(rest, rng, *size, diameter)], np.zeros(2), 0.0
    for _ in range(11):
        place = place * rng.choice([0.0, 1.0, 1.0]) + pitch * rng.choice([0.05, 0.4, 1.0]) * rng.normal(0, 0.6, 2)
        turn_deg = rng.choice([0.0, 1.0]) * turn_deg + rng.normal(0, 4.0)
        points = twist(rest, turn_deg, tuple(np.array(size) / 2), place)
        points += pitch * rng.choice([0.0, 0.04, 0.1]) * rng.normal(size=points.shape)
        there = rng.random(points.shape[:2]) > rng.choice([0.0, 0.05, 0.4])
        strewn = rng.uniform(0, size, (int(rng.choice([0, 4, 30])), 2))
        faint = draw(strewn, rng, *size, diameter, contrast=float(rng.uniform(20, 90)), noise=0.0)
        image = np.minimum(draw(points[there], rng, *size, diameter, noise=float(rng.choice([2.0, 8.0]))), faint)
        hidden = rng.uniform(0, 0.45) * size[0]
        if rng.random() < 0.3:
            image[:, : int(hidden)] = 90
        images.append((image * rng.choice([1.0, 1.0, 0.5, 0.15])).astype(np.uint8))
    return images


STORIES: dict[str, Callable[[], Pictures]] = {
    "turns and shifts": lambda: drawn(*(twist(REST, 2.0 * k, shift=(0.4 * k, -0.9 * k)) for k in range(6)), noise=5.0),
    "is carried away": carried_away,
    "jumps": jumps,
    "is hidden and jumps": hidden_and_jumped,
    "is smeared and strewn": smeared_and_strewn,
    "is darkened": darkened,
    "is stretched": lambda: drawn(*(stretched(REST, by_px) for by_px in (0.0, 9.0, 26.0, 28.0))),
    "is large": large,
    "jumps by what may be a whole pitch": lambda: borderless([0, 0.3, 0.55, 0.9, 0.3, 0.0, 0.0]),
    "is torn once": lambda: torn_once(3.0),
    **{f"is disturbed {seed}": partial(disturbed, seed) for seed in range(12)},
}


def shown(field: MarkerField) -> dict[str, Any]:
    """Status, and how the measured markers moved, in px: mean, scatter, largest; and where the others were put."""
    moved = field.displacement_px[field.valid] if field.valid.any() else np.zeros((1, 2))
    put = field.displacement_px[~field.valid] if not field.valid.all() else np.zeros((1, 2))
    figures_px = [*moved.mean(0), *moved.std(0), np.hypot(*moved.T).max(), *put.mean(0)]
    state = {"status": field.status, "reason": field.reason, "valid_n": int(field.valid.sum())}
    return state | {"px": [BESIDE_PX + float(figure) for figure in figures_px]}


def test_what_ships_stays() -> None:
    is_as_kept(__file__, "shipped", asdict(TrackerSettings()))


@pytest.mark.parametrize("name", STORIES)
def test_a_grid_is_followed_as_it_was(name: str) -> None:
    tracker = MarkerTracker()
    fields = [shown(tracker.update(image, k * FRAME_NS)) for k, image in enumerate(STORIES[name]())]
    is_as_kept(__file__, name, {"fields": fields, "level": tracker._level, "strength": tracker._strength})
