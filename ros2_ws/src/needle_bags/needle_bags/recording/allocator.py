"""Settings of the C library for memory that is freed."""

from __future__ import annotations

import contextlib
import ctypes
from typing import Final

# <malloc.h>
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_MEGABYTE: Final = 2**20


def keep_freed_memory() -> None:
    """Have blocks of the size of a chunk used again.

    By default each is given back to the kernel when it is freed, and fetched and cleared anew for
    the next one: two thirds of the processor time of recording images.
    """
    with contextlib.suppress(AttributeError, OSError):  # other C libraries do not know it
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, 32 * _MEGABYTE)
        mallopt(_M_TRIM_THRESHOLD, 64 * _MEGABYTE)
