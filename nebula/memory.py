"""How the C library keeps freed memory."""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # malloc.h of glibc
_NEVER = -1


def keep_freed_memory() -> None:
    """Let the process reuse the memory of freed arrays instead of handing it back each time.

    For work that makes and drops arrays of 100 MB by the dozen: fresh pages cost a third of it.
    The process stays as large as its largest moment. Does nothing where the C library is not glibc.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    mallopt(_M_TRIM_THRESHOLD, _NEVER)
    mallopt(_M_MMAP_MAX, 0)
