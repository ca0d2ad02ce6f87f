"""Return freed memory to the operating system, for processes that run for days."""

import ctypes
import platform
import threading

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -2, -3, -4, -8  # of mallopt(3)
_MAX_MMAPS = 32_768  # mapped blocks; Linux allows 65,530 mappings per process, also for threads and files
_TRIM_PERIOD_S = 20.0


def enable_malloc_trim(mmap_threshold: int) -> None:
    """Configure glibc to return freed memory to the operating system; do nothing with another C library.

    By default glibc raises its mmap threshold with every large block freed: later blocks up to that size lie on the
    heap and fragment it, and twice that size may stay free at the end of the heap of every thread. A fixed threshold
    prevents this; a thread trims free pages between used blocks a few times a minute.

    Args:
        mmap_threshold: size from which a block is mapped separately and unmapped when freed [bytes]
    Source: mallopt(3), M_MMAP_THRESHOLD and M_MMAP_MAX; malloc_trim(3).
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    libc.mallopt(_M_MMAP_THRESHOLD, mmap_threshold)
    libc.mallopt(_M_MMAP_MAX, _MAX_MMAPS)
    threading.Thread(target=_trim, args=(libc,), name="heap", daemon=True).start()


def limit_mapping_calls(mmap_threshold: int, trim_threshold: int) -> None:
    """As `enable_malloc_trim`, with few system calls that change the memory map, at the cost of some memory.

    Such a call waits for all others of the process and for the kernel's page reclaim. On an overloaded machine single
    calls waited for up to 10 s, and with them every thread that needs memory or the interpreter.

    Args:
        mmap_threshold: size from which a block is mapped separately and unmapped when freed [bytes]
        trim_threshold: the heap grows by an eighth of this, and shrinks between two trims only above it [bytes]
    Source: mallopt(3), M_ARENA_MAX, M_TOP_PAD and M_TRIM_THRESHOLD.
    """
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        for parameter, value in (
            (_M_ARENA_MAX, 1),  # the heap of a thread grows by pages
            (_M_TOP_PAD, trim_threshold // 8),
            (_M_TRIM_THRESHOLD, trim_threshold),
        ):
            libc.mallopt(parameter, value)
    enable_malloc_trim(mmap_threshold)


def _trim(libc: ctypes.CDLL) -> None:
    timer = threading.Event()
    while not timer.wait(_TRIM_PERIOD_S):
        libc.malloc_trim(0)
