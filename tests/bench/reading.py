"""How fast recordings are read, decoded and translated, against a plain pymavlink loop in the same run.

    python tests/bench/reading.py flight.tlog flight.bin --json reading.json
    python tests/bench/reading.py --grow 1000 flight.tlog       also: read it grown to 1000 MB, in bounded memory

The peer only decodes; ours also gives SI rows on the fleet clock, cut into messages. Best of `--times` runs each.
"""

import argparse
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pymavlink import mavutil

from fleet.telemetry.recording.opening import RecordingFile
from fleet.telemetry.recording.recordings import Recording
from tests.bench.peak_memory import peak_mb, reset_peak

SHIFT_US = 86_400 * 1_000_000 - 3_600_000_000  # between two copies in a grown file; less than a day [us]


def ours(path: Path) -> int:
    return sum(len(news) for _, news in Recording(path).steps())


def peer(path: Path) -> int:
    log, count = mavutil.mavlink_connection(str(path)), 0
    while log.recv_msg() is not None:
        count += 1
    log.close()
    return count


def best(read: Callable[[Path], int], path: Path, times: int) -> tuple[float, int]:
    took, count = float("inf"), 0
    for _ in range(times):
        began = time.perf_counter()
        count = read(path)
        took = min(took, time.perf_counter() - began)
    return took, count


def grown(path: Path, megabytes: int, folder: Path) -> Path:
    """Repeat a .tlog, each time later, until it has so many MB."""
    data = bytearray(RecordingFile(path).open().read(1 << 30) or b"")
    stamps = [stamp for batch in _stamps(path) for stamp in batch]
    out = folder / "grown.tlog"
    with out.open("wb") as file:
        for copy in range(megabytes * 1_000_000 // len(data) + 1):
            for at, stamp in stamps:
                data[at : at + 8] = (stamp + copy * SHIFT_US // 100).to_bytes(8, "big")
            file.write(data)
    return out


def _stamps(path: Path) -> list[list[tuple[int, int]]]:
    from fleet.telemetry.mavlink.parsing.decode import find_frames

    data = RecordingFile(path).open().read(1 << 30) or b""
    buf = np.frombuffer(data, np.uint8)
    at, times, _ = find_frames(buf, np.array([[0, len(buf), 0]]), np.zeros(4, np.int64), 8)
    return [[(int(start) - 8, int(t)) for start, t in zip(at[:, 0], times, strict=True)]]


def plain(path: Path, folder: Path) -> Path:
    """Take the compression off, for the peer's sake."""
    if path.suffix not in (".xz", ".gz", ".bz2"):
        return path
    out = folder / path.with_suffix("").name
    out.write_bytes(RecordingFile(path).open().read(1 << 30) or b"")
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="+", type=Path)
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--grow", type=int, default=0, metavar="MB")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    found = {}
    with tempfile.TemporaryDirectory() as name:
        for path in (plain(path, Path(name)) for path in args.file):
            ours(path)  # compiles
            (took, _), (theirs, messages) = best(ours, path, args.times), best(peer, path, args.times)
            found[path.name] = {
                "messages": messages,
                "ours_s": round(took, 4),
                "pymavlink_s": round(theirs, 4),
                "ours_per_s": round(messages / took),
                "ratio": round(theirs / took, 2),
            }
            print(f"{path.name}: {messages} messages, {theirs / took:.1f} times as fast as pymavlink's own loop")
        if args.update_size:
            big = grown(plain(args.file[0], Path(name)), args.update_size, Path(name))
            before = reset_peak()
            took, _ = best(ours, big, 1)
            more = peak_mb() - before
            found["grown"] = {"mb": big.stat().st_size / 1e6, "s": round(took, 1), "more_memory_mb": round(more)}
            print(f"{big.stat().st_size / 1e6:.0f} MB in {took:.0f} s, {more:.0f} MB more memory")
    if args.json:
        args.json.write_text(json.dumps({"machine": platform.processor() or platform.machine(), **found}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
