"""Queues of undecoded messages: a small fleet decodes every sample, a large fleet the newest of each UAV.

Samples that change the mission item are always decoded. Decoding costs ten times as much as queueing, so of a large
fleet only what is drawn is decoded.
"""

import struct
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from functools import cache
from math import inf, isfinite
from typing import Any, NamedTuple

import msgspec

from fleet.access.roles import TOPIC_RULES
from fleet.bus.bus_protocol import RawMessage
from fleet.bus.codec import Stamp
from fleet.contract import Array, Rows, Sample

LARGE_FLEET = 300  # UAVs above which only the newest sample of each is decoded
MAX_QUEUED = 40  # queued samples of one UAV; then the newest replaces the last
MAX_UAVS = 4_000  # UAVs with queued samples: ids are untrusted input
_LEG_KEY = b"\xa3leg\x82"  # msgpack: the key followed by a map (not nil)


class LegOnly(msgspec.Struct):
    """Active mission item of a sample."""

    leg: Rows


class SampleSubset(msgspec.Struct, frozen=True):
    """Fields of a sample that the viewer uses; the others are skipped."""

    uav: int
    t: float
    attitude: Rows | None = None
    position: Rows | None = None
    air: Rows | None = None
    leg: Rows | None = None


_SUBSET_DECODER, _LEG_DECODER = msgspec.msgpack.Decoder(SampleSubset), msgspec.msgpack.Decoder(LegOnly)
_DECODE_ERRORS = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def decode_sample(payload: bytes) -> SampleSubset:
    """Decode the fields of a sample that the viewer uses.

    Raises:
        ValueError: when the message is too large or malformed; correct the sender.
    """
    if len(payload) > TOPIC_RULES[Sample.topic].max_bytes:
        raise ValueError(
            f"sample: found {len(payload):,} bytes, expected {TOPIC_RULES[Sample.topic].max_bytes:,}; send less"
        )
    try:
        return _SUBSET_DECODER.decode(payload)
    except _DECODE_ERRORS as error:
        raise ValueError(
            f"sample: found {len(payload)} malformed bytes ({str(error)[:80]}), expected msgpack; resend"
        ) from None


class QueuedMessage:
    """Queued payload, its arrival time, monotonic [s], and its fencing token; slots make it cheap to create."""

    __slots__ = ("now", "payload", "stamp")

    def __init__(self, payload: bytes, now: float, stamp: Stamp | None = None) -> None:
        self.payload, self.now, self.stamp = payload, now, stamp


class PendingMessages(NamedTuple):
    """Queued messages of one UAV and the arrival time of the first, monotonic [s]."""

    first_received: float
    messages: list[QueuedMessage]


class Inbox:
    """Queue of samples; the caller must own one common lock to fill or empty it."""

    def __init__(self) -> None:
        self.large_fleet = False
        self.full_rate_uavs: frozenset[int] = frozenset()  # UAVs of which every sample is kept, also in a large fleet
        self.dropped = 0  # messages without a UAV id, or beyond the limit
        self._pending: dict[int, PendingMessages] = {}  # oldest first
        self._leg_changed_uavs: set[int] = set()  # UAVs whose last queued sample changes the mission item
        self._last_leg: dict[int, bytes] = {}  # last mission item of each UAV

    def put(self, samples: list[RawMessage], now: float) -> None:
        """Queue samples in order of arrival."""
        large_fleet, full_rate, leg_changed = self.large_fleet, self.full_rate_uavs, self._leg_changed_uavs
        for uav, payload, _, _ in samples:
            if uav is None:
                self.dropped += 1
                continue
            is_new_leg = large_fleet and _LEG_KEY in payload and self._is_new_leg(uav, payload)
            pending = self._pending.get(uav)
            if pending is None:
                if len(self._pending) >= MAX_UAVS:
                    self.dropped += 1
                    continue
                self._pending[uav] = PendingMessages(now, [QueuedMessage(payload, now)])
            elif (not large_fleet or uav in full_rate or uav in leg_changed) and len(pending.messages) < MAX_QUEUED:
                pending.messages.append(QueuedMessage(payload, now))
            else:
                pending.messages[-1] = QueuedMessage(payload, now)
            leg_changed.discard(uav)
            if is_new_leg:
                leg_changed.add(uav)

    def _is_new_leg(self, uav: int, payload: bytes) -> bool:
        """Return whether a sample changes the mission item; True when it cannot be decoded."""
        try:
            leg = _LEG_DECODER.decode(payload).leg.x
        except _DECODE_ERRORS:
            return True
        previous = self._last_leg.get(uav)
        if len(self._last_leg) < MAX_UAVS or previous is not None:
            self._last_leg[uav] = leg.data
        return previous != leg.data

    def take(self, uavs: Iterable[int] | None = None) -> Iterator[tuple[int, QueuedMessage]]:
        """Remove and yield the messages of all or some UAVs, each UAV in order of arrival."""
        for uav in list(self._pending) if uavs is None else uavs:
            if (pending := self._pending.pop(uav, None)) is not None:
                self._leg_changed_uavs.discard(uav)
                yield from ((uav, message) for message in pending.messages)

    def waiting_since(self, before: float) -> list[int]:
        """Return the UAVs with a message queued since before a time, monotonic [s]."""
        uavs = []
        for uav, pending in self._pending.items():
            if pending.first_received > before:
                break
            uavs.append(uav)
        return uavs


class CoalescingQueue:
    """Queue of the newest message per UAV; a message is due `wait_s` after the first one it replaced."""

    def __init__(self, wait_s: float) -> None:
        self._wait_s = wait_s
        self._pending: dict[int, tuple[float, QueuedMessage]] = {}  # first arrival, monotonic [s]; oldest first

    def put(self, uav: int, message: QueuedMessage) -> None:
        """Queue a message in place of the previous one."""
        previous = self._pending.get(uav)
        if previous is not None or len(self._pending) < MAX_UAVS:
            self._pending[uav] = (previous[0] if previous is not None else message.now), message

    def drop(self, uav: int) -> None:
        """Discard the queued message of a UAV."""
        self._pending.pop(uav, None)

    def due(self, now: float) -> list[tuple[int, QueuedMessage]]:
        """Remove and return the messages that are due at `now`, monotonic [s]."""
        messages = []
        while (
            self._pending
            and (uav := next(iter(self._pending))) is not None
            and self._pending[uav][0] + self._wait_s <= now
        ):
            messages.append((uav, self._pending.pop(uav)[1]))
        return messages


UNDATED_EPOCH_S = 946_684_800.0  # 2000-01-01: start time of a log without a date [s since 1970]
MAX_UNDATED_S = 30 * 86_400.0  # longest undated log; later times have a date [s]
LATEST = 4e9  # later times are invalid [s since 1970]
RATE_WINDOW_S = 2.0  # wall time over which the rate is measured [s]
COAST_S = 1.0  # data time advances at the last rate for this long without data, then at 1 [s]
REALTIME_TOLERANCE = 0.2  # a rate within this of 1 is real time


class DataTime(NamedTuple):
    """Newest data time of a UAV and the rate at which it advances."""

    t: float = -inf  # newest, [s since 1970]
    received: float = -inf  # arrival of t, monotonic [s]
    rate: float = 1.0  # data seconds per wall second, measured
    window_start: tuple[float, float] = (-inf, -inf)  # t and received at the start of the rate measurement

    def update(self, t: float, now: float) -> "DataTime":
        """Update with a time received at `now`, monotonic [s]; ignore a time that is not newer."""
        if not t > self.t:
            return self
        start_t, start = self.window_start
        elapsed = now - start
        if not isfinite(elapsed):
            return DataTime(t, now, self.rate, (t, now))
        if elapsed < RATE_WINDOW_S:
            return DataTime(t, now, self.rate, self.window_start)
        rate = (t - start_t) / elapsed
        return DataTime(t, now, 1.0 if abs(rate - 1) < REALTIME_TOLERANCE else rate, (t, now))

    def estimate(self, now: float) -> float:
        """Estimate the current data time [s since 1970]; -inf before the first message."""
        silence_s = now - self.received if isfinite(self.received) else 0.0
        return self.t + min(silence_s, COAST_S) * self.rate + max(silence_s - COAST_S, 0.0)


def is_dated(t: float) -> bool:
    """Return whether a time has a calendar date; otherwise it counts from the start of its log."""
    return UNDATED_EPOCH_S + MAX_UNDATED_S <= t < LATEST


def time_of_day(t: float) -> str:
    """Format a time: 15:53:31 (UTC), or +2:05 since the start of an undated log."""
    if is_dated(t):
        return f"{datetime.fromtimestamp(t, UTC):%H:%M:%S}"
    if not 0 <= t < LATEST:
        return "–"
    minutes, seconds = divmod(int(t - UNDATED_EPOCH_S if t >= UNDATED_EPOCH_S else t), 60)
    return f"+{minutes}:{seconds:02d}"


def date_text(t: float) -> str:
    """Format the date of a time, or state that there is none."""
    return f"{datetime.fromtimestamp(t, UTC):%Y-%m-%d} UTC" if is_dated(t) else "undated, since its start"


def timestamp(t: float) -> str:
    """Format date and time: 2018-07-18 15:53:31 UTC."""
    return f"{datetime.fromtimestamp(t, UTC):%Y-%m-%d %H:%M:%S} UTC" if is_dated(t) else f"undated {time_of_day(t)}"


def rate_text(rate: float) -> str:
    """Format a rate: 4×."""
    return f"{rate:.0f}×" if rate >= 1.5 else f"{rate:.2g}×"


_STRUCT_CODES = {"<f4": "f", "<f8": "d", "<i4": "i", "<i8": "q", "|u1": "B"}


@cache
def _packed(dtype: str, width: int) -> struct.Struct:
    return struct.Struct(f"<{width}{_STRUCT_CODES[dtype]}")


def last_row(x: Array) -> tuple[float, ...]:
    """Return the last row of a table; empty when there is none.

    Raises:
        ValueError: when dtype, shape and byte count disagree; correct the sender.
    """
    shape = x.shape
    if len(shape) != 2 or not shape[0]:
        return ()
    if (
        x.dtype not in _STRUCT_CODES
        or not 0 < shape[1] < 100
        or len(x.data) != shape[0] * _packed(x.dtype, shape[1]).size
    ):
        return tuple(map(float, x.numpy()[-1]))  # raises with the reason
    pack = _packed(x.dtype, shape[1])
    return pack.unpack_from(x.data, (shape[0] - 1) * pack.size)


def position_rows(uav: int, rows: Rows) -> tuple[Any, Any]:
    """Return the times (n,) and rows (n, 3 or more) of positions; decode a single row without numpy.

    Raises:
        ValueError: when the shapes do not match; the gateway must resend.
    """
    t, x = rows.t, rows.x
    if x.shape == (1, 3) and t.shape == (1,):
        row_times, row = last_row(Array(t.dtype, (1, 1), t.data)), last_row(x)
        return row_times, (row,)
    times, positions = t.numpy(), x.numpy()
    if positions.ndim != 2 or positions.shape[1] < 3 or times.shape != (len(positions),):
        raise ValueError(f"uav-{uav}: position rows have shape {positions.shape}, expected (n, 3) and n times; resend")
    return times.tolist(), positions.tolist()
