"""Free memory goes back to the system, whatever was freed before."""

import platform
import subprocess
import sys

import pytest
from conftest import ROOT

ASK = """
import ctypes, sys, threading
from fleet.process.malloc_trim import enable_malloc_trim
names = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
class Info(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in names]
libc = ctypes.CDLL(None)
libc.mallinfo2.restype, libc.malloc.restype, libc.free.argtypes = Info, ctypes.c_void_p, [ctypes.c_void_p]
def apart(size):  # bytes that blocks of their own add, of more than there is place for among the small ones
    before = libc.mallinfo2().hblkhd
    blocks = [libc.malloc(ctypes.c_size_t(size)) for _ in range(40)]
    found = libc.mallinfo2().hblkhd - before
    for block in blocks:
        libc.free(block)
    return found
if len(sys.argv) > 1:
    enable_malloc_trim(int(sys.argv[1]))
apart(8 << 20)
print(apart(1 << 16) > 0, apart(1 << 14) > 0, any(one.name == "heap" for one in threading.enumerate()))
"""


def apart_after_a_large_one(*large: str) -> str:
    """Tell of blocks of 64 and 16 kB whether each is one of its own once a larger one was freed."""
    command = [sys.executable, "-c", ASK, *large]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True).stdout.strip()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has another heap")
def test_blocks_from_a_size_on_go_back_to_the_system_whatever_was_freed_before() -> None:
    assert apart_after_a_large_one() == "False False False"
    assert apart_after_a_large_one(str(48 * 1024)) == "True False True"


HEAPS = """
import ctypes, sys, threading
from fleet.process.malloc_trim import enable_malloc_trim
{set}
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
libc.fopen.restype, libc.malloc_info.argtypes, libc.fclose.argtypes = (
    ctypes.c_void_p, [ctypes.c_int, ctypes.c_void_p], [ctypes.c_void_p])
barrier = threading.Barrier(4)
def use():
    barrier.wait()
    for _ in range(200):
        libc.free(libc.malloc(ctypes.c_size_t(100_000)))
threads = [threading.Thread(target=use) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
out = libc.fopen(sys.argv[1].encode(), b"w")
libc.malloc_info(0, out)
libc.fclose(out)
print(open(sys.argv[1]).read().count("<heap nr="))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has another heap")
def test_all_threads_of_a_worker_share_one_heap(tmp_path) -> None:
    def heaps(setting: str) -> int:
        command = [sys.executable, "-c", HEAPS.format(set=setting), str(tmp_path / "heaps.xml")]
        return int(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True).stdout)

    assert heaps("enable_malloc_trim(1 << 20)") > 1
    assert heaps("enable_malloc_trim(16 << 20, 64 << 20)") == 1
