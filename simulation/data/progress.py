"""Progress of a long job: a bar with ETA on a terminal, a line every half minute elsewhere."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

_LINE_EVERY_S = 30.0
Result = TypeVar("Result")


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Yield ``show(done)`` for ``total`` things called ``what``."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    on_terminal = sys.stderr.isatty()
    began = printed = time.monotonic()
    with Progress(*columns, disable=not on_terminal) as bar:
        task = bar.add_task(what, total=total)

        def show(done: int) -> None:
            nonlocal printed
            bar.update(task, completed=done)
            now = time.monotonic()
            if not on_terminal and done and now - printed >= _LINE_EVERY_S:
                printed = now
                rate = done / (now - began)
                left_min = (total - done) / rate / 60
                print(f"{done}/{total} {what}, {rate:.1f}/s, about {left_min:.1f} min left", flush=True)

        yield show


def shown(what: str, results: Iterable[Result], total: int) -> Iterator[Result]:
    """Each of ``total`` results called ``what`` as it comes, with their progress."""
    with progress(what, total) as show:
        for done, result in enumerate(results, 1):
            show(done)
            yield result
