"""Who makes the shards of a collection: processes of this machine, or a Ray cluster."""

import os
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from typing import Any

from reporting.files import write_durably
from simulation.data.collect import Plan, make_shard, shard_of
from simulation.data.dataset import DatasetError, DatasetWriter, ShardEntry
from simulation.data.progress import progress

_counter: Any = None


def _start_worker(counter: Any) -> None:
    """A worker dies with its parent, however that one ends, and shares its progress."""
    import multiprocessing as mp
    import threading
    from multiprocessing.connection import wait as wait_for

    parent = mp.parent_process()
    assert parent is not None

    def follow() -> None:
        wait_for([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
    global _counter  # noqa: PLW0603 (a process's own copy, set once by the pool's initializer)
    _counter = counter


def _work(plan: Plan) -> ShardEntry:
    def count() -> None:
        with _counter.get_lock():
            _counter.value += 1

    return make_shard(plan, count)


def collect(writer: DatasetWriter, plans: Sequence[Plan], workers: int) -> None:
    """Make and list every shard of ``plans`` in ``workers`` processes, with a progress bar."""
    import multiprocessing as mp

    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # one process a core; threads inside them would only fight
    context = mp.get_context("spawn")
    counter = context.Value("q", 0)
    with (
        progress("collisions", sum(plan.trials for plan in plans)) as show,
        ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(counter,)) as pool,
    ):
        waiting: set[Future[ShardEntry]] = {pool.submit(_work, plan) for plan in plans}
        try:
            while waiting:
                finished, waiting = wait(waiting, timeout=0.5, return_when=FIRST_COMPLETED)
                for future in finished:
                    writer.commit(future.result())
                show(counter.value)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in list((pool._processes or {}).values()):  # noqa: SLF001 (no public way to stop a busy worker)
                process.terminate()
            raise


def collect_on_ray(writer: DatasetWriter, plans: Sequence[Plan], address: str) -> None:
    """As :func:`collect`, on the Ray cluster at ``address`` ("local" starts one here); shards come back as bytes."""
    try:
        import ray
    except ImportError as error:
        raise DatasetError('--ray needs Ray: pip install ".[simulation,ray]"') from error
    ray.init(address=None if address == "local" else address, log_to_driver=False, include_dashboard=False)
    try:
        remote = ray.remote(num_cpus=1, max_retries=3)(shard_of)
        waiting = [remote.remote(plan) for plan in plans]
        with progress("shards", len(plans)) as show:
            while waiting:
                (finished, *_), waiting = ray.wait(waiting, num_returns=1)
                entry, data = ray.get(finished)
                write_durably(writer.path / entry.name, data)
                writer.commit(entry)
                show(len(plans) - len(waiting))
    finally:
        ray.shutdown()
