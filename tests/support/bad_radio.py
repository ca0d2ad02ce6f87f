"""A recording as a worse radio would have brought it: frames lost, silences, and frames that come late."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleet.simulator.flight.drive import EPOCH_US

_STAMP = struct.Struct(">Q")
_HEAD, _TAIL, _SIGNED, _SIGNATURE = 10, 2, 1, 13  # of a MAVLink 2 frame [bytes]


@dataclass(frozen=True)
class Radio:
    """How bad it is.

    Attributes:
        loss: share of frames lost
        silent_s: length of each silence [s]
        every_s: from the begin of one to that of the next; the first begins after as much [s]
        late_s: least delay [s]
        jitter_s: mean of what comes on top; the order is kept [s]
    """

    loss: float = 0.0
    silent_s: float = 0.0
    every_s: float = float("inf")
    late_s: float = 0.0
    jitter_s: float = 0.0


RADIOS = {
    "clean": Radio(),
    "loss 30 %": Radio(loss=0.3),
    "10 s silence a minute": Radio(silent_s=10.0, every_s=60.0),
    "1 s late": Radio(late_s=1.0, jitter_s=0.2),
    "all three": Radio(0.3, 10.0, 60.0, 1.0, 0.2),
}


def frames(path: Path) -> Iterator[tuple[float, bytes]]:
    """Read a .tlog of MAVLink 2: when each frame arrived since the begin [s], and the frame."""
    data = path.read_bytes()
    at = 0
    while at < len(data):
        (stamp,) = _STAMP.unpack_from(data, at)
        at += _STAMP.size
        size = _HEAD + data[at + 1] + _TAIL + (_SIGNATURE if data[at + 2] & _SIGNED else 0)
        yield (stamp - EPOCH_US) * 1e-6, data[at : at + size]
        at += size


def worsen(source: Path, to: Path, radio: Radio, seed: int) -> int:
    """Write a recording as `radio` would have brought it; the questions answered at its begin are not touched.

    Args:
        source, to: .tlog files
        radio: how bad it is
        seed: draws losses and delays
    Returns:
        frames that arrived
    """
    rng = np.random.default_rng((seed, 11))
    last, written = 0.0, 0
    with to.open("wb") as file:
        for t, frame in frames(source):
            silent = t >= radio.every_s and t % radio.every_s < radio.silent_s
            lost, jitter = rng.random() < radio.loss, float(rng.exponential(radio.jitter_s)) if radio.jitter_s else 0.0
            if t > 0 and (silent or lost):
                continue
            last = max(last, t + radio.late_s + jitter) if t > 0 else 0.0
            file.write(_STAMP.pack(EPOCH_US + round(last * 1e6)) + frame)
            written += 1
    return written
