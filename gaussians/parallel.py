"""Runs a kernel over chunks of an index range on a few threads.

Kernels release the GIL and write only to outputs of their own indices, so results cannot depend on
the number of threads or on which thread takes which chunk. Compared with numba's ``prange`` this
balances uneven rows, compiles several times faster, and leaves the process free to fork.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from gaussians.errors import InputError

_CHUNKS_PER_THREAD = 16  # uneven rows (sky, ground) even out; a chunk costs some 20 us to start

_state: dict[str, Any] = {"threads": None, "pool": None}


def threads() -> int:
    """Number of threads kernels run on: `set_threads`, else the cores this process may use."""
    if _state["threads"] is None:
        affinity = getattr(os, "sched_getaffinity", None)  # not on every platform
        set_threads(len(affinity(0)) if affinity else os.cpu_count() or 1)
    return int(_state["threads"])


def set_threads(count: int) -> None:
    """Set the number of threads; results do not depend on it. Raises InputError unless 1..1024."""
    if not isinstance(count, int) or not 1 <= count <= 1024:
        raise InputError(f"threads must be an integer from 1 to 1024, not {count}")
    if _state["pool"] is not None:
        _state["pool"].shutdown()
    _state["threads"] = count
    _state["pool"] = ThreadPoolExecutor(count) if count > 1 else None


def run_chunks(kernel: Callable[..., Any], count: int, *arguments: Any) -> list[Any]:
    """Call ``kernel(begin, end, *arguments)`` over 0..count in chunks; values in chunk order.

    The first chunk is index 0 alone and runs before the others, so that a kernel is compiled once
    before threads call it.
    """
    workers = threads()
    if count == 0:
        return []
    chunk = max(1, -(-count // (workers * _CHUNKS_PER_THREAD)))
    begins = range(1, count, chunk)
    first = kernel(0, 1, *arguments)
    if workers == 1:
        rest = [kernel(b, min(b + chunk, count), *arguments) for b in begins]
    else:
        futures = [
            _state["pool"].submit(kernel, b, min(b + chunk, count), *arguments) for b in begins
        ]
        rest = [f.result() for f in futures]
    return [first, *rest]
