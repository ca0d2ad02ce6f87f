"""One aircraft as its messages tell it: rows, mode, losses, parameters, route."""

from collections import Counter
from collections.abc import Hashable
from typing import Any

import numpy as np

from fleet.contract import Link, Mission, Params, Sample, Status
from fleet.telemetry import heartbeat
from fleet.telemetry.clock import Clocks
from fleet.telemetry.dialects.mavlink import ROWS, Tick, raw_seconds
from fleet.telemetry.dialects.row import Row, believable
from fleet.telemetry.params import ParamBook
from fleet.telemetry.route import MESSAGES, RouteBook
from fleet.telemetry.shelf import Shelf

LOST_S = 3.0  # silence after which the link is called lost [s]
STATUS_S = 0.95  # between two messages; a little under the second, for it is asked every 0.1 s [s]
REMEMBER_S = 30.0  # how long a sentence stands [s]
SMOOTH = 0.4  # weight of the newest second in a rate


class Craft:
    """Everything the gateway knows of one aircraft; feed it with `hear`, empty it with `take`."""

    def __init__(self, uav: int, system: int, component: int, source: Hashable) -> None:
        self.uav, self.system, self.component, self.source = uav, system, component, source
        self.heard = float("-inf")  # arrival of the last message, fleet time [s since 1970]
        self.link = Link.LIVE
        self.autopilot, self.vehicle, self.mode, self.armed = "generic", heartbeat.UNKNOWN, "", False
        self.params, self.route = ParamBook(uav), RouteBook(uav)
        self.rates: dict[str, float] = {}
        self._clocks = Clocks()
        self._shelf = Shelf()
        self._counts: Counter[str] = Counter()
        self._received = self._missed = self._refused = 0
        self._seq: int | None = None
        self._sentence, self._said = "", float("-inf")
        self._jumps = 0
        self._told, self._told_at = (), float("-inf")  # type: tuple[Any, ...], float

    def hear(self, arrival: float, message: Any) -> None:
        """Take one message this aircraft's autopilot sent."""
        name = message.get_type()
        self.heard = arrival
        self._received += 1
        self._counts[name] += 1
        self._count_missed(message.get_seq())
        for row in ROWS.get(name, ()):
            self._lay(row, message, arrival)
        if name == "HEARTBEAT":
            self._read_heartbeat(message)
        elif name == "PARAM_VALUE":
            self.params.hear(message, self.autopilot, arrival)
        elif name in MESSAGES:
            self.route.hear(message, up=False, now=arrival)
        elif name == "STATUSTEXT" and message.severity <= 3:
            self.say(str(message.text).strip(), arrival)

    def say(self, sentence: str, now: float) -> None:
        """Leave a sentence for the operator; it stands for half a minute."""
        self._sentence, self._said = f"uav-{self.uav}: {sentence}", now

    def take(self, now: float) -> list[Sample | Status | Mission | Params]:
        """Hand over what is new at `now` [s since 1970]: rows, route, parameters, status."""
        found = [self._shelf.take(self.uav), self.route.take(now), self.params.take(now), self._status(now)]
        return [message for message in found if message is not None]

    def _lay(self, row: Row, message: Any, arrival: float) -> None:
        if row.autopilots and self.autopilot not in row.autopilots:
            return
        if row.when is not None and not row.when(message):
            return
        values = row.columns(message)
        if not believable(row.field, np.array(values, float)):
            self._refused += 1
            self.say(
                f"{row.message} with a value that is not finite or out of range was refused; check the sensor", arrival
            )
            return
        raw = 0.0 if row.tick is Tick.NONE else raw_seconds(row.tick, message)
        t = self._clocks.fleet(row.tick, raw, arrival)
        fresh = t is not None and self._shelf.put(row.field, row.rank, t, values)
        self._refused += not fresh and row.tick is not Tick.NONE  # without a time of its own it may well repeat one
        if self._clocks.jumps != self._jumps:
            self._jumps = self._clocks.jumps
            self.route.stale = True  # after a restart there may be another mission on board
            self.say(f"the aircraft's clock jumped ({self._jumps} times so far), time was anchored anew", arrival)

    def _read_heartbeat(self, message: Any) -> None:
        self.mode, self.armed = heartbeat.mode(message), heartbeat.armed(message)
        self.autopilot, self.vehicle = heartbeat.autopilot(message), heartbeat.vehicle(message)
        if self.vehicle == heartbeat.FIXED_WING and self.params.values.get("Q_ENABLE", 0.0) > 0:
            self.vehicle = heartbeat.QUADPLANE  # ArduPlane calls itself a fixed wing all the same

    def _count_missed(self, seq: int) -> None:
        if self._seq is not None:
            gap = (seq - self._seq - 1) & 0xFF
            self._missed += gap if gap < 128 else 0  # more is a late message, not a loss
        self._seq = seq

    def _status(self, now: float) -> Status | None:
        self.link = Link.LOST if now - self.heard > LOST_S else Link.LIVE
        state = (self.link, self.mode, self.armed)
        passed = now - self._told_at
        if state == self._told and 0 <= passed < STATUS_S:
            return None
        if not 0 <= passed < STATUS_S:
            self._measure(passed)
            self._told_at = now
        self._told = state
        return Status(
            uav=self.uav,
            t=now,
            link=self.link,
            mode=self.mode,
            armed=self.armed,
            autopilot=self.autopilot,
            vehicle=self.vehicle,
            rates_hz={name: round(hz, 2) for name, hz in self.rates.items() if hz > 0.005},
            received=self._received,
            missed=self._missed,
            rejected=self._refused + self.params.rejected + self.route.rejected,
            clock_offset_s=self._clocks.boot.offset_s,
            clock_jumps=self._clocks.jumps,
            sentence=self._words(now),
        )

    def _measure(self, passed: float) -> None:
        if 0 < passed < float("inf"):
            for name in {*self.rates, *self._counts}:
                hz = self._counts[name] / passed
                self.rates[name] = hz if name not in self.rates else (1 - SMOOTH) * self.rates[name] + SMOOTH * hz
        self._counts.clear()

    def _words(self, now: float) -> str:
        if self.link is Link.LOST:
            return f"uav-{self.uav}: nothing heard for {now - self.heard:.0f} s; check the radio link"
        return self._sentence if now - self._said < REMEMBER_S else ""
