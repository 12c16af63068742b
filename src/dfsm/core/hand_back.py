"""Freed memory that the C library keeps for later, handed back to the system.

Arrays of some megabytes come from the heap of glibc once some have been freed, and what is freed in
its middle stays with the process: after a stage of a fit hundreds of megabytes that nobody uses.
"""

from __future__ import annotations

import ctypes
import sys


def hand_back() -> None:
    """Give unused memory back, where the C library is one that can."""
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc, not of musl
    if trim is not None:
        trim(0)
