"""Copies of recorded aircraft with own ids, positions and times, written into encoded messages."""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fleet.bus.codec import EncodedMessage, encode
from fleet.contract import COLUMNS, Item, Message, Mission, Rows, Sample
from fleet.frames import Origin
from fleet.mission import GLOBAL_FRAMES
from fleet.telemetry.mavlink.steps import STEP_S
from fleet.telemetry.recording.fleet_news import with_uav
from fleet.telemetry.replay.rewrite_frames import GridOffset

GROUP_COUNT = 10  # groups of copies delayed by 0, 1, 2 … steps, to spread the load
_PLACES = ("position", "target")


class CopyGroup(NamedTuple):
    """Copies of one aircraft with equal delay."""

    ids: np.ndarray  # UAV ids, (n,)
    offset: GridOffset | None  # None until the original has a position
    lag_s: float  # delay behind the original [s]


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

    def copies(self, group: CopyGroup) -> list[bytes]:
        """Return the bytes of every copy."""
        out = np.tile(self._bytes, (len(group.ids), 1))
        _write(out, self._uav, group.ids[:, None].astype(">u4"))
        _write(out, self._t, np.full((len(out), 1), self.message.t + group.lag_s, ">f8"))
        for position, t in self._times:
            _write(out, position, np.tile(t + group.lag_s, (len(out), 1)).astype(t.dtype))
        for position, x in self._places if group.offset is not None else ():
            moved = np.tile(x, (len(out), 1, 1))
            moved[..., 0], moved[..., 1] = group.offset.move(x[:, 0], x[:, 1])  # type: ignore[union-attr]
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
        self._offsets: list[GridOffset | None] = [None] * GROUP_COUNT
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
        return [
            wire
            for lag, past in enumerate(self._past)
            for template in past
            for wire in self._copy_message(template, lag)
        ]

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
            numbers = np.arange(1, self.count)
            self._offsets = [
                GridOffset(numbers[lag::GROUP_COUNT], self.count, self._origin) for lag in range(GROUP_COUNT)
            ]

    def _copy_message(self, template: MessageTemplate, lag: int) -> Iterator[EncodedMessage]:
        message = template.message
        ids = self._ids[message.uav][lag::GROUP_COUNT]
        if not len(ids):
            return
        group = CopyGroup(ids, self._offsets[lag], lag * STEP_S)
        if isinstance(message, Mission) or bool(getattr(message, "sentence", "")):
            payloads = self._encode_each(message, group)
        else:
            payloads = template.copies(group)
        kind = type(message)
        for uav, payload in zip(ids.tolist(), payloads, strict=True):
            yield EncodedMessage(kind, uav, payload, message.t + group.lag_s)

    def _encode_each(self, message: Message, group: CopyGroup) -> list[bytes]:
        """Encode each copy separately: for missions, and for messages with a sentence; both are rare."""
        items = self._moved_missions(message, group) if isinstance(message, Mission) else {}
        t = message.t + group.lag_s
        changes: dict[int, dict[str, Any]] = {uav: {"items": moved} for uav, moved in items.items()}
        return [encode(with_uav(message, uav, t=t, **changes.get(uav, {}))) for uav in group.ids.tolist()]

    def _moved_missions(self, mission: Mission, group: CopyGroup) -> dict[int, tuple[Item, ...]]:
        """Return the offset items of each copy, cached while the mission is unchanged."""
        previous, moved = self._items.get(mission.uav, ((), {}))
        if previous != mission.items:
            moved = {}
        self._items[mission.uav] = mission.items, moved
        ids = group.ids.tolist()
        if ids[0] not in moved and group.offset is not None:
            moved.update(zip(ids, _moved(mission.items, group.offset, len(ids)), strict=True))
        return {uav: moved.get(uav, mission.items) for uav in ids}


def _moved(items: tuple[Item, ...], offset: GridOffset, n: int) -> Iterator[tuple[Item, ...]]:
    lat, lon = (np.array([getattr(item, name) for item in items], np.int64) for name in ("lat_e7", "lon_e7"))
    places = offset.move(lat, lon) if items else (np.zeros((n, 0)), np.zeros((n, 0)))
    for north, east in zip(places[0].tolist(), places[1].tolist(), strict=True):
        yield tuple(
            msgspec.structs.replace(item, lat_e7=lat_e7, lon_e7=lon_e7) if item.frame in GLOBAL_FRAMES else item
            for item, lat_e7, lon_e7 in zip(items, north, east, strict=True)
        )
