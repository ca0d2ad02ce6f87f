"""A telemetry log of any size: one aircraft that circles for as long as it takes.

python -m tests.support.long_tlog flight.tlog --mb 1000
"""

import argparse
import math
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.decode import IDS, find_frames, layout
from fleet.telemetry.replay.offset_copies import write_checksums
from tests.support.talker import T0, Talker

BLOCK_S = 60.0  # flown anew in bytes, then repeated with other times
TICKS = {"ATTITUDE": ("time_boot_ms", 1), "GLOBAL_POSITION_INT": ("time_boot_ms", 1)}
TICKS |= {"SERVO_OUTPUT_RAW": ("time_usec", 1000)}
"""Message -> field of its own time, and what a millisecond is in it."""


def block() -> bytes:
    """Pack one minute: 50 Hz attitude, 25 Hz servos, 10 Hz air and position, a heartbeat a second."""
    talker, out = Talker(7), []
    for step in range(round(BLOCK_S * 50)):
        t = step * 0.02
        ms, turn = round(t * 1e3), 2 * math.pi * t / BLOCK_S
        lat, lon = 470_000_000 + round(3e4 * math.sin(turn)), 80_000_000 + round(4e4 * math.cos(turn))
        frames = [talker.heartbeat()] if step % 50 == 0 else []
        frames.append(talker.attitude(t, 0.3 * math.sin(3 * turn)))
        if step % 2 == 0:
            servos = [1500 + round(200 * math.sin(turn * k)) for k in range(1, 9)]
            frames.append(talker.pack(mav.MAVLink_servo_output_raw_message(ms * 1000, 0, *servos)))
        if step % 5 == 0:
            frames.append(talker.pack(mav.MAVLink_vfr_hud_message(20 + math.sin(turn), 21, 90, 55, 300.0, 0.1)))
            place = mav.MAVLink_global_position_int_message(ms, lat, lon, 600_000, 100_000, 900, 1200, -50, 9000)
            frames.append(talker.pack(place))
        out += [round(t * 1e6).to_bytes(8, "big") + frame for frame in frames]
    return b"".join(out)


def write(path: Path, megabytes: float) -> float:
    """Write about so many MB; give the seconds of flight in it."""
    told = np.frombuffer(block(), np.uint8).copy()
    dated = told.copy()
    stamps = _stamps(told)
    _date(dated, stamps, 0.0)
    at, _, _ = find_frames(dated, np.array([[0, len(dated), 0]]), np.zeros(s.COUNTER_COUNT, np.int64), s.STAMP_SIZE)
    head = at[:, s.START], at[:, s.PAYLOAD], at[:, s.SIZE], s.EXTRA[at[:, s.ID]].astype(np.uint8)
    ticks = []
    for name, (field, per_ms) in TICKS.items():
        place = at[at[:, s.ID] == IDS[name], s.PAYLOAD] + layout(name).fields[field][1]
        ticks.append((place, _read(told, place), per_ms))
    repeats = max(1, round(megabytes * 1e6 / len(told)))
    with path.open("wb") as file:
        for k in range(repeats):
            _date(dated, stamps, k * BLOCK_S)
            for place, own, per_ms in ticks:
                later = (own + round(k * BLOCK_S * 1e3) * per_ms).astype("<u4")  # wraps, as on board
                dated[place[:, None] + np.arange(4)] = later[:, None].view(np.uint8)
            write_checksums(dated[None], *head, s.CRC)
            file.write(dated.tobytes())
    return repeats * BLOCK_S


def _read(told: np.ndarray, place: np.ndarray) -> np.ndarray:
    return told[place[:, None] + np.arange(4)].view("<u4")[:, 0].astype(np.int64)


def _stamps(told: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the stamps: where they are, and their microseconds."""
    at, place = 0, []
    while at < len(told):
        place.append(at)
        at += s.STAMP_SIZE + 12 + int(told[at + s.STAMP_SIZE + 1])
    where = np.array(place)
    return where, told[where[:, None] + np.arange(8)].view(">u8")[:, 0].astype(np.int64)


def _date(dated: np.ndarray, stamps: tuple[np.ndarray, np.ndarray], later_s: float) -> None:
    where, us = stamps
    now = (us + round((T0 + later_s) * 1e6)).astype(">u8")
    dated[where[:, None] + np.arange(8)] = now[:, None].view(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--mb", type=float, default=1000.0)
    args = parser.parse_args()
    print(f"{args.file}: {write(args.file, args.mb):.0f} s of flight, {args.file.stat().st_size / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
