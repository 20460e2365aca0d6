"""The machine a time was measured on, and how it is kept to one thread."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gaussians.parallel import set_threads, threads
from nebula.provenance import machine


@contextmanager
def one_thread() -> Iterator[None]:
    """Kernels run on one thread inside the block, so that methods are compared by their work."""
    before = threads()
    set_threads(1)
    try:
        yield
    finally:
        set_threads(before)


def described() -> dict[str, Any]:
    """Processor, cores and load averages of the last 1, 5 and 15 minutes, for the JSON file."""
    return {**machine(), "load_average": list(os.getloadavg())}


def in_words(about: dict[str, Any]) -> str:
    """One line for the picture."""
    return f"{about['processor']}, one thread, load average {about['load_average'][0]:.1f}"
