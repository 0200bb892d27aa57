"""What a process does with memory that it has freed: a setting of the C library, for those who compute one clip after another.

In and out: nothing. The command line and the workers of `kinjax.database` have it set; a program that uses the library decides.
"""

from __future__ import annotations

import ctypes

OPTIONS = {"TRIM_THRESHOLD": (-1, 1 << 30), "TOP_PAD": (-2, 1 << 26), "MMAP_THRESHOLD": (-3, 1 << 30)}
"""By its name in the environment (`MALLOC_..._`), the number that <malloc.h> gives an option, and bytes."""


def keep_memory() -> bool:
    """Have the C library keep memory that is freed, up to 1 GiB, for the next clip; whether it could be told.

    A detection takes as much again for every clip, and a soft one for every step. Pages that went back to the system in between are
    taken anew one by one: a third of the time. For the whole process, best before its first computation. Only GNU's library (Linux)
    has the setting; elsewhere nothing changes.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return all([set_option(number, size) == 1 for number, size in OPTIONS.values()])
