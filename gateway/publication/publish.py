"""Publish contract messages on the bus, and answer queries with the latest of each aircraft."""

import threading
import time
from collections.abc import Collection, Hashable, Iterable, Sequence
from functools import partial
from typing import Any

import msgspec

from fleet.bus.bus_protocol import Answers, Bus
from fleet.bus.codec import Stamp, Wire, encode
from fleet.contract import PER_UAV, Account, Alert, AlertKind, FleetState, History, Mission, Params, Status
from fleet.telemetry.recording.fleet_news import RESULTS
from gateway.publication.history import Keeper
from gateway.publication.router_session import Way

KEPT = (Status, Mission, Params, Alert)
AGAIN = (Mission, Params)
REPEAT_S = 10.0  # between repetitions of mission and parameters, for late subscribers [s]


Told = tuple[Account | None, list[Status]]


class Publisher:
    """Publish messages, store the latest of each kind, answer queries.

    Args:
        bus: destination of messages
        results: also answer queries for recorded results, as a worker does
    """

    def __init__(self, bus: Bus, results: bool = False) -> None:
        self.way, self.history = Way(bus), Keeper()
        self._bus = bus
        self._lock = threading.Lock()  # queries arrive on a thread of the bus
        kept = tuple(dict.fromkeys(KEPT + RESULTS)) if results else KEPT
        self._latest: dict[type, dict[Hashable, tuple[Any, Stamp | None]]] = {kind: {} for kind in kept}
        self.told: Account | None = None  # the newest statistics
        self._again: dict[tuple[type, int], Wire] = {}  # the latest mission and parameters, packed
        self._repeated = 0.0
        for kind in kept:
            bus.answer(kind, partial(self._answers, kind))
        bus.answer(Account, self._account_answer)
        bus.answer(History, self.history.answer)

    def publish(self, messages: Iterable[Any]) -> None:
        """Put messages on the bus."""
        for message in messages:
            kind = type(message)
            stamp = None
            if kind in RESULTS and getattr(message, "kind", None) is not AlertKind.SECOND_SENDER:
                message, stamp = self._claimed(message)
            if kind in self._latest:
                self._keep(kind, (getattr(message, "uav", 0), str(getattr(message, "kind", ""))), message, stamp)
            wire = Wire(kind, message.uav if kind in PER_UAV else -1, encode(message), message.t)
            self._send([wire], stamp)

    def put(self, wires: Sequence[Wire]) -> None:
        """Put packed messages on the bus; they never contain results of workers."""
        for wire in wires:
            if wire.kind in self._latest:
                self._keep(wire.kind, (wire.uav, ""), wire, None)
        self._send(wires)

    def account(self, account: Account) -> None:
        """Put the statistics on the bus."""
        self.told = account
        self.way.send([Wire(Account, -1, encode(account))])

    def newest(self) -> Told:
        """Return the newest statistics, and the newest status of every aircraft by id."""
        return self.told, [s for s, _ in sorted(self._answers(Status, None, {}, b""), key=lambda pair: pair[0].uav)]

    def repeat(self, mono: float) -> None:
        """Repeat missions and parameters when due; `now` is any monotonic clock [s]."""
        came = self.way.look()
        if mono - self._repeated < REPEAT_S and not came:
            return
        self._repeated = mono
        self._send(list(self._again.values()))

    def forget(self, uavs: Collection[int]) -> None:
        """Remove aircraft; queries no longer return them."""
        with self._lock:
            for kind, latest in self._latest.items():
                self._latest[kind] = {who: one for who, one in latest.items() if getattr(one[0], "uav", -1) not in uavs}
        self._again = {who: wire for who, wire in self._again.items() if who[1] not in uavs}
        self.history.forget(uavs)

    def _send(self, wires: Sequence[Wire], stamp: Stamp | None = None) -> None:
        self._again.update({(wire.kind, wire.uav): wire for wire in wires if wire.kind in AGAIN})
        self.history.keep(wires)
        self.way.send(wires, stamp)

    def _keep(self, kind: type, who: Hashable, message: Any, stamp: Stamp | None) -> None:
        with self._lock:
            self._latest[kind][who] = message, stamp

    def _claimed(self, message: Any) -> tuple[Any, Stamp]:
        """Stamp a recorded result with a new epoch, which supersedes results of workers for the same aircraft."""
        epoch = time.time_ns() // 1_000_000
        if isinstance(message, FleetState):
            rows = tuple(msgspec.structs.replace(row, epoch=epoch) for row in message.rows)
            message = msgspec.structs.replace(message, rows=rows)
        return message, Stamp(epoch, self._bus.writer)

    def _answers(self, kind: type, uav: int | None, settings: dict[str, str], payload: bytes) -> Answers:
        del settings, payload
        with self._lock:
            found = list(self._latest[kind].values())
        told = [(one.message() if isinstance(one, Wire) else one, stamp) for one, stamp in found]
        return [(one, stamp) for one, stamp in told if uav is None or getattr(one, "uav", uav) == uav]

    def _account_answer(self, uav: int | None, settings: dict[str, str], payload: bytes) -> Answers:
        del uav, settings, payload
        return [] if self.told is None else [(msgspec.structs.replace(self.told, now=time.time()), None)]
