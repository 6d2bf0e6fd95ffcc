"""Resident memory of a process that runs for months: what is freed goes back to the machine."""

import ctypes
import gc

ARENAS_N = 2
_M_ARENA_MAX = -8


def use_few_arenas() -> None:
    """Let all threads share two heaps: glibc makes one for each, and each keeps what its thread frees.

    Call it before threads start. Other C libraries are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, ARENAS_N)


def give_back() -> None:
    """Return freed pages; takes a millisecond or so, for moments when nothing moves."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def stop_searching_what_stays() -> None:
    """From now on, garbage is looked for only among what is made later.

    Models, routes and schemas stay as long as the service; searching all of them once more, as happens every now and
    then, would stop every thread for some 20 ms.
    """
    gc.collect()
    gc.freeze()
