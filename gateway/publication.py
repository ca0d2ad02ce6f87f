"""Publish contract messages on the bus; answer queries with the latest, and with the past, of each aircraft."""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from math import isfinite
from typing import Any

import msgspec

from fleet.bus.bus_protocol import Replies
from fleet.bus.codec import EncodedMessage, Stamp, encode
from fleet.bus.session import Bus
from fleet.contract import (
    PER_UAV,
    Alert,
    AlertKind,
    FleetState,
    GatewayCounters,
    History,
    Mission,
    Params,
    Sample,
    Status,
)
from fleet.telemetry.recording.fleet_news import RESULT_TYPES

HISTORY_S = 160.0  # length of the history of a twin
MAX_BYTES = 512 << 20  # bytes over all aircraft; beyond, the history of every aircraft becomes shorter
TRIM_S = 1.0  # excess of the history at which its oldest messages are deleted
KINDS = (Sample, Status)


class _UavHistory:
    """Packed messages of one aircraft: (fleet time [s since 1970], bytes), oldest first, by kind."""

    def __init__(self, since: float) -> None:
        self.payloads: dict[type, deque[tuple[float, bytes]]] = {kind: deque() for kind in KINDS}
        self.size = 0
        self.since = since  # complete from this time on [s since 1970]
        self.trimmed_before = since  # nothing older than this is stored [s since 1970]

    def trim(self, before: float, max_bytes: int) -> int:
        """Delete messages older than `before` [s since 1970] or beyond `max_bytes`; return the bytes deleted."""
        size = self.size
        self.trimmed_before = before
        for queue in self.payloads.values():
            while queue and queue[0][0] < before:
                self._drop_oldest(queue)
        while self.size > max_bytes:
            self._drop_oldest(min(filter(None, self.payloads.values()), key=lambda queue: queue[0][0]))
        return size - self.size

    def _drop_oldest(self, queue: deque[tuple[float, bytes]]) -> None:
        t, payload = queue.popleft()
        self.size -= len(payload)
        self.since = max(self.since, t)


class HistoryStore:
    """Store packed messages and answer history queries, one aircraft at a time.

    Args:
        seconds: length of the history, on the fleet clock
        max_bytes: over all aircraft, shared equally
    """

    def __init__(self, seconds: float = HISTORY_S, max_bytes: int = MAX_BYTES) -> None:
        self.size = 0  # bytes stored
        self._share = max_bytes  # of one aircraft [bytes]
        self._seconds, self._max_bytes = seconds, max_bytes
        self._histories: dict[int, _UavHistory] = {}
        self._lock = threading.Lock()  # queries arrive on a thread of the bus

    def add(self, wires: Iterable[EncodedMessage]) -> None:
        """Store packed messages; those without a time are skipped."""
        longest_s = self._seconds + TRIM_S
        with self._lock:
            for kind, uav, payload, t in wires:
                if kind not in KINDS or not isfinite(t):
                    continue
                history = self._histories.get(uav) or self._add_uav(uav, t)
                size = len(payload)
                history.payloads[kind].append((t, payload))
                history.size += size
                self.size += size
                if t - history.trimmed_before > longest_s or history.size > self._share:
                    self.size -= history.trim(t - self._seconds, self._share)
                if self.size > self._max_bytes:  # a silent aircraft has more than its share, which has become smaller
                    self.size -= sum(one.trim(one.trimmed_before, self._share) for one in self._histories.values())

    def _add_uav(self, uav: int, t: float) -> _UavHistory:
        history = self._histories[uav] = _UavHistory(t)
        self._share = self._max_bytes // len(self._histories)
        return history

    def remove(self, uavs: Iterable[int]) -> None:
        """Remove aircraft; the others get their share of memory."""
        with self._lock:
            for uav in uavs:
                if (history := self._histories.pop(uav, None)) is not None:
                    self.size -= history.size
            self._share = self._max_bytes // max(len(self._histories), 1)

    def answer(self, uav: int | None, settings: dict[str, str], payload: bytes) -> Replies:
        """Answer a query on the bus.

        Raises:
            ValueError: when it is not about one aircraft: all histories do not fit one message.
        """
        del payload
        if uav is None:
            raise ValueError(
                "history: found a query for every aircraft, expected one id in the key; query one at a time"
            )
        seconds = self._seconds
        with contextlib.suppress(ValueError):
            seconds = float(settings.get("seconds", seconds))
        with self._lock:
            history = self._histories.get(uav)
            if history is None or not any(history.payloads.values()):
                return []
            payloads, since = {kind: list(selected) for kind, selected in history.payloads.items()}, history.since
        newest = max(items[-1][0] for items in payloads.values() if items)
        first = newest - seconds
        selected: dict[type, tuple[Any, ...]] = {
            kind: tuple(msgspec.Raw(payload) for t, payload in items if t >= first) for kind, items in payloads.items()
        }
        since = max(since, first)
        return [(History(uav=uav, t=newest, since=since, samples=selected[Sample], statuses=selected[Status]), None)]


LEASE_S = 1.0  # time after which an unresponsive router counts as lost [s]

_log = logging.getLogger(__name__)


class RouterSession:
    """Send packed messages and count the published and the unsent ones.

    Args:
        bus: destination
        clock: any monotonic clock [s]
    """

    def __init__(self, bus: Bus, clock: Callable[[], float] = time.monotonic) -> None:
        self._router = bus.router
        self.published = 0  # sent to a connected router
        self.unsent = 0  # no router was connected
        self.unconfirmed = 0  # of those published: within a lease before the router was lost
        self._bus, self._clock = bus, clock
        if not self._router:
            _log.warning("no router is connected yet: unsent messages are counted, everything else continues")
        self._published_at: deque[tuple[float, int]] = deque([(clock(), 0)])  # time, and messages published until then

    @property
    def connected(self) -> bool:
        """Return whether a router was connected at the last poll."""
        return bool(self._router)

    def poll(self) -> bool:
        """Return whether a router has connected since the last poll; call it a few times a second."""
        now, previous = self._clock(), self._router
        self._router = self._bus.router
        if previous and self._router != previous:
            self.unconfirmed += self.published - self._published_at[0][1]
            _log.warning("the router is disconnected: unsent messages are counted, everything else continues")
        reconnected = bool(self._router) and self._router != previous
        if reconnected:
            _log.warning("the router is connected; %d messages were unsent so far", self.unsent)
        self._published_at.append((now, self.published))
        while len(self._published_at) > 1 and self._published_at[1][0] <= now - LEASE_S:
            self._published_at.popleft()
        return reconnected

    def send(self, wires: Sequence[EncodedMessage], stamp: Stamp | None = None) -> None:
        """Send messages, or count them as unsent without a router."""
        if not self._router:
            self.unsent += len(wires)
            return
        self._bus.put_all(wires, stamp)
        self.published += len(wires)


LATEST_KINDS = (Status, Mission, Params, Alert)
REPEATED_KINDS = (Mission, Params)
REPEAT_S = 10.0  # between repetitions of mission and parameters, for late subscribers [s]


StatusSnapshot = tuple[GatewayCounters | None, list[Status]]


class Publisher:
    """Publish messages, store the latest of each kind, answer queries.

    Args:
        bus: destination of messages
        results: also answer queries for recorded results, as a worker does
    """

    def __init__(self, bus: Bus, results: bool = False) -> None:
        self.session, self.history = RouterSession(bus), HistoryStore()
        self._bus = bus
        self._lock = threading.Lock()  # queries arrive on a thread of the bus
        kinds = tuple(dict.fromkeys(LATEST_KINDS + RESULT_TYPES)) if results else LATEST_KINDS
        self._latest: dict[type, dict[tuple[int, str], tuple[EncodedMessage, Stamp | None]]] = {
            kind: {} for kind in kinds
        }
        self.newest_account: GatewayCounters | None = None  # the newest statistics
        self._repeated_t = 0.0
        for kind in kinds:
            bus.declare_queryable(kind, partial(self._answer_latest, kind))
        bus.declare_queryable(GatewayCounters, self._answer_account)
        bus.declare_queryable(History, self.history.answer)

    def publish(self, messages: Iterable[Any]) -> None:
        """Put messages on the bus."""
        plain: list[EncodedMessage] = []  # not sent yet
        for message in messages:
            kind, stamp = type(message), None
            if kind in RESULT_TYPES and getattr(message, "kind", None) is not AlertKind.SECOND_SENDER:
                message, stamp = self._with_epoch(message)
            wire = EncodedMessage(kind, message.uav if kind in PER_UAV else -1, encode(message), message.t)
            variant = str(getattr(message, "kind", ""))
            if not variant and stamp is None:
                plain.append(wire)
                continue
            self._send(plain)
            self._send([wire], variant, stamp)
            plain = []
        self._send(plain)

    def put(self, wires: Sequence[EncodedMessage]) -> None:
        """Put packed messages on the bus; they never contain results of workers."""
        self._send(wires)

    def account(self, account: GatewayCounters) -> None:
        """Put the statistics on the bus."""
        self.newest_account = account
        self.session.send([EncodedMessage(GatewayCounters, -1, encode(account))])

    def snapshot(self) -> StatusSnapshot:
        """Return the newest statistics, and the newest status of every aircraft by id."""
        statuses = [status for status, _ in self._answer_latest(Status, None, {}, b"")]
        return self.newest_account, sorted(statuses, key=lambda status: status.uav)

    def repeat(self, now: float) -> None:
        """Repeat missions and parameters when due; `now` is any monotonic clock [s]."""
        connected = self.session.poll()
        if now - self._repeated_t < REPEAT_S and not connected:
            return
        self._repeated_t = now
        self._send([wire for kind in REPEATED_KINDS for wire, _ in self._latest[kind].values()])

    def remove(self, uavs: Collection[int]) -> None:
        """Remove aircraft; queries no longer return them."""
        with self._lock:
            for kind, latest in self._latest.items():
                self._latest[kind] = {key: entry for key, entry in latest.items() if entry[0].uav not in uavs}
        self.history.remove(uavs)
        self._bus.remove_publishers(uavs)

    def _send(self, wires: Sequence[EncodedMessage], variant: str = "", stamp: Stamp | None = None) -> None:
        """Store and put messages; the latest of each `variant`, e.g. kind of alert, is stored."""
        latest = self._latest
        with self._lock:
            for wire in wires:
                if wire[0] in latest:
                    latest[wire.kind][wire.uav, variant] = wire, stamp
        self.history.add(wires)
        self.session.send(wires, stamp)

    def _with_epoch(self, message: Any) -> tuple[Any, Stamp]:
        """Stamp a recorded result with a new epoch, which supersedes results of workers for the same aircraft."""
        epoch = time.time_ns() // 1_000_000
        if isinstance(message, FleetState):
            rows = tuple(msgspec.structs.replace(row, epoch=epoch) for row in message.rows)
            message = msgspec.structs.replace(message, rows=rows)
        return message, Stamp(epoch, self._bus.writer)

    def _answer_latest(self, kind: type, uav: int | None, settings: dict[str, str], payload: bytes) -> Replies:
        del settings, payload
        with self._lock:
            entries = list(self._latest[kind].values())
        return [(wire.message(), stamp) for wire, stamp in entries if uav is None or wire.uav in (uav, -1)]

    def _answer_account(self, uav: int | None, settings: dict[str, str], payload: bytes) -> Replies:
        del uav, settings, payload
        account = self.newest_account
        return [] if account is None else [(msgspec.structs.replace(account, wall_t=time.time()), None)]
