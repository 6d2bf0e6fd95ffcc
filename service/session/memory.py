"""Resident memory of a process that runs for months: freed memory goes back to the machine."""

import ctypes
import gc

ARENAS_N = 2
_M_ARENA_MAX = -8


def use_few_arenas() -> None:
    """Let all threads share two heaps: glibc makes one per thread, and each keeps the memory that its thread frees.

    Call it before threads start. Other C libraries are not affected.
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
    """Restrict garbage collection to objects created from now on.

    Models, routes and schemas live as long as the service; scanning all of them, as happens now and then, would stop
    every thread for about 20 ms.
    """
    gc.collect()
    gc.freeze()
