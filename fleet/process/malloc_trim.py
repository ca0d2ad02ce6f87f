"""Return freed memory to the operating system, for processes that run for days."""

import ctypes
import platform
import threading

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -2, -3, -4, -8  # of mallopt(3)
_MAX_MMAPS = 32_768  # mapped blocks; Linux allows 65,530 mappings per process, also for threads and files
_TRIM_PERIOD_S = 20.0


def enable_malloc_trim(mmap_threshold: int, trim_threshold: int | None = None) -> None:
    """Configure glibc to return freed memory to the operating system; do nothing with another C library.

    By default glibc raises its mmap threshold with every large block freed: later blocks up to that size lie on the
    heap and fragment it, and twice that size may stay free at the end of the heap of every thread. A fixed threshold
    prevents this; a thread trims free pages between used blocks a few times a minute.

    With a trim threshold, fewer system calls change the memory map, at the cost of some memory. Such a call waits for
    all others of the process and for the kernel's page reclaim: on an overloaded machine for up to 10 s, and with it
    every thread that needs memory. Call this before other threads start, since each keeps the heap that it has.

    Args:
        mmap_threshold: size from which a block is mapped separately and unmapped when freed [bytes]
        trim_threshold: free memory at the end of the heap that is kept between two trims; the heap grows by an eighth
            of it, and all threads share one heap; None: as glibc has it, with one heap per thread [bytes]
    Source: mallopt(3), M_ARENA_MAX, M_MMAP_MAX, M_MMAP_THRESHOLD, M_TOP_PAD and M_TRIM_THRESHOLD; malloc_trim(3).
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    libc.mallopt(_M_MMAP_THRESHOLD, mmap_threshold)
    libc.mallopt(_M_MMAP_MAX, _MAX_MMAPS)
    if trim_threshold is not None:
        libc.mallopt(_M_ARENA_MAX, 1)  # the heap of a thread would grow page by page
        libc.mallopt(_M_TRIM_THRESHOLD, trim_threshold)
        libc.mallopt(_M_TOP_PAD, trim_threshold // 8)
    threading.Thread(target=_trim, args=(libc,), name="heap", daemon=True).start()


def _trim(libc: ctypes.CDLL) -> None:
    timer = threading.Event()
    while not timer.wait(_TRIM_PERIOD_S):
        libc.malloc_trim(0)
