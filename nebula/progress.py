"""Progress on standard error, so that standard output carries results only."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

QUIET_S = 1.0  # shorter work is not mentioned where no terminal shows a bar


@contextmanager
def progress(description: str, total: int | None = None) -> Iterator[Callable[[], None]]:
    """Show that something is going on; the value is called once per finished step of ``total``.

    On a terminal: a bar (a spinner without ``total``) that disappears at the end. Elsewhere: one
    line with the time taken, if that was over a second.
    """
    if sys.stderr.isatty():
        with _bar(description, total) as advance:
            yield advance
        return
    start = time.perf_counter()
    yield lambda: None
    seconds = time.perf_counter() - start
    if seconds > QUIET_S:
        print(f"{description}: {seconds:.1f} s", file=sys.stderr, flush=True)


@contextmanager
def _bar(description: str, total: int | None) -> Iterator[Callable[[], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(description, total=total)
        yield lambda: bars.advance(task)
