"""Random and mutated bytes into the decoder and the intake: no exception, no hang, no growth of memory.

    python -m tests.bench.gateway.fuzz --bytes 100000000 --seed 1 --json fuzz.json

A third is random, a third are frames of all messages damaged, a third is full of magics. It comes in pieces of any size
from changing senders and is digested and handed over as from a live link, beside one good aircraft that must be heard
with every block. Slowest: of any 100,000 bytes.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fleet.bus.codec import EncodedMessage
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from tests.bench.peak_memory import peak_mb
from tests.support import oracle
from tests.support.talker import Talker

BLOCK = 100_000  # bytes at a time
GOOD = 251  # system id of the good aircraft
_FRAMES = 3_000  # made once, damaged anew every time


def blocks(seed: int, total: int) -> Iterator[bytes]:
    """Make junk of all three kinds in turn."""
    rng = np.random.default_rng(seed)
    stream = b"".join(oracle.frames(rng, _FRAMES))
    for k in range(-(-total // BLOCK)):
        if k % 3 == 0:
            yield rng.bytes(BLOCK)
        elif k % 3 == 1:
            start = int(rng.integers(0, max(len(stream) - BLOCK, 1)))
            told = np.frombuffer(stream, np.uint8)[start : start + BLOCK].copy()
            hit = rng.integers(0, len(told), len(told) // int(rng.integers(20, 400)))
            told[hit] = rng.integers(0, 256, len(hit))
            yield told.tobytes()
        else:
            yield rng.choice(np.array([0xFD, 0xFE, 0, 1, 255, 12, 30, 76], np.uint8), BLOCK).tobytes()


def pieces(rng: np.random.Generator, block: bytes, t: float) -> ReceivedBytes:
    """Cut a block anywhere, and say that a few senders sent it."""
    cuts = np.unique(rng.integers(0, len(block) + 1, int(rng.integers(1, 400))))
    stop = np.append(cuts, len(block))
    start = np.concatenate([[0], stop[:-1]])
    sender = rng.integers(0, 5, len(stop))
    senders = tuple(("10.0.0.9", int(port)) for port in rng.integers(1024, 65_536, 5))
    return ReceivedBytes(np.frombuffer(block, np.uint8), start, stop, np.full(len(stop), t), sender, senders)


def run(seed: int, total: int) -> dict[str, Any]:
    """Feed so many bytes; gives counters, slowest block and growth of memory after the first tenth."""
    rng, intake, t, slowest, early = np.random.default_rng(seed + 1), MavlinkReceiver(), 1.7e9, 0.0, 0
    began = time.perf_counter()
    fed = heard = k = 0
    good = Talker(GOOD)
    for k, block in enumerate(blocks(seed, total)):
        t += 0.1
        took = time.process_time()
        intake.receive_batch(pieces(rng, block, t))
        intake.receive(t, good.heartbeat() + good.attitude(0.1 * k), "good")
        heard += any(isinstance(one, EncodedMessage) and one.uav == GOOD for one in intake.flush_packed(t))
        slowest = max(slowest, time.process_time() - took) if k > 3 else 0.0  # the first ones compile
        fed += len(block)
        if fed >= total // 10 and not early:
            early = peak_mb()
    return {
        "bytes": fed,
        "counters": dict(intake.decoder.counters()),
        "refused": dict(intake.rejected),
        "blocks": k + 1,
        "blocks_with_the_good_aircraft": heard,
        "aircraft": len(intake.aircraft),
        "slowest_cpu_s": round(slowest, 3),
        "took_s": round(time.perf_counter() - began, 1),
        "more_memory_mb": round(peak_mb() - early, 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bytes", type=int, default=100_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    found = run(args.seed, args.bytes)
    print(json.dumps(found, indent=1))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
