"""What is freed goes back to the system: a process that makes and forgets much would only ever grow."""

import ctypes
import platform
import threading

_MMAP_THRESHOLD, _LARGE = -3, 256 * 1024  # mallopt(3): from how many bytes on a block is one of its own [bytes]
_EVERY_S = 20.0


def give_back() -> None:
    """Give back large blocks as they are freed, and whole free pages a few times a minute; only glibc keeps them."""
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    libc.mallopt(_MMAP_THRESHOLD, _LARGE)
    threading.Thread(target=_trim, args=(libc,), daemon=True, name="heap").start()


def _trim(libc: ctypes.CDLL) -> None:
    never = threading.Event()
    while not never.wait(_EVERY_S):
        libc.malloc_trim(0)
