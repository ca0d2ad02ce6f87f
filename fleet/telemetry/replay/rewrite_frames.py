"""Rewrite system id, positions and checksum of MAVLink frames for copies of an aircraft."""

from math import ceil, sqrt
from typing import NamedTuple

import numba as nb
import numpy as np

from fleet.frames import Origin, to_geodetic
from fleet.mission import GLOBAL_FRAMES
from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.decode import IDS, Frames, layout

SPACING_M = 500.0  # distance between neighbours [m]
_FULL_TURN_E7 = 3_600_000_000  # 360 deg [1e-7 deg]


class GridOffset:
    """Position offset of each copy.

    Args:
        numbers: copy numbers from 1; 0 is the original, at a corner of the grid, (n,)
        total: number of copies, original included
        origin: a position of the original
    """

    def __init__(self, numbers: np.ndarray, total: int, origin: Origin) -> None:
        side = ceil(sqrt(total))
        ned = np.zeros((len(numbers), 3))
        ned[:, 0], ned[:, 1] = numbers // side * SPACING_M, numbers % side * SPACING_M
        places = to_geodetic(origin, ned)
        self._lon0 = origin.lon_e7
        self._north = (places[:, 0] - origin.lat_e7)[:, None]
        self._east = (places[:, 1] - origin.lon_e7)[:, None]
        origin_cos, place_cos = np.cos(np.radians([origin.lat_e7 * 1e-7])), np.cos(np.radians(places[:, 0] * 1e-7))
        self._east_scale = (origin_cos / np.maximum(place_cos, 1e-3))[:, None]  # wider at high latitude

    def move(self, lat: np.ndarray, lon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Offset positions, (m,) [1e-7 deg], to (n, m), one row per copy; unset positions 0, 0 are unchanged."""
        is_unset = (lat == 0) & (lon == 0)
        from_origin = (np.asarray(lon, np.int64) - self._lon0 + _FULL_TURN_E7 // 2) % _FULL_TURN_E7 - _FULL_TURN_E7 // 2
        east = self._lon0 + self._east + from_origin * self._east_scale
        north = np.clip(lat + self._north, -900_000_000, 900_000_000)
        wrapped_east = (np.rint(east).astype(np.int64) + _FULL_TURN_E7 // 2) % _FULL_TURN_E7 - _FULL_TURN_E7 // 2
        return np.where(is_unset, 0, north), np.where(is_unset, 0, wrapped_east)


POSITION_FIELDS = {
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


class FrameBlock(NamedTuple):
    """Concatenated frames of one system, without signatures."""

    data: np.ndarray  # bytes, (b,) uint8
    start: np.ndarray  # start of each frame in them, (m,)
    payload: np.ndarray  # start of each payload in them, (m,)
    size: np.ndarray  # size of each payload, (m,) [bytes]
    message: np.ndarray  # message ids, (m,)


def extract_frames(frames: Frames, frame_numbers: np.ndarray) -> FrameBlock:
    """Extract frames of one system from the received frames."""
    headers = frames.headers[frame_numbers]
    head, size = headers[:, s.PAYLOAD] - headers[:, s.START], headers[:, s.SIZE]
    length = head + size + 2
    start = np.concatenate([[0], np.cumsum(length)[:-1]])
    spans = zip(headers[:, s.START].tolist(), length.tolist(), strict=True)
    data = np.concatenate([frames.buf[begin : begin + n] for begin, n in spans])
    v2_starts = start[data[start] == s.V2]
    data[v2_starts + 2] &= ~np.uint8(s.SIGNED)  # the signature is invalid for changed frames
    return FrameBlock(data, start, start + head, size, headers[:, s.ID])


def rewrite_frames(block: FrameBlock, systems: np.ndarray, offset: GridOffset | None) -> np.ndarray:
    """Return the bytes of the frames rewritten for each system, (n, b) uint8.

    Args:
        block: frames of the original
        systems: MAVLink system ids, (n,)
        offset: position offset, one row per system; None: no offset
    """
    out = np.tile(block.data, (len(systems), 1))
    system_at = block.start + np.where(block.data[block.start] == s.V2, 5, 3)
    out[:, system_at] = systems[:, None]
    for name in POSITION_FIELDS if offset is not None else ():
        _move_positions(out, block, name, offset)  # type: ignore[arg-type]
    write_checksums(out, block.start, block.payload, block.size, s.EXTRA[block.message].astype(np.uint8), s.CRC)
    return out


def _move_positions(out: np.ndarray, block: FrameBlock, name: str, offset: GridOffset) -> None:
    """Offset the positions in all frames of one message; truncated zero positions are unchanged."""
    fields = layout(name).fields
    assert fields is not None
    (lat, _), (lon, _) = (fields[field][:2][::-1] for field in POSITION_FIELDS[name])
    frame_numbers = np.flatnonzero((block.message == IDS[name]) & (block.size >= max(lat, lon) + 4))
    if "frame" in fields and len(frame_numbers):
        place, is_present = (
            block.payload[frame_numbers] + fields["frame"][1],
            block.size[frame_numbers] > fields["frame"][1],
        )
        frame = np.where(is_present, block.data[np.minimum(place, len(block.data) - 1)], 0)
        frame_numbers = frame_numbers[np.isin(frame, GLOBAL_FRAMES)]
    if not len(frame_numbers):
        return
    kind = np.dtype(fields[POSITION_FIELDS[name][0]][0])
    scale = 1e7 if kind.kind == "f" else 1
    field_bytes = [block.payload[frame_numbers, None] + field_offset + np.arange(4) for field_offset in (lat, lon)]
    values = [np.ascontiguousarray(block.data[place]).view(kind)[:, 0] * scale for place in field_bytes]
    with np.errstate(invalid="ignore"):
        moved = offset.move(*(np.rint(np.nan_to_num(coordinate)).astype(np.int64) for coordinate in values))
    for place, x in zip(field_bytes, moved, strict=True):
        out[:, place.ravel()] = np.ascontiguousarray((x / scale if scale != 1 else x).astype(kind)).view(np.uint8)


@nb.njit(cache=True)
def write_checksums(out, start, payload, size, extra, table):
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
