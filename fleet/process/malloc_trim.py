"""The heap of a process that lives for days: what is free goes back to the system."""

import ctypes
import platform
import threading

_M_MMAP_THRESHOLD, _M_MMAP_MAX = -3, -4  # of mallopt(3)
_MOST = 32_768  # blocks of their own; Linux gives a process 65,530 mappings, and threads and files need some, too
_EVERY_S = 20.0


def give_back(large: int) -> None:
    """Return what is freed back to the system, where the C library is glibc; elsewhere nothing is done.

    Left alone, glibc learns from every large block that is freed: blocks up to that size then lie among the small ones
    and leave holes, and twice that size may lie free at the end of the heap of every thread. What is set is not learnt;
    whole free pages between blocks in use go back a few times a minute, on a thread of its own.

    Args:
        large: from how many bytes on a block is one of its own, which goes back when it is freed [bytes]
    Source: mallopt(3), M_MMAP_THRESHOLD and M_MMAP_MAX; malloc_trim(3).
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    libc.mallopt(_M_MMAP_THRESHOLD, large)
    libc.mallopt(_M_MMAP_MAX, _MOST)
    threading.Thread(target=_trim, args=(libc,), name="heap", daemon=True).start()


def _trim(libc: ctypes.CDLL) -> None:
    never = threading.Event()
    while not never.wait(_EVERY_S):
        libc.malloc_trim(0)
