"""Copies of recorded aircraft with own ids, positions and times, written into encoded messages and frames."""

from collections import deque
from collections.abc import Iterator, Sequence
from itertools import chain
from math import ceil, sqrt
from typing import Any, NamedTuple

import msgspec
import numba as nb
import numpy as np

from fleet.bus.codec import EncodedMessage, encode
from fleet.contract import COLUMNS, Item, Message, Mission, Rows, Sample
from fleet.frames import Origin, to_geodetic
from fleet.mission import GLOBAL_FRAMES
from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.decode import IDS, Frames, layout
from fleet.telemetry.mavlink.steps import STEP_S
from fleet.telemetry.recording.fleet_news import with_uav

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
        place = block.payload[frame_numbers] + fields["frame"][1]
        is_present = block.size[frame_numbers] > fields["frame"][1]
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


GROUP_COUNT = 10  # groups of copies delayed by 0, 1, 2 … steps, to spread the load
_PLACES = ("position", "target")


def group_offsets(numbers: np.ndarray, total: int, origin: Origin) -> list[GridOffset]:
    """Return the position offset of each group of copies; arguments as for `GridOffset`."""
    return [GridOffset(numbers[lag::GROUP_COUNT], total, origin) for lag in range(GROUP_COUNT)]


class MessageTemplate:
    """One encoded message whose id, times and positions can be overwritten."""

    def __init__(self, message: Message) -> None:
        self.message = message
        plain = encode(message)
        head = plain.index(b"\xa3uav") + 4
        rest = head + len(encode(message.uav)) + 2 + len(encode(message.t))
        packed = plain[:head] + b"\xce" + bytes(4) + b"\xa1t\xcb" + bytes(8) + plain[rest:]
        self._bytes = np.frombuffer(packed, np.uint8)
        self._uav, self._t = head + 1, head + 8
        self._times: list[tuple[int, np.ndarray]] = []  # byte offset, (m,) [s since 1970]
        self._places: list[tuple[int, np.ndarray]] = []  # byte offset, (m, 3) [1e-7 deg, 1e-7 deg, mm]
        if isinstance(message, Sample):
            self._find_rows(packed, message)

    def _find_rows(self, packed: bytes, sample: Sample) -> None:
        at = self._t + 8
        for field in COLUMNS:
            rows: Rows | None = getattr(sample, field)
            if rows is None:
                continue
            block = encode(rows)
            at = packed.index(block, at)
            after_t = at + len(b"\x82\xa1t") + len(encode(rows.t))
            self._times.append((after_t - len(rows.t.data), rows.t.numpy()))
            at += len(block)
            if field in _PLACES:
                self._places.append((at - len(rows.x.data), rows.x.numpy()))

    def copies(self, ids: np.ndarray, offset: GridOffset | None, lag_s: float) -> list[bytes]:
        """Return the bytes of every copy.

        Args:
            ids: UAV ids, (n,)
            offset: None until the original has a position
            lag_s: delay behind the original [s]
        """
        out = np.tile(self._bytes, (len(ids), 1))
        _write(out, self._uav, ids[:, None].astype(">u4"))
        _write(out, self._t, np.full((len(out), 1), self.message.t + lag_s, ">f8"))
        for position, t in self._times:
            _write(out, position, np.tile(t + lag_s, (len(out), 1)).astype(t.dtype))
        for position, x in self._places if offset is not None else ():
            moved = np.tile(x, (len(out), 1, 1))
            moved[..., 0], moved[..., 1] = offset.move(x[:, 0], x[:, 1])  # type: ignore[union-attr]
            _write(out, position, moved.reshape(len(out), -1))
        return [row.tobytes() for row in out]


def _write(out: np.ndarray, position: int, values: np.ndarray) -> None:
    raw = np.ascontiguousarray(values).view(np.uint8)
    out[:, position : position + raw.shape[1]] = raw


class OffsetCopies:
    """Copies of the aircraft of one recording, processed step by step.

    Args:
        count: number of aircraft per recorded one, itself included
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._ids: dict[int, np.ndarray] = {}  # ids of the copies, by id of the original
        self._past: deque[list[MessageTemplate]] = deque(maxlen=GROUP_COUNT)  # newest first
        self._offsets: Sequence[GridOffset | None] = [None] * GROUP_COUNT
        self._origin: Origin | None = None
        self._items: dict[int, tuple[tuple[Item, ...], dict[int, tuple[Item, ...]]]] = {}
        self._early_missions: dict[int, Mission] = {}  # missions before the first position of the original

    def set_ids(self, uav: int, ids: Sequence[int]) -> None:
        """Set the UAV ids of the copies of an original."""
        self._ids[uav] = np.array(ids, np.int64)

    def step(self, messages: Sequence[Message]) -> list[EncodedMessage]:
        """Add the messages of the originals in one step of 0.1 s; return the messages of the copies."""
        if self.count < 2:
            return []
        if self._origin is None:
            self._early_missions.update((message.uav, message) for message in messages if isinstance(message, Mission))
            self._find_origin(messages)
            messages = [*self._early_missions.values(), *messages] if self._origin is not None else messages
        self._past.appendleft([MessageTemplate(message) for message in messages])
        copied = (self._copy_message(template, lag) for lag, past in enumerate(self._past) for template in past)
        return list(chain.from_iterable(copied))

    def remaining(self) -> Iterator[list[EncodedMessage]]:
        """Return step by step the remaining messages of the copies after the end of the originals."""
        for _ in range(GROUP_COUNT - 1 if self.count > 1 else 0):
            yield self.step([])

    def _find_origin(self, messages: Sequence[Message]) -> None:
        positions = (
            message.position.x.numpy()[0]
            for message in messages
            if isinstance(message, Sample) and message.position is not None
        )
        first = next((first_row for first_row in positions if first_row[:2].any()), None)
        if first is not None:
            self._origin = Origin(*(int(v) for v in first))
            self._offsets = group_offsets(np.arange(1, self.count), self.count, self._origin)

    def _copy_message(self, template: MessageTemplate, lag: int) -> Iterator[EncodedMessage]:
        message, offset, lag_s = template.message, self._offsets[lag], lag * STEP_S
        ids = self._ids[message.uav][lag::GROUP_COUNT]
        if not len(ids):
            return
        if isinstance(message, Mission) or bool(getattr(message, "sentence", "")):  # rare: encode each copy
            items = self._moved_missions(message, ids.tolist(), offset) if isinstance(message, Mission) else {}
            changes: dict[int, dict[str, Any]] = {uav: {"items": moved} for uav, moved in items.items()}
            t = message.t + lag_s
            payloads = [encode(with_uav(message, uav, t=t, **changes.get(uav, {}))) for uav in ids.tolist()]
        else:
            payloads = template.copies(ids, offset, lag_s)
        for uav, payload in zip(ids.tolist(), payloads, strict=True):
            yield EncodedMessage(type(message), uav, payload, message.t + lag_s)

    def _moved_missions(
        self, mission: Mission, ids: list[int], offset: GridOffset | None
    ) -> dict[int, tuple[Item, ...]]:
        """Return the offset items of each copy, cached while the mission is unchanged."""
        previous, moved = self._items.get(mission.uav, ((), {}))
        if previous != mission.items:
            moved = {}
        self._items[mission.uav] = mission.items, moved
        if ids[0] not in moved and offset is not None:
            moved.update(zip(ids, _moved(mission.items, offset, len(ids)), strict=True))
        return {uav: moved.get(uav, mission.items) for uav in ids}


def _moved(items: tuple[Item, ...], offset: GridOffset, n: int) -> Iterator[tuple[Item, ...]]:
    lat, lon = (np.array([getattr(item, name) for item in items], np.int64) for name in ("lat_e7", "lon_e7"))
    places = offset.move(lat, lon) if items else (np.zeros((n, 0)), np.zeros((n, 0)))
    for north, east in zip(places[0].tolist(), places[1].tolist(), strict=True):
        yield tuple(
            msgspec.structs.replace(item, lat_e7=lat_e7, lon_e7=lon_e7) if item.frame in GLOBAL_FRAMES else item
            for item, lat_e7, lon_e7 in zip(items, north, east, strict=True)
        )
