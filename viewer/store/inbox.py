"""Queues of undecoded messages: a small fleet decodes every sample, a large fleet the newest of each UAV.

Samples that change the mission item are always decoded. Decoding costs more than ten times as much as queueing, so of a
large fleet only what is drawn is decoded.
"""

import struct
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from functools import cache, lru_cache
from itertools import takewhile
from math import inf, isfinite
from typing import Any, NamedTuple

import msgspec

from fleet.access.roles import TOPIC_RULES
from fleet.bus.bus_protocol import RawMessage
from fleet.bus.codec import Stamp
from fleet.contract import Array, Rows, Sample
from viewer.theme.events import LATEST

LARGE_FLEET = 300  # UAVs above which only the newest sample of each is decoded
MAX_QUEUED = 40  # queued samples of one UAV; then the newest replaces the last
MAX_UAVS = 4_000  # UAVs with queued samples: ids are untrusted input
_LEG_KEY, _NO_LEG = b"\xa3leg\x82", b"\xa3leg\xc0"  # msgpack: the key followed by a map, and by nil
MAX_SIZES = 1_000  # sizes of samples whose place of `_NO_LEG` is stored: payloads are untrusted input


class LegOnly(msgspec.Struct):
    """Active mission item of a sample."""

    leg: Rows


class SampleSubset(msgspec.Struct, frozen=True, gc=False):
    """Fields of a sample that the viewer uses; the others are skipped."""

    uav: int
    t: float
    attitude: Rows | None = None
    position: Rows | None = None
    air: Rows | None = None
    leg: Rows | None = None


class SampleValues(NamedTuple):
    """Values of one sample that the viewer uses; None where the sample has none."""

    t: float  # time of the sample [s since 1970]
    attitude: tuple[float, float, float] | None  # phi theta psi [rad]
    Va: float | None  # may be nan [m/s]
    point: tuple[float, float, float, float] | None  # time [s since 1970], scene ENU [10 m]
    leg: float | None  # current mission item


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


class QueuedMessage(msgspec.Struct, frozen=True, gc=False):  # thousands per second, which form no reference cycle
    """Undecoded message."""

    payload: bytes
    now: float  # arrival, monotonic [s]
    stamp: Stamp | None = None  # fencing token


class CoalescingQueue:
    """Newest message of each UAV; the caller must own one common lock to fill or empty it."""

    def __init__(self) -> None:
        self._newest: dict[int, QueuedMessage] = {}
        self._since: dict[int, float] = {}  # arrival of the first message queued of each UAV, in order, monotonic [s]

    def add(self, uav: int, message: QueuedMessage) -> bool:
        """Queue a message in place of the previous one; return False beyond `MAX_UAVS`."""
        if uav not in self._since:
            if len(self._since) >= MAX_UAVS:
                return False
            self._since[uav] = message.now
        self._newest[uav] = message
        return True

    def take(self, uavs: Iterable[int] | None = None) -> list[tuple[int, QueuedMessage]]:
        """Remove and return the messages of all or some UAVs."""
        queued = [
            uav for uav in (list(self._since) if uavs is None else uavs) if self._since.pop(uav, None) is not None
        ]
        return [(uav, self._newest.pop(uav)) for uav in queued]

    def waiting_since(self, before: float) -> list[int]:
        """Return the UAVs with a message queued since before a time, monotonic [s], the earliest first."""
        return [uav for uav, _ in takewhile(lambda item: item[1] <= before, self._since.items())]


class Inbox(CoalescingQueue):
    """Queue of samples: those to keep, in order, then the newest of each UAV of a large fleet.

    Most samples of a large fleet are replaced before they are read: they are queued by operations on whole batches.
    """

    def __init__(self) -> None:
        super().__init__()
        self.large_fleet = False
        self.full_rate_uavs: frozenset[int] = frozenset()  # UAVs of which every sample is kept, also in a large fleet
        self.dropped = 0  # messages without a UAV id, or beyond the limit
        self._retained: dict[int, list[QueuedMessage]] = {}  # before the newest
        self._last_leg: dict[int, bytes] = {}  # last mission item of each UAV
        self._no_leg_at: dict[int, int] = {}  # place of `_NO_LEG` in samples without a mission item, by their size

    def put(self, samples: list[RawMessage], now: float) -> None:
        """Queue samples in order of arrival."""
        if self.large_fleet and len(self._since) + len(samples) <= MAX_UAVS:
            samples = self._add_all(samples, now)
        for uav, payload, _, _ in samples:
            if uav is None or not self._put(uav, QueuedMessage(payload, now)):
                self.dropped += 1

    def _add_all(self, samples: list[RawMessage], now: float) -> list[RawMessage]:
        """Add samples as `add` does; return those of UAVs of which more than the newest may be read."""
        no_leg_at, special = self._no_leg_at.get, {None, *self.full_rate_uavs}
        special.update(
            uav
            for uav, payload, _, _ in samples
            if not payload.startswith(_NO_LEG, no_leg_at(len(payload), len(payload)))  # reads no more of the payload
        )
        newest: dict[Any, QueuedMessage] = {
            uav: QueuedMessage(payload, now) for uav, payload, _, _ in samples if uav not in special
        }
        self._newest.update(newest)
        self._since.update(dict.fromkeys(newest.keys() - self._since.keys(), now))
        return [message for message in samples if message[0] in special]

    def _put(self, uav: int, message: QueuedMessage) -> bool:
        """Queue one sample and keep it where it must be read; return False beyond `MAX_UAVS`."""
        is_retained = not self.large_fleet or uav in self.full_rate_uavs
        before = self._newest.get(uav) if is_retained else None
        is_retained = is_retained or self._is_new_leg(uav, message.payload)
        if not self.add(uav, message):
            return False
        if is_retained:
            retained = self._retained.setdefault(uav, [])
            retained += [self._newest.pop(uav)] if before is None else [before, self._newest.pop(uav)]
            del retained[MAX_QUEUED - 1 : -1]  # the newest replaces the last
        return True

    def take(self, uavs: Iterable[int] | None = None) -> list[tuple[int, QueuedMessage]]:
        """Remove and return the samples of all or some UAVs, each UAV in order of arrival."""
        taken: list[tuple[int, QueuedMessage]] = []
        for uav in list(self._since) if uavs is None else uavs:
            if self._since.pop(uav, None) is None:
                continue
            if uav in self._retained:
                taken += [(uav, message) for message in self._retained.pop(uav)]
            if (newest := self._newest.pop(uav, None)) is not None:
                taken.append((uav, newest))
        return taken

    def _is_new_leg(self, uav: int, payload: bytes) -> bool:
        """Return whether a sample changes the mission item; True when it cannot be decoded."""
        if _LEG_KEY not in payload:
            if len(self._no_leg_at) >= MAX_SIZES:
                self._no_leg_at.clear()
            if (place := payload.find(_NO_LEG)) >= 0:
                self._no_leg_at[len(payload)] = place
            return False
        try:
            leg = _LEG_DECODER.decode(payload).leg.x
        except _DECODE_ERRORS:
            return True
        previous = self._last_leg.get(uav)
        if len(self._last_leg) < MAX_UAVS or previous is not None:
            self._last_leg[uav] = leg.data
        return previous != leg.data


UNDATED_EPOCH_S = 946_684_800.0  # 2000-01-01: start time of a log without a date [s since 1970]
MAX_UNDATED_S = 30 * 86_400.0  # longest undated log; later times have a date [s]
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
        t, received, rate, _ = self
        silence_s = now - received if isfinite(received) else 0.0
        if silence_s <= COAST_S:
            return t + silence_s * rate
        return t + COAST_S * rate + (silence_s - COAST_S)


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


@lru_cache(maxsize=256)
def _last_row_layout(dtype: str, shape: tuple[int, ...]) -> tuple[Callable[..., tuple[float, ...]], int, int]:
    """Return the unpacker of the last row of a table, its offset, and the size of the table [bytes]; -1: invalid."""
    n, width = shape
    if n < 0 or not 0 < width < 100:
        return tuple, 0, -1
    pack = _packed(dtype, width)
    return pack.unpack_from, (n - 1) * pack.size, n * pack.size


def last_row(x: Array) -> tuple[float, ...]:
    """Return the last row of a table; empty when there is none.

    Raises:
        ValueError: when dtype, shape and byte count disagree; correct the sender.
    """
    if len(x.shape) != 2 or not x.shape[0]:
        return ()
    if x.dtype in _STRUCT_CODES:
        unpack_from, offset, size = _last_row_layout(x.dtype, x.shape)
        if len(x.data) == size:
            return unpack_from(x.data, offset)
    return tuple(map(float, x.numpy()[-1]))  # raises with the reason


_TIME, _ONE_TIME, _ONE_POSITION = struct.Struct("<d"), (1,), (1, 3)


def position_rows(uav: int, rows: Rows) -> tuple[Any, Any]:
    """Return the times (n,) and rows (n, 3 or more) of positions; decode a single row without numpy.

    Raises:
        ValueError: when the shapes do not match; the gateway must resend.
    """
    t, x = rows.t, rows.x
    if x.shape == _ONE_POSITION and t.shape == _ONE_TIME and t.dtype == "<f8" and len(t.data) == 8:
        return _TIME.unpack(t.data), (last_row(x),)
    times, positions = t.numpy(), x.numpy()
    if positions.ndim != 2 or positions.shape[1] < 3 or times.shape != (len(positions),):
        raise ValueError(f"uav-{uav}: position rows have shape {positions.shape}, expected (n, 3) and n times; resend")
    return times.tolist(), positions.tolist()
