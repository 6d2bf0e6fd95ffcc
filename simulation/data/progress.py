"""Progress of a long job on standard error: a bar with ETA on a terminal, lines elsewhere, the first after 5 s."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

_FIRST_LINE_S, _LINE_EVERY_S = 5.0, 30.0
Result = TypeVar("Result")


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Yield ``show(done)`` for ``total`` things called ``what``."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    on_terminal = sys.stderr.isatty()
    began = time.monotonic()
    due = began + _FIRST_LINE_S
    with Progress(*columns, console=Console(stderr=True), disable=not on_terminal) as bar:
        task = bar.add_task(what, total=total)

        def show(done: int) -> None:
            nonlocal due
            bar.update(task, completed=done)
            now = time.monotonic()
            if not on_terminal and done and now >= due:
                due = now + _LINE_EVERY_S
                rate = done / (now - began)
                left = f"about {(total - done) / rate / 60:.1f} min left"
                print(f"{done}/{total} {what}, {rate:.1f}/s, {left}", file=sys.stderr, flush=True)

        yield show


def shown(what: str, results: Iterable[Result], total: int) -> Iterator[Result]:
    """Each of ``total`` results called ``what`` as it comes, with their progress."""
    with progress(what, total) as show:
        for done, result in enumerate(results, 1):
            show(done)
            yield result
