"""Copies of recorded aircraft with own ids, positions and times, written into encoded messages."""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fleet.bus.codec import Wire, encode
from fleet.contract import COLUMNS, Item, Message, Mission, Rows, Sample
from fleet.frames import Origin
from fleet.mission import GLOBAL_FRAMES
from fleet.telemetry.mavlink.steps import STEP_S
from fleet.telemetry.recording.fleet_news import named
from fleet.telemetry.replay.offset import Aside

GROUPS = 10  # groups of copies delayed by 0, 1, 2 … steps, to spread the load
_PLACES = ("position", "target")


class Group(NamedTuple):
    """Copies of one aircraft with equal delay."""

    ids: np.ndarray  # UAV ids, (n,)
    aside: Aside | None  # None until the original has a position
    lag_s: float  # delay behind the original [s]


class Prepared:
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

    def copies(self, group: Group) -> list[bytes]:
        """Return the bytes of every copy."""
        out = np.tile(self._bytes, (len(group.ids), 1))
        _write(out, self._uav, group.ids[:, None].astype(">u4"))
        _write(out, self._t, np.full((len(out), 1), self.message.t + group.lag_s, ">f8"))
        for at, t in self._times:
            _write(out, at, np.tile(t + group.lag_s, (len(out), 1)).astype(t.dtype))
        for at, x in self._places if group.aside is not None else ():
            there = np.tile(x, (len(out), 1, 1))
            there[..., 0], there[..., 1] = group.aside.move(x[:, 0], x[:, 1])  # type: ignore[union-attr]
            _write(out, at, there.reshape(len(out), -1))
        return [row.tobytes() for row in out]


def _write(out: np.ndarray, at: int, values: np.ndarray) -> None:
    told = np.ascontiguousarray(values).view(np.uint8)
    out[:, at : at + told.shape[1]] = told


class Copies:
    """Copies of the aircraft of one recording, processed step by step.

    Args:
        count: number of aircraft per recorded one, itself included
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._ids: dict[int, np.ndarray] = {}  # ids of the copies, by id of the original
        self._past: deque[list[Prepared]] = deque(maxlen=GROUPS)  # newest first
        self._asides: list[Aside | None] = [None] * GROUPS
        self._origin: Origin | None = None
        self._items: dict[int, tuple[tuple[Item, ...], dict[int, tuple[Item, ...]]]] = {}
        self._early: dict[int, Mission] = {}  # missions before the first position of the original

    def name(self, uav: int, ids: Sequence[int]) -> None:
        """Set the UAV ids of the copies of an original."""
        self._ids[uav] = np.array(ids, np.int64)

    def step(self, news: Sequence[Message]) -> list[Wire]:
        """Add the messages of the originals in one step of 0.1 s; return the messages of the copies."""
        if self.count < 2:
            return []
        if self._origin is None:
            self._early.update((message.uav, message) for message in news if isinstance(message, Mission))
            self._place(news)
            news = [*self._early.values(), *news] if self._origin is not None else news
        self._past.appendleft([Prepared(message) for message in news])
        return [wire for lag, past in enumerate(self._past) for one in past for wire in self._said(one, lag)]

    def last(self) -> Iterator[list[Wire]]:
        """Return step by step the remaining messages of the copies after the end of the originals."""
        for _ in range(GROUPS - 1 if self.count > 1 else 0):
            yield self.step([])

    def _place(self, news: Sequence[Message]) -> None:
        found = (m.position.x.numpy()[0] for m in news if isinstance(m, Sample) and m.position is not None)
        first = next((x for x in found if x[:2].any()), None)
        if first is not None:
            self._origin = Origin(*(int(v) for v in first))
            numbers = np.arange(1, self.count)
            self._asides = [Aside(numbers[lag::GROUPS], self.count, self._origin) for lag in range(GROUPS)]

    def _said(self, one: Prepared, lag: int) -> Iterator[Wire]:
        message = one.message
        ids = self._ids[message.uav][lag::GROUPS]
        if not len(ids):
            return
        group = Group(ids, self._asides[lag], lag * STEP_S)
        if isinstance(message, Mission) or bool(getattr(message, "sentence", "")):
            told = self._one_by_one(message, group)
        else:
            told = one.copies(group)
        kind = type(message)
        for uav, payload in zip(ids.tolist(), told, strict=True):
            yield Wire(kind, uav, payload, message.t + group.lag_s)

    def _one_by_one(self, message: Message, group: Group) -> list[bytes]:
        """Encode each copy separately: for missions, and for messages with a sentence; both are rare."""
        items = self._missions(message, group) if isinstance(message, Mission) else {}
        t = message.t + group.lag_s
        more: dict[int, dict[str, Any]] = {uav: {"items": moved} for uav, moved in items.items()}
        return [encode(named(message, uav, t=t, **more.get(uav, {}))) for uav in group.ids.tolist()]

    def _missions(self, mission: Mission, group: Group) -> dict[int, tuple[Item, ...]]:
        """Return the offset items of each copy, cached while the mission is unchanged."""
        known, moved = self._items.get(mission.uav, ((), {}))
        if known != mission.items:
            moved = {}
        self._items[mission.uav] = mission.items, moved
        ids = group.ids.tolist()
        if ids[0] not in moved and group.aside is not None:
            moved.update(zip(ids, _moved(mission.items, group.aside, len(ids)), strict=True))
        return {uav: moved.get(uav, mission.items) for uav in ids}


def _moved(items: tuple[Item, ...], aside: Aside, n: int) -> Iterator[tuple[Item, ...]]:
    lat, lon = (np.array([getattr(item, name) for item in items], np.int64) for name in ("lat_e7", "lon_e7"))
    there = aside.move(lat, lon) if items else (np.zeros((n, 0)), np.zeros((n, 0)))
    for north, east in zip(there[0].tolist(), there[1].tolist(), strict=True):
        yield tuple(
            msgspec.structs.replace(item, lat_e7=a, lon_e7=b) if item.frame in GLOBAL_FRAMES else item
            for item, a, b in zip(items, north, east, strict=True)
        )
