"""Each piece of work is done once, in order if requested, and nothing waits for work that a failure made useless."""

import multiprocessing
import os
import time

import pytest

from simulation.data.parallel import results


def square(number: int) -> int:
    return number * number


def fail_or_sleep(number: int) -> int:
    if number == 0:
        raise ArithmeticError("the first fails")
    time.sleep(60.0)
    return number


@pytest.mark.parametrize("workers", [1, 2])
def test_every_item_is_worked_on_once(workers):
    assert list(results(square, range(20), workers, in_order=True)) == [n * n for n in range(20)]
    assert sorted(results(square, range(20), workers)) == [n * n for n in range(20)]


def test_nothing_to_do_starts_nothing():
    assert not list(results(square, (), 2))


def test_a_failure_ends_the_others_at_once():
    began = time.monotonic()
    with pytest.raises(ArithmeticError, match="the first fails"):
        list(results(fail_or_sleep, range(4), 2))
    assert time.monotonic() - began < 45.0


class Interrupted(list[int]):
    """Ctrl-C comes while the items are handed to the workers."""

    def __iter__(self):
        yield 1
        raise KeyboardInterrupt


def test_an_interrupt_at_the_very_beginning_leaves_no_worker():
    with pytest.raises(KeyboardInterrupt):
        list(results(fail_or_sleep, Interrupted([1, 2]), 2))
    for worker in multiprocessing.active_children():
        worker.join(20.0)
        with pytest.raises(ProcessLookupError):  # `is_alive` misses an end that the pool's thread waits for, too
            os.kill(worker.pid or 0, 0)


def test_a_negative_number_of_processes_is_named():
    with pytest.raises(ValueError, match="-1 processes; expected 1 or more, or 0"):
        list(results(square, range(4), -1))
