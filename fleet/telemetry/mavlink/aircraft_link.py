"""One aircraft as it speaks: rows, mode, losses, parameters, route; heard in batches, handed over in small steps."""

from collections import deque
from collections.abc import Callable, Hashable
from typing import Any

from fleet.contract import Link, Mission, Params, Status
from fleet.telemetry.mavlink import heartbeat
from fleet.telemetry.mavlink.arrays.counts import HEARD, MISSED, RECEIVED, SPOKE
from fleet.telemetry.mavlink.arrays.fleet_arrays import Flock
from fleet.telemetry.mavlink.microservices.params import ParamBook
from fleet.telemetry.mavlink.microservices.route import MESSAGES, RouteBook
from fleet.telemetry.mavlink.onboard_log import Said
from fleet.telemetry.mavlink.timing import Timing
from fleet.telemetry.tables import clock

LOST_S = 3.0  # silence after which the link is called lost [s]
STATUS_S = 0.95  # between two messages; a little under the second, for it is asked every 0.1 s [s]
REMEMBER_S = 30.0  # how long a sentence stands [s]
SEVERE = 3  # texts up to this severity are an operator's business (MAV_SEVERITY_ERROR)
MOST_TEXTS = 2_000


class Craft:
    """Everything known of one aircraft; what comes by the thousand is in its flock, the rest comes by `queue`.

    Args:
        flock: the aircraft it is one of
        uav: UAV id
        system, component: MAVLink ids
        source: who sends what it says
        number: in the flock, of one that was forgotten; None: a new one
    """

    def __init__(
        self,
        flock: Flock,
        uav: int,
        system: int,
        component: int,
        source: Hashable = None,
        *,
        number: int | None = None,
    ) -> None:
        self.uav, self.system, self.component, self.source = uav, system, component, source
        self.flock = flock
        self.number = flock.add(uav) if number is None else number
        self.link = Link.LIVE
        self.autopilot, self.mode, self.armed = "generic", "", False
        self.kind = heartbeat.UNKNOWN  # of vehicle, as its heartbeat tells
        self.firmware = ""
        self.board = ""  # the autopilot's own number and version; empty: not told
        self.texts: deque[tuple[float, int, str]] = deque(maxlen=MOST_TEXTS)  # fleet time, severity, words
        self.params, self.route = ParamBook(uav), RouteBook(uav)
        self.rates: dict[str, float] = {}
        self.timing = Timing(lambda: flock.clocks[self.number])
        self._waiting: list[tuple[float, Callable[..., None], tuple[Any, ...]]] = []
        self._done = 0  # of those waiting
        self._refused = 0
        self._sentence, self._said = "", float("-inf")
        self._jumps, self._advance_s = 0, 0.0
        self._told: tuple[Any, ...] = ()
        self._told_at = float("-inf")

    @property
    def vehicle(self) -> str:
        """Name the kind of vehicle; ArduPlane calls itself a fixed wing also where it can hover."""
        hovers = self.kind == heartbeat.FIXED_WING and self.params.values.get("Q_ENABLE", 0.0) > 0
        return heartbeat.QUADPLANE if hovers else self.kind

    @property
    def heard(self) -> float:
        """Tell when the last message arrived, fleet time [s since 1970]."""
        return float(self.flock.counts.state[self.number, HEARD])

    def jumped(self, arrival: float) -> None:
        """Take note that the aircraft's clock jumped."""
        self.queue(arrival, self._jump, clock.jumps(self.flock.clocks[self.number]))

    def reanchored(self, arrival: float, step_s: float) -> None:
        """Take note that telemetry times were moved forward by `step_s`, because they fell behind their arrival."""
        self.queue(arrival, self._advance, step_s)

    def doubted(self, arrival: float, count: int) -> None:
        """Take note that so many rows were refused."""
        self.queue(arrival, self._count_refused, count)

    def queue(self, arrival: float, what: Callable[..., None], *arguments: Any) -> None:
        """Have `what` called with `arrival` as its last argument once time has come so far."""
        if self._done:
            del self._waiting[: self._done]
            self._done = 0
        in_order = not self._waiting or arrival >= self._waiting[-1][0]
        self._waiting.append((arrival, what, arguments))
        if not in_order:
            self._waiting.sort(key=lambda waiting: waiting[0])
        self.flock.look[self.number] = min(arrival, self.flock.look[self.number])

    def take(self, now: float) -> list[Status | Mission | Params]:
        """Hand over what is new at `now` [s since 1970] and no row: route, parameters, status."""
        while self._done < len(self._waiting) and self._waiting[self._done][0] <= now:
            arrival, what, arguments = self._waiting[self._done]
            self._done += 1
            what(*arguments, arrival)
        if self._done == len(self._waiting):  # what was heard is not kept
            self._waiting.clear()
            self._done = 0
        found = (self.route.take(now), self.params.take(now), self._status(now))
        self.flock.look[self.number] = self._next(now)
        return [message for message in found if message is not None]

    def _next(self, now: float) -> float:
        """Tell when to look again at the latest, `now` where the link is lost [s since 1970]."""
        if self.link is Link.LOST:
            return now
        queued = self._waiting[self._done][0] if self._done < len(self._waiting) else float("inf")
        return min(queued, self._told_at + STATUS_S, float(self.flock.counts.state[self.number, SPOKE]) + LOST_S)

    def say(self, sentence: str, now: float) -> None:
        """Leave a sentence for the operator; it stands for half a minute."""
        self._sentence, self._said = f"uav-{self.uav}: {sentence}", now

    def meet(self, message: Any) -> None:
        """Learn from a heartbeat what speaks here."""
        self.autopilot, self.kind = heartbeat.autopilot(message), heartbeat.vehicle(message)

    def hear(self, message: Any, now: float) -> None:
        """Take one MAVLink message that is no row."""
        name = message.get_type()
        if name == "HEARTBEAT":
            self.meet(message)
            self.mode, self.armed = heartbeat.mode(message), heartbeat.armed(message)
        elif name == "PARAM_VALUE":
            self.params.hear(message, self.autopilot, now)
        elif name in MESSAGES:
            self.route.hear(message, up=False, now=now)
        elif name == "HOME_POSITION" and self.autopilot == "px4":
            self.route.place_home(message.altitude * 1e-3)
        elif name == "STATUSTEXT":
            self._read(message.severity, str(message.text).strip(), now)
        elif name == "AUTOPILOT_VERSION":
            self.board = heartbeat.board(message)
            if message.flight_sw_version:
                self.firmware = self.firmware or heartbeat.firmware(message)

    def overhear(self, message: Any, now: float) -> None:
        """Take one message of the mission protocol that a ground station sent to this aircraft."""
        self.route.hear(message, up=True, now=now)

    def told(self, said: Said, now: float) -> None:
        """Take what an onboard log says that is no row."""
        if said.what == "mode":
            self.mode = said.value
        elif said.what == "armed":
            self.armed = said.value
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

    def _read(self, severity: int, words: str, now: float) -> None:
        self.texts.append((now, severity, words))
        self.firmware = self.firmware or (words if heartbeat.names_firmware(words) else "")
        if severity <= SEVERE:
            self.say(words, now)

    def _jump(self, count: int, now: float) -> None:
        self._jumps = count
        self.route.stale = True  # after a restart there may be another mission on board
        self.say(f"the aircraft's clock jumped ({count} times so far), time was anchored anew", now)

    def _advance(self, step_s: float, now: float) -> None:
        self._advance_s += step_s
        self.say(
            f"telemetry times were {step_s:.1f} s behind their arrival for half a minute and were re-anchored; "
            "expected real time: a slow or paused simulator falls behind",
            now,
        )

    def _count_refused(self, count: int, _: float) -> None:
        self._refused += count

    def _status(self, now: float) -> Status | None:
        counted = self.flock.counts.state[self.number]
        self.link = Link.LOST if now - counted[SPOKE] > LOST_S else Link.LIVE
        state = (self.link, self.mode, self.armed, self._jumps, self._advance_s)
        passed = now - self._told_at
        if state == self._told and 0 <= passed < STATUS_S:
            return None
        if not 0 <= passed < STATUS_S:
            self.rates = self.flock.counts.rates(self.number, passed)
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
            rates_hz=self.rates,
            received=int(counted[RECEIVED]),
            missed=int(counted[MISSED]),
            rejected=self._rejected(),
            **self.timing.told(now),
            clock_jumps=self._jumps,
            clock_advance_s=self._advance_s,
            sentence=self._words(now),
        )

    def _rejected(self) -> int:
        flood = int(self.flock.shelves.refused[self.number])
        return self._refused + flood + self.params.rejected + self.route.rejected

    def _words(self, now: float) -> str:
        if self.link is Link.LOST:
            silent_s = now - self.flock.counts.state[self.number, SPOKE]
            return f"uav-{self.uav}: nothing heard for {silent_s:.0f} s; check the radio link"
        return self._sentence if now - self._said < REMEMBER_S else ""
