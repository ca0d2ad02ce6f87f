"""One aircraft as it speaks: rows, mode, losses, parameters, route; heard in batches, handed over in small steps."""

from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

from fleet.contract import Link, Mission, Params, Sample, Status
from fleet.telemetry import clock, heartbeat
from fleet.telemetry.dialects.row import Row
from fleet.telemetry.onboard_log import Said
from fleet.telemetry.params import ParamBook
from fleet.telemetry.route import MESSAGES, RouteBook
from fleet.telemetry.settle import FIELDS, KEPT, NO_FIELD, REFUSED, Memory, settle
from fleet.telemetry.shelf import Shelf

LOST_S = 3.0  # silence after which the link is called lost [s]
STATUS_S = 0.95  # between two messages; a little under the second, for it is asked every 0.1 s [s]
REMEMBER_S = 30.0  # how long a sentence stands [s]
SMOOTH = 0.4  # weight of the newest second in a rate
SEVERE = 3  # texts up to this severity are an operator's business (MAV_SEVERITY_ERROR)
MOST_TEXTS = 2_000


class Laid(NamedTuple):
    """Rows of one aircraft in the order they were heard."""

    arrival: np.ndarray  # fleet time, (n,) [s since 1970]
    row: np.ndarray  # number in `rows`, (n,)
    raw_s: np.ndarray  # own time, (n,) [s]
    values: np.ndarray  # columns, zeros where a field has fewer, (n, 8)
    rows: Sequence[Row]


class Craft:
    """Everything known of one aircraft; feed it with `note`, `lay` and `queue`, empty it with `take`."""

    def __init__(self, uav: int, system: int, component: int, source: Hashable = None) -> None:
        self.uav, self.system, self.component, self.source = uav, system, component, source
        self.heard = float("-inf")  # arrival of the last message, fleet time [s since 1970]
        self.link = Link.LIVE
        self.autopilot, self.vehicle, self.mode, self.armed = "generic", heartbeat.UNKNOWN, "", False
        self.firmware = ""
        self.texts: deque[tuple[float, int, str]] = deque(maxlen=MOST_TEXTS)  # fleet time, severity, words
        self.params, self.route = ParamBook(uav), RouteBook(uav)
        self.rates: dict[str, float] = {}
        self._memory = Memory()
        self.shelf = Shelf()
        self._waiting: list[tuple[float, Callable[..., None], tuple[Any, ...]]] = []
        self._done = 0  # of those waiting
        self._arrivals: list[float] = []
        self._names: list[str] = []
        self._missed_by: list[int] = []
        self._counted = self._measured = 0  # of those arrivals: taken in, in a rate
        self._received = self._missed = self._refused = 0
        self._seq: int | None = None
        self._spoke = float("-inf")  # arrival of the last message handed over
        self._sentence, self._said = "", float("-inf")
        self._jumps = 0
        self._told: tuple[Any, ...] = ()
        self._told_at = float("-inf")

    def note(self, arrival: np.ndarray, names: Sequence[str], seq: np.ndarray | None = None) -> None:
        """Take note that messages came, to count them.

        Args:
            arrival: fleet times, never falling, (n,) [s since 1970]
            names: of the messages
            seq: their sequence numbers, (n,); None where there are none, so that none can be missed
        """
        done = self._measured
        self._arrivals, self._names = self._arrivals[done:] + arrival.tolist(), self._names[done:] + list(names)
        self._missed_by = self._missed_by[done:] + self._gaps(seq, len(arrival)).tolist()
        self._counted, self._measured = self._counted - done, 0
        self.heard = float(arrival[-1])

    def _gaps(self, seq: np.ndarray | None, n: int) -> np.ndarray:
        """Count the messages missed up to each one, (n,)."""
        before = self._missed_by[-1] if self._missed_by else self._missed
        if seq is None:
            return np.full(n, before)
        gaps = (np.diff(seq, prepend=seq[:1] - 1 if self._seq is None else self._seq) - 1) & 0xFF
        gaps[gaps >= 128] = 0  # a late message, not a loss
        self._seq = int(seq[-1])
        return np.cumsum(gaps) + before

    def lay(self, laid: Laid) -> None:
        """Take rows: give them their time, put them in order."""
        ticks, ranks, fields, given = (np.array(part) for part in zip(*map(_codes, laid.rows), strict=True))
        n, memory = len(laid.row), self._memory
        t, fate, field = np.empty(n), np.empty(n, np.int8), fields[laid.row]
        order = (ticks[laid.row], laid.raw_s, laid.arrival, field, ranks[laid.row], given[laid.row])
        jumped = settle(memory.clocks, memory.fields, *order, t, fate)
        for number in np.unique(field[fate == KEPT]).tolist():
            which = (field == number) & (fate == KEPT)
            self.shelf.lay(FIELDS[number], laid.arrival[which], t[which], laid.values[which])
        if jumped:
            self.queue(float(laid.arrival[jumped - 1]), self._jump, clock.jumps(memory.clocks))
        if refused := int((fate == REFUSED).sum()):
            self.queue(float(laid.arrival[-1]), self._count_refused, refused)

    def queue(self, arrival: float, what: Callable[..., None], *arguments: Any) -> None:
        """Have `what` called with `arrival` as its last argument once time has come so far."""
        if self._done:
            del self._waiting[: self._done]
            self._done = 0
        in_order = not self._waiting or arrival >= self._waiting[-1][0]
        self._waiting.append((arrival, what, arguments))
        if not in_order:
            self._waiting.sort(key=lambda waiting: waiting[0])

    def take(self, now: float) -> list[Sample | Status | Mission | Params]:
        """Hand over what is new at `now` [s since 1970]: rows, route, parameters, status."""
        while self._done < len(self._waiting) and self._waiting[self._done][0] <= now:
            arrival, what, arguments = self._waiting[self._done]
            self._done += 1
            what(*arguments, arrival)
        self._count(now)
        found = [self.shelf.take(self.uav, now), self.route.take(now), self.params.take(now), self._status(now)]
        return [message for message in found if message is not None]

    def say(self, sentence: str, now: float) -> None:
        """Leave a sentence for the operator; it stands for half a minute."""
        self._sentence, self._said = f"uav-{self.uav}: {sentence}", now

    def meet(self, message: Any) -> None:
        """Learn from a heartbeat what speaks here."""
        self.autopilot, self.vehicle = heartbeat.autopilot(message), heartbeat.vehicle(message)

    def hear(self, message: Any, now: float) -> None:
        """Take one MAVLink message that is no row."""
        name = message.get_type()
        if name == "HEARTBEAT":
            self.meet(message)
            self._fly(heartbeat.mode(message), heartbeat.armed(message))
        elif name == "PARAM_VALUE":
            self.params.hear(message, self.autopilot, now)
        elif name in MESSAGES:
            self.route.hear(message, up=False, now=now)
        elif name == "HOME_POSITION" and self.autopilot == "px4":
            self.route.place_home(message.altitude * 1e-3)
        elif name == "STATUSTEXT":
            self._read(message.severity, str(message.text).strip(), now)
        elif name == "AUTOPILOT_VERSION" and message.flight_sw_version:
            self.firmware = self.firmware or heartbeat.firmware(message)

    def overhear(self, message: Any, now: float) -> None:
        """Take one message of the mission protocol that a ground station sent to this aircraft."""
        self.route.hear(message, up=True, now=now)

    def told(self, said: Said, now: float) -> None:
        """Take what an onboard log says that is no row."""
        if said.what == "mode":
            self._fly(said.value, self.armed)
        elif said.what == "armed":
            self._fly(self.mode, said.value)
        elif said.what == "param":
            self.params.put(*said.value)
        elif said.what == "mission":
            self.route.adopt(said.value)
        elif said.what == "text":
            severity, words = said.value
            self._read(severity, words, now)

    def refuse(self, name: str, count: int, now: float) -> None:
        """Count rows whose values cannot be."""
        self._refused += count
        self.say(f"{name} with a value that is not finite or out of range was refused; check the sensor", now)

    def _fly(self, mode: str, armed: bool) -> None:
        self.mode, self.armed = mode, armed
        if self.vehicle == heartbeat.FIXED_WING and self.params.values.get("Q_ENABLE", 0.0) > 0:
            self.vehicle = heartbeat.QUADPLANE  # ArduPlane calls itself a fixed wing all the same

    def _read(self, severity: int, words: str, now: float) -> None:
        self.texts.append((now, severity, words))
        self.firmware = self.firmware or (words if heartbeat.names_firmware(words) else "")
        if severity <= SEVERE:
            self.say(words, now)

    def _jump(self, count: int, now: float) -> None:
        self._jumps = count
        self.route.stale = True  # after a restart there may be another mission on board
        self.say(f"the aircraft's clock jumped ({count} times so far), time was anchored anew", now)

    def _count_refused(self, count: int, _: float) -> None:
        self._refused += count

    def _count(self, now: float) -> None:
        before = self._counted
        self._counted = bisect_right(self._arrivals, now, before)
        if self._counted > before:
            self._received += self._counted - before
            self._spoke, self._missed = self._arrivals[self._counted - 1], self._missed_by[self._counted - 1]

    def _status(self, now: float) -> Status | None:
        self.link = Link.LOST if now - self._spoke > LOST_S else Link.LIVE
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
            rejected=self._refused + self.shelf.refused + self.params.rejected + self.route.rejected,
            clock_offset_s=float(self._memory.clocks[clock.BOOT, clock.OFFSET]),
            clock_jumps=self._jumps,
            sentence=self._words(now),
        )

    def _measure(self, passed: float) -> None:
        counts = Counter(self._names[self._measured : self._counted])
        self._measured = self._counted
        if 0 < passed < float("inf"):
            for name in {*self.rates, *counts}:
                hz = counts[name] / passed
                self.rates[name] = hz if name not in self.rates else (1 - SMOOTH) * self.rates[name] + SMOOTH * hz

    def _words(self, now: float) -> str:
        if self.link is Link.LOST:
            return f"uav-{self.uav}: nothing heard for {now - self._spoke:.0f} s; check the radio link"
        return self._sentence if now - self._said < REMEMBER_S else ""


def _codes(row: Row) -> tuple[int, int, int, int]:
    return row.tick, row.rank, FIELDS.index(row.field), FIELDS.index(row.given) if row.given else NO_FIELD
