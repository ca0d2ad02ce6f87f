"""A recorded flight as a slow radio link sends it: some messages kept only a few times a second.

python -m tests.support.decimated flight.tlog.xz slow.tlog --hz 2
"""

import argparse
from pathlib import Path

import numpy as np

from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.decode import IDS
from fleet.telemetry.recording.opening import RecordingFile
from fleet.telemetry.recording.tlog import Tlog

SLOW = ("ATTITUDE", "SERVO_OUTPUT_RAW", "VFR_HUD")
"""Messages that most telemetry logs of real aircraft have once to four times a second."""
ABSENT = ("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "HIGHRES_IMU", "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION")
"""Messages that those logs rarely have at all."""


def decimate(source: Path, hz: float, out: Path, slow: tuple[str, ...] = SLOW, until_s: float = np.inf) -> Path:
    """Copy the first `until_s` of a telemetry log: at most `hz` of each slow message and sender, none of `ABSENT`."""
    slow_ids, absent_ids = ([IDS[name] for name in names] for names in (slow, ABSENT))
    last: dict[tuple[int, int], int] = {}  # step of the newest kept frame, by sender and message
    start = None
    with out.open("wb") as file:
        for frames in Tlog(RecordingFile(source)).batches():
            start = float(frames.arrival[0]) if start is None else start
            wanted = ~np.isin(frames.headers[:, s.ID], absent_ids) & (frames.arrival - start < until_s)
            for k in np.flatnonzero(wanted).tolist():
                system, message, begin, end = frames.headers[k, [s.SYSTEM, s.ID, s.START, s.STOP]].tolist()
                step = int(float(frames.arrival[k]) * hz)
                if message in slow_ids and last.get((system, message)) == step:
                    continue
                last[system, message] = step
                stamp = round(float(frames.arrival[k]) * 1e6).to_bytes(8, "big")
                file.write(stamp + frames.buf[begin:end].tobytes())
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--hz", type=float, default=2.0)
    args = parser.parse_args()
    decimate(args.source, args.hz, args.out)
