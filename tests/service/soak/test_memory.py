"""The soak's memory check is itself checked: it detects a leak, and reports none without a leak."""

import numpy as np

from tests.service.soak.memory import BLOCKS, slope

RUN_S = 1800.0
AT_S = list(np.linspace(0.0, RUN_S, 220))


def readings(leak_mb_per_h: float, seed: int) -> list[float]:
    """Floor, a warm-up that levels off, noise that remembers itself, and now and then a reading far off."""
    rng = np.random.default_rng(seed)
    hours = np.array(AT_S) / 3600
    noise = np.convolve(rng.normal(0, 2, 220 + 4), np.ones(5) / np.sqrt(5), "valid")
    far = 25.0 * (rng.random(220) < 0.05)
    return list(180 + leak_mb_per_h * hours - 15 * np.exp(-hours * 60) + noise + far)


def test_a_leak_is_found_and_a_floor_is_not_one() -> None:
    for seed in range(5):
        assert slope(AT_S, readings(80.0, seed), RUN_S).leaks
        assert not slope(AT_S, readings(0.0, seed), RUN_S).leaks


def test_the_interval_holds_the_truth_as_often_as_it_says() -> None:
    slopes = [slope(AT_S, readings(5.0, seed), RUN_S) for seed in range(200)]
    assert np.mean([s.low <= 5.0 <= s.high for s in slopes]) >= 0.9


def test_too_few_readings_are_no_proof() -> None:
    few = 2 * BLOCKS - 1
    assert slope(AT_S[-few:], [180.0] * few, RUN_S).leaks
