"""MAVLink state of one aircraft: rows, mode, losses, parameters, mission; received in batches, returned in steps."""

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

LOST_S = 3.0  # silence after which the link is lost [s]
STATUS_S = 0.95  # period of status messages; below 1 s because it is checked every 0.1 s [s]
REMEMBER_S = 30.0  # display time of an operator text [s]
SEVERE = 3  # texts up to this severity are shown to the operator (MAV_SEVERITY_ERROR)
MOST_TEXTS = 2_000


class Craft:
    """State of one aircraft; frequent data are in the shared arrays, all other messages pass through `queue`.

    Args:
        arrays: shared arrays of all aircraft
        uav: UAV id
        system, component: MAVLink ids
        source: sender of its messages
        number: number in the arrays of a removed aircraft; None: a new number
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
        self.kind = heartbeat.UNKNOWN  # vehicle type from the heartbeat
        self.firmware = ""
        self.board = ""  # hardware id and firmware version of the autopilot, or empty
        self.texts: deque[tuple[float, int, str]] = deque(maxlen=MOST_TEXTS)  # fleet time, severity, text
        self.params, self.route = ParamBook(uav), RouteBook(uav)
        self.rates: dict[str, float] = {}
        self.timing = Timing(lambda: flock.clocks[self.number])
        self._waiting: list[tuple[float, Callable[..., None], tuple[Any, ...]]] = []
        self._done = 0  # processed entries of the queue
        self._refused = 0
        self._sentence, self._said = "", float("-inf")
        self._jumps, self._advance_s = 0, 0.0
        self._told: tuple[Any, ...] = ()
        self._told_at = float("-inf")

    @property
    def vehicle(self) -> str:
        """Return the vehicle type; an ArduPlane quadplane also sends MAV_TYPE_FIXED_WING."""
        hovers = self.kind == heartbeat.FIXED_WING and self.params.values.get("Q_ENABLE", 0.0) > 0
        return heartbeat.QUADPLANE if hovers else self.kind

    @property
    def heard(self) -> float:
        """Return the arrival of the last message, fleet time [s since 1970]."""
        return float(self.flock.counts.state[self.number, HEARD])

    def jumped(self, arrival: float) -> None:
        """Queue a jump of the aircraft's clock."""
        self.queue(arrival, self._jump, clock.jumps(self.flock.clocks[self.number]))

    def reanchored(self, arrival: float, step_s: float) -> None:
        """Queue a forward re-anchoring of the telemetry times by `step_s`."""
        self.queue(arrival, self._advance, step_s)

    def doubted(self, arrival: float, count: int) -> None:
        """Queue a number of rejected rows."""
        self.queue(arrival, self._count_refused, count)

    def queue(self, arrival: float, what: Callable[..., None], *arguments: Any) -> None:
        """Call `callback` with `arrival` as its last argument when `collect` reaches that time."""
        if self._done:
            del self._waiting[: self._done]
            self._done = 0
        in_order = not self._waiting or arrival >= self._waiting[-1][0]
        self._waiting.append((arrival, what, arguments))
        if not in_order:
            self._waiting.sort(key=lambda waiting: waiting[0])
        self.flock.look[self.number] = min(arrival, self.flock.look[self.number])

    def take(self, now: float) -> list[Status | Mission | Params]:
        """Return the new mission, parameters and status at `now` [s since 1970]."""
        while self._done < len(self._waiting) and self._waiting[self._done][0] <= now:
            arrival, what, arguments = self._waiting[self._done]
            self._done += 1
            what(*arguments, arrival)
        if self._done == len(self._waiting):  # free the processed messages
            self._waiting.clear()
            self._done = 0
        found = (self.route.take(now), self.params.take(now), self._status(now))
        self.flock.look[self.number] = self._next(now)
        return [message for message in found if message is not None]

    def _next(self, now: float) -> float:
        """Return the latest time of the next `collect`, `now` if the link is lost [s since 1970]."""
        if self.link is Link.LOST:
            return now
        queued = self._waiting[self._done][0] if self._done < len(self._waiting) else float("inf")
        return min(queued, self._told_at + STATUS_S, float(self.flock.counts.state[self.number, SPOKE]) + LOST_S)

    def say(self, sentence: str, now: float) -> None:
        """Set the operator text; it expires after `TEXT_LIFETIME_S`."""
        self._sentence, self._said = f"uav-{self.uav}: {sentence}", now

    def meet(self, message: Any) -> None:
        """Set autopilot and vehicle type from a heartbeat."""
        self.autopilot, self.kind = heartbeat.autopilot(message), heartbeat.vehicle(message)

    def hear(self, message: Any, now: float) -> None:
        """Process one MAVLink message that is not a table row."""
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
        """Process one mission protocol message from a ground station to this aircraft."""
        self.route.hear(message, up=True, now=now)

    def told(self, said: Said, now: float) -> None:
        """Process one event of an onboard log."""
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
        """Count rows with implausible values."""
        self._refused += count
        self.say(f"{name} with a value that is not finite or out of range was rejected; check the sensor", now)

    def _read(self, severity: int, words: str, now: float) -> None:
        self.texts.append((now, severity, words))
        self.firmware = self.firmware or (words if heartbeat.names_firmware(words) else "")
        if severity <= SEVERE:
            self.say(words, now)

    def _jump(self, count: int, now: float) -> None:
        self._jumps = count
        self.route.stale = True  # the mission may differ after a restart
        self.say(f"the aircraft's clock jumped ({count} times so far), time was re-anchored", now)

    def _advance(self, step_s: float, now: float) -> None:
        self._advance_s += step_s
        self.say(
            f"telemetry times were {step_s:.1f} s behind arrival for 15 to 30 s and were re-anchored; "
            "expected real time; check for a slow or paused simulator",
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
            return f"uav-{self.uav}: no message for {silent_s:.0f} s; check the radio link"
        return self._sentence if now - self._said < REMEMBER_S else ""
