"""Equality with pymavlink, field by field: the long run that the suite takes a sample of.

    python -m tests.bench.gateway.equal --frames 200000 --recordings ../shared/recordings --json equal.json

Sound, truncated and signed frames of every message in both versions; the same stream damaged, against pymavlink's
decoder tried at every byte; and every frame of every .tlog in the folder.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from fleet.telemetry.recording.opening import RecordingFile
from fleet.telemetry.recording.tlog import Tlog
from tests.support import oracle

AT_ONCE = 10_000  # frames


def sound(rng: np.random.Generator, count: int) -> dict[str, int]:
    """Compare `count` frames that are sound, and what is left of them once damaged."""
    found = {"sound": 0, "from_damaged": 0, "from_damaged_by_pymavlink": 0}
    for _ in range(-(-count // AT_ONCE)):
        made = oracle.frames(rng, AT_ONCE)
        messages = oracle.by_pymavlink(made)
        oracle.assert_equal(oracle.ours(made), messages)
        damaged = oracle.worsened(rng, b"".join(made))
        frames = oracle.ours([damaged, bytes(600)])
        oracle.assert_equal(frames, oracle.searched(damaged))
        found["sound"] += len(messages)
        found["from_damaged"] += len(frames.headers)
        found["from_damaged_by_pymavlink"] += len(oracle.by_pymavlink([damaged]))
    return found


def recorded(folder: Path) -> dict[str, int]:
    """Compare every frame of every telemetry log in a folder; gives how many, by file."""
    found = {}
    for path in sorted({*folder.rglob("*.tlog"), *folder.rglob("*.tlog.xz")}):
        count = 0
        for batch in Tlog(RecordingFile(path)).batches():
            frames = oracle.raw(batch)
            oracle.assert_equal(oracle.ours(frames), oracle.by_pymavlink(frames))
            count += len(frames)
        found[path.name] = count
        print(f"{path.name}: {count} frames equal", flush=True)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--recordings", type=Path, metavar="FOLDER")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    found: dict[str, Any] = sound(np.random.default_rng(args.seed), args.frames)
    print(json.dumps(found), flush=True)
    if args.recordings:
        found["recordings"] = recorded(args.recordings)
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
