"""The C library's memory allocator (glibc): told to keep little for itself. Elsewhere nothing happens."""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache

_ARENA_MAX = -8
"""``M_ARENA_MAX`` of ``mallopt``."""


@cache
def _library() -> ctypes.CDLL | None:
    """The C library, if it is glibc."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    return library if hasattr(library, "malloc_trim") and hasattr(library, "mallopt") else None


def share_one_arena() -> None:
    """Let all threads allocate from one pool; ``MALLOC_ARENA_MAX``, if set, counts instead.

    With a pool for each of the threads that read, what one has freed is of no use to the others: images rectified by 5
    threads took 115 MiB more, in the same time. Works for threads that begin later, so it is called before the engine
    starts its own.
    """
    library = _library()
    if library is not None and "MALLOC_ARENA_MAX" not in os.environ:
        library.mallopt(_ARENA_MAX, 1)


def give_back() -> None:
    """Return freed memory to the system: compiling kernels leaves some 100 MiB of small blocks, which would stay."""
    library = _library()
    if library is not None:
        library.malloc_trim(0)
