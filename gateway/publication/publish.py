"""Publish contract messages on the bus, and answer queries with the latest of each aircraft."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from functools import partial
from typing import Any

import msgspec

from fleet.bus.bus_protocol import Bus, Replies
from fleet.bus.codec import EncodedMessage, Stamp, encode
from fleet.contract import PER_UAV, Alert, AlertKind, FleetState, GatewayCounters, History, Mission, Params, Status
from fleet.telemetry.recording.fleet_news import RESULT_TYPES
from gateway.publication.history import HistoryStore

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
        for wire in wires:
            self._bus.put(wire, stamp)
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
        self._latest: dict[type, dict[Hashable, tuple[Any, Stamp | None]]] = {kind: {} for kind in kinds}
        self.newest_account: GatewayCounters | None = None  # the newest statistics
        self._repeated_wires: dict[tuple[type, int], EncodedMessage] = {}  # the latest mission and parameters, packed
        self._repeated_t = 0.0
        for kind in kinds:
            bus.declare_queryable(kind, partial(self._answer_latest, kind))
        bus.declare_queryable(GatewayCounters, self._answer_account)
        bus.declare_queryable(History, self.history.answer)

    def publish(self, messages: Iterable[Any]) -> None:
        """Put messages on the bus."""
        for message in messages:
            kind = type(message)
            stamp = None
            if kind in RESULT_TYPES and getattr(message, "kind", None) is not AlertKind.SECOND_SENDER:
                message, stamp = self._with_epoch(message)
            if kind in self._latest:
                self._store_latest(
                    kind, (getattr(message, "uav", 0), str(getattr(message, "kind", ""))), message, stamp
                )
            wire = EncodedMessage(kind, message.uav if kind in PER_UAV else -1, encode(message), message.t)
            self._send([wire], stamp)

    def put(self, wires: Sequence[EncodedMessage]) -> None:
        """Put packed messages on the bus; they never contain results of workers."""
        for wire in wires:
            if wire.kind in self._latest:
                self._store_latest(wire.kind, (wire.uav, ""), wire, None)
        self._send(wires)

    def account(self, account: GatewayCounters) -> None:
        """Put the statistics on the bus."""
        self.newest_account = account
        self.session.send([EncodedMessage(GatewayCounters, -1, encode(account))])

    def snapshot(self) -> StatusSnapshot:
        """Return the newest statistics, and the newest status of every aircraft by id."""
        return self.newest_account, [
            s for s, _ in sorted(self._answer_latest(Status, None, {}, b""), key=lambda pair: pair[0].uav)
        ]

    def repeat(self, now: float) -> None:
        """Repeat missions and parameters when due; `now` is any monotonic clock [s]."""
        connected = self.session.poll()
        if now - self._repeated_t < REPEAT_S and not connected:
            return
        self._repeated_t = now
        self._send(list(self._repeated_wires.values()))

    def remove(self, uavs: Collection[int]) -> None:
        """Remove aircraft; queries no longer return them."""
        with self._lock:
            for kind, latest in self._latest.items():
                self._latest[kind] = {
                    key: entry for key, entry in latest.items() if getattr(entry[0], "uav", -1) not in uavs
                }
        self._repeated_wires = {who: wire for who, wire in self._repeated_wires.items() if who[1] not in uavs}
        self.history.remove(uavs)
        self._bus.remove_publishers(uavs)

    def _send(self, wires: Sequence[EncodedMessage], stamp: Stamp | None = None) -> None:
        self._repeated_wires.update({(wire.kind, wire.uav): wire for wire in wires if wire.kind in REPEATED_KINDS})
        self.history.add(wires)
        self.session.send(wires, stamp)

    def _store_latest(self, kind: type, key: Hashable, message: Any, stamp: Stamp | None) -> None:
        with self._lock:
            self._latest[kind][key] = message, stamp

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
        answers = [(entry.message() if isinstance(entry, EncodedMessage) else entry, stamp) for entry, stamp in entries]
        return [(one, stamp) for one, stamp in answers if uav is None or getattr(one, "uav", uav) == uav]

    def _answer_account(self, uav: int | None, settings: dict[str, str], payload: bytes) -> Replies:
        del uav, settings, payload
        return (
            []
            if self.newest_account is None
            else [(msgspec.structs.replace(self.newest_account, wall_t=time.time()), None)]
        )
