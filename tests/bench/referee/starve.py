"""A share of a core for one process: control groups of Linux, of version 2 or 1; only root may."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

_ROOTS = Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/cpu")  # version 2, version 1
_PERIOD_US = 100_000
_GONE_S = 1.0  # for the kernel to release a group [s]


@contextlib.contextmanager
def limited(pids: list[int], share: float) -> Iterator[None]:
    """Limit each process to a share of one core, all its threads together, until the end of the `with` statement.

    Raises:
        OSError: where this machine does not allow it; run as root, with control groups mounted.
    """
    groups: list[tuple[Path, Path]] = []
    try:
        for pid in pids:
            root = next((each for each in _ROOTS if (each / "cgroup.procs").exists()), None)
            if root is None:
                raise OSError("cgroup: found none mounted below /sys/fs/cgroup, expected one; run where there is")
            group = root / f"parauav-{os.getpid()}-{pid}"
            group.mkdir()
            groups.append((root, group))
            _limit(group, share)
            (group / "cgroup.procs").write_text(f"{pid}\n")
        yield
    finally:
        for root, group in groups:
            _release(root, group)


def throttled_s(pid: int) -> float:
    """Give how long a limited process had to wait for its next period [s]."""
    for root in _ROOTS:
        stat = root / f"parauav-{os.getpid()}-{pid}" / "cpu.stat"
        if stat.exists():
            found = dict(line.split() for line in stat.read_text().splitlines())
            return int(found.get("throttled_time", 0)) / 1e9 + int(found.get("throttled_usec", 0)) / 1e6
    return float("nan")


def _limit(group: Path, share: float) -> None:
    quota = int(share * _PERIOD_US)
    if (group / "cpu.max").exists():
        (group / "cpu.max").write_text(f"{quota} {_PERIOD_US}\n")
    else:
        (group / "cpu.cfs_period_us").write_text(f"{_PERIOD_US}\n")
        (group / "cpu.cfs_quota_us").write_text(f"{quota}\n")


def _release(root: Path, group: Path) -> None:
    """Let the processes of a group go, and remove it."""
    for pid in (group / "cgroup.procs").read_text().split():
        with contextlib.suppress(OSError):  # it has ended meanwhile
            (root / "cgroup.procs").write_text(f"{pid}\n")
    until = time.monotonic() + _GONE_S
    while group.exists() and time.monotonic() < until:
        with contextlib.suppress(OSError):
            group.rmdir()
