"""How fast recorded datagrams become arrays of fields, against pymavlink's own parser in the same run."""

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.telemetry.mavlink.parsing.decode import Decoder, GroupedFrames
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.mavlink.parsing.scan import START, STOP
from fleet.telemetry.recording.opening import RecordingFile
from fleet.telemetry.recording.tlog import Tlog

BATCH = 1_024  # datagrams


def datagrams(path: Path) -> list[bytes]:
    """Give every frame of a telemetry log."""
    found = []
    for frames in Tlog(RecordingFile(path)).batches():
        told = frames.buf.tobytes()
        found += [told[start:stop] for start, stop in frames.headers[:, [START, STOP]].tolist()]
    return found


def ours(batches: list[ReceivedBytes]) -> int:
    """Decode every batch, down to the arrays of every message in it."""
    decoder, count = Decoder(), 0
    for batch in batches:
        dealt = GroupedFrames(decoder.decode(batch))
        count += sum(len(dealt.fields(name)[0]) for name in dealt.names())
    return count


def theirs(frames: list[bytes]) -> int:
    """Parse every datagram as a pymavlink loop does."""
    parser = mav.MAVLink(None)
    parser.robust_parsing = True
    return sum(len(parser.parse_buffer(frame) or ()) for frame in frames)


def rate(work: Callable[[], int], count: int, times: int) -> float:
    """Give messages per CPU-second, the median of several runs."""
    took = []
    for _ in range(times):
        began = time.process_time()
        assert work() == count
        took.append(time.process_time() - began)
    return count / statistics.median(took)


def measure(path: Path, times: int = 7) -> dict[str, Any]:
    """Measure both on one recording, taking turns."""
    frames = datagrams(path)
    pieces = [(0.0, None, frame) for frame in frames]
    batches = [ReceivedBytes.from_pieces(pieces[k : k + BATCH]) for k in range(0, len(pieces), BATCH)]
    ours(batches)  # compiles
    mine, peer = rate(lambda: ours(batches), len(frames), times), rate(lambda: theirs(frames), len(frames), 3)
    return {
        "recording": path.name,
        "messages": len(frames),
        "datagrams_a_batch": BATCH,
        "ours_per_cpu_s": round(mine),
        "pymavlink_per_cpu_s": round(peer),
        "ratio": round(mine / peer, 1),
    }
