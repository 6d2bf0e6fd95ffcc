"""Map work over all cores or a Ray cluster, yielding results one by one."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing.connection import wait
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def results(
    work: Callable[[Item], Result], items: Sequence[Item], workers: int = 0, ray: str = "", *, in_order: bool = False
) -> Iterator[Result]:
    """``work`` of every item as it finishes, or in the order of the items; raises what ``work`` raises.

    ``workers``: processes, 0 for one per core, 1 for this process alone. ``ray``: address of a Ray cluster to use
    instead ("local" starts one here); files named by the items must exist on every node. Raises ValueError without Ray,
    and for a negative number of processes.
    """
    if workers < 0:
        raise ValueError(f"{workers} processes; expected 1 or more, or 0 for one per core")
    workers = min(workers or os.cpu_count() or 1, len(items))
    if ray and items:
        yield from _on_ray(work, items, ray)
    elif workers <= 1:
        yield from map(work, items)
    else:
        yield from _in_processes(work, items, workers, in_order)


def _in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], workers: int, in_order: bool
) -> Iterator[Result]:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # one process per core; more threads would only compete
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _die_with_parent)
    try:
        futures = [pool.submit(work, item) for item in items]
        yield from (future.result() for future in (futures if in_order else as_completed(futures)))
    except BaseException:  # on an interruption too: do not wait for unfinished work
        for process in list((pool._processes or {}).values()):  # noqa: SLF001 (no public way to stop a busy worker)
            process.kill()
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()


def _die_with_parent() -> None:
    """End the worker whenever the parent ends; only the parent handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _on_ray(work: Callable[[Item], Result], items: Sequence[Item], address: str) -> Iterator[Result]:
    try:
        import ray
    except ImportError as error:
        raise ValueError('--ray needs Ray: pip install ".[simulation,service,ray]"') from error
    ray.init(address=None if address == "local" else address, log_to_driver=False, include_dashboard=False)
    try:
        remote = ray.remote(num_cpus=1, max_retries=3)(work)
        waiting = [remote.remote(item) for item in items]
        while waiting:
            finished, waiting = ray.wait(waiting, num_returns=1)
            yield from ray.get(finished)
    finally:
        ray.shutdown()
