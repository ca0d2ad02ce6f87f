"""Rewrite system id, positions and checksum of MAVLink frames for copies of an aircraft."""

from typing import NamedTuple

import numba as nb
import numpy as np

from fleet.mission import GLOBAL_FRAMES
from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.decode import IDS, Frames, layout
from fleet.telemetry.replay.offset import Aside

PLACES = {
    "GLOBAL_POSITION_INT": ("lat", "lon"),
    "GPS_RAW_INT": ("lat", "lon"),
    "GPS2_RAW": ("lat", "lon"),
    "AHRS2": ("lat", "lng"),
    "HOME_POSITION": ("latitude", "longitude"),
    "GPS_GLOBAL_ORIGIN": ("latitude", "longitude"),
    "POSITION_TARGET_GLOBAL_INT": ("lat_int", "lon_int"),
    "MISSION_ITEM_INT": ("x", "y"),
    "MISSION_ITEM": ("x", "y"),  # degrees as floats; all others are integers
}
"""Messages with geodetic positions: their fields of latitude and longitude."""


class Cut(NamedTuple):
    """Concatenated frames of one system, without signatures."""

    told: np.ndarray  # bytes, (b,) uint8
    start: np.ndarray  # start of each frame in them, (m,)
    payload: np.ndarray  # start of each payload in them, (m,)
    size: np.ndarray  # size of each payload, (m,) [bytes]
    message: np.ndarray  # message ids, (m,)


def cut(frames: Frames, which: np.ndarray) -> Cut:
    """Extract frames of one system from the received frames."""
    at = frames.at[which]
    head, size = at[:, s.PAYLOAD] - at[:, s.START], at[:, s.SIZE]
    length = head + size + 2
    start = np.concatenate([[0], np.cumsum(length)[:-1]])
    spans = zip(at[:, s.START].tolist(), length.tolist(), strict=True)
    told = np.concatenate([frames.buf[begin : begin + n] for begin, n in spans])
    second = start[told[start] == s.V2]
    told[second + 2] &= ~np.uint8(s.SIGNED)  # the signature is invalid for changed frames
    return Cut(told, start, start + head, size, at[:, s.ID])


def recast(one: Cut, systems: np.ndarray, aside: Aside | None) -> np.ndarray:
    """Return the bytes of the frames rewritten for each system, (n, b) uint8.

    Args:
        block: frames of the original
        systems: MAVLink system ids, (n,)
        offset: position offset, one row per system; None: no offset
    """
    out = np.tile(one.told, (len(systems), 1))
    at = one.start + np.where(one.told[one.start] == s.V2, 5, 3)
    out[:, at] = systems[:, None]
    for name in PLACES if aside is not None else ():
        _move(out, one, name, aside)  # type: ignore[arg-type]
    seal(out, one.start, one.payload, one.size, s.EXTRA[one.message].astype(np.uint8), s.CRC)
    return out


def _move(out: np.ndarray, one: Cut, name: str, aside: Aside) -> None:
    """Offset the positions in all frames of one message; truncated zero positions are unchanged."""
    fields = layout(name).fields
    assert fields is not None
    (lat, _), (lon, _) = (fields[field][:2][::-1] for field in PLACES[name])
    which = np.flatnonzero((one.message == IDS[name]) & (one.size >= max(lat, lon) + 4))
    if "frame" in fields and len(which):
        place, last = one.payload[which] + fields["frame"][1], one.size[which] > fields["frame"][1]
        frame = np.where(last, one.told[np.minimum(place, len(one.told) - 1)], 0)
        which = which[np.isin(frame, GLOBAL_FRAMES)]
    if not len(which):
        return
    kind = np.dtype(fields[PLACES[name][0]][0])
    scale = 1e7 if kind.kind == "f" else 1
    at = [one.payload[which, None] + offset + np.arange(4) for offset in (lat, lon)]
    was = [np.ascontiguousarray(one.told[place]).view(kind)[:, 0] * scale for place in at]
    with np.errstate(invalid="ignore"):
        moved = aside.move(*(np.rint(np.nan_to_num(x)).astype(np.int64) for x in was))
    for place, x in zip(at, moved, strict=True):
        out[:, place.ravel()] = np.ascontiguousarray((x / scale if scale != 1 else x).astype(kind)).view(np.uint8)


@nb.njit(cache=True)
def seal(out, start, payload, size, extra, table):
    """Write the checksum of each frame.

    Args:
        out: frames of several systems, changed in place, (n, b) uint8
        start, payload, size: starts of frames and payloads, sizes of payloads, (m,)
        extra: CRC_EXTRA, (m,)
        table: `scan.CRC`
    """
    for i in range(len(out)):
        for k in range(len(start)):
            end = payload[k] + size[k]
            crc = s.checksum(out[i], start[k] + 1, end, extra[k], table)
            out[i, end] = crc & 0xFF
            out[i, end + 1] = crc >> 8
