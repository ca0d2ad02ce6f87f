"""Cases, and their flights with and without the proposed change: aircraft simulated by JSBSim, offline twins.

The change is made in the simulated autopilot, as after an upload: new items and current item, a speed, or a mode.
"""

import copy
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleet.autopilots import laws
from fleet.contract import Alert, AlertKey, AlertKind, Change, Message, Mission, Option, Proposal
from fleet.frames import to_geodetic, to_ned
from fleet.mission import P_D, SEQ, SPEED
from fleet.simulator.flight.drive import EPOCH_US, to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.missions import HOME
from fleet.telemetry.recording.recordings import replay_messages
from tests.bench.alerts.world import Flight, Told, apart, arrange, fly, make
from twin_worker.alerts.traffic import TrafficMonitor
from twin_worker.proposals.candidates import MODES
from twin_worker.proposals.proposer import PROPOSED, Proposer
from twin_worker.twin.state.budget import Schedule
from twin_worker.twin.state.state import Twin
from twin_worker.twin.step import advance

APPROVED_S = (3.0, 18.0)  # from a proposal to the change on board, drawn: reading, approving, uploading [s]
UPLOAD_S = 1.0  # from the change on board to the new mission at the twin [s]
END_S = 200.0  # end of a flight with a change [s]
HEARD_S = 152.0  # end of a flight without one [s]
WIDE_M, HIGH_M, SAFE_M = 50.0, 20.0, 30.0  # separation, and least height above home
KINDS = ("pair", "triple", "ground", "geofence", "clear", "leg")
STEEP_S, STEEP_M, MISSED_M = 120.0, 220.0, 30.0  # when and how far a leg climbs; height by which it misses its end
SCHEDULE = Schedule(identify=5.0)
T_0 = EPOCH_US * 1e-6


@dataclass
class Case:
    """One arranged case: its flights, and the alert that is expected; None: none."""

    name: str
    flights: list[Flight]
    kind: AlertKind | None

    def make(self) -> list[SimulatedUav]:
        fenced = self.name == "geofence"
        return [make(one.told, one.plan, one.radius if fenced else 0.0) for one in self.flights]


@dataclass
class Outcome:
    """What came of one case."""

    name: str
    seed: int
    alert_s: float | None = None  # since the start
    offered_s: float | None = None  # the first options, since the start
    event_s: float | None = None  # predicted, since the start
    offered: int = 0
    took_s: float | None = None  # to compute the options, this thread's CPU
    sentences: list[str] = field(default_factory=list)
    without_event: list[bool] = field(default_factory=list)  # of each option: the event did not happen
    cleared: bool | None = None  # by the twins, with the first option
    new_alerts: list[str] = field(default_factory=list)  # raised after the change, with the first option
    unneeded: int = 0  # proposals with options where nothing happens

    @property
    def waited_s(self) -> float:
        """Return the time from the alert to the options: of the flight, and of computing [s]; inf: none."""
        if self.alert_s is None or self.offered_s is None or self.took_s is None:
            return float("inf")
        return max(self.offered_s - self.alert_s, 0.0) + self.took_s


def arranged(name: str, seed: int) -> Case:
    """Arrange one case."""
    limits = {"ground": AlertKind.GROUND, "geofence": AlertKind.GEOFENCE, "leg": AlertKind.NOT_ACHIEVABLE}
    rng = np.random.default_rng((seed, KINDS.index(name)))
    told = partial(Told, seed=seed, may_leave=name == "geofence")
    first = arrange(told(uav=0, meets=None, sinks=name == "ground"), rng, None)
    flights, kind = [steepened(first) if name == "leg" else first], limits.get(name)
    for uav in range(1, {"pair": 2, "triple": 3, "clear": 2}.get(name, 1)):
        flights.append(arrange(told(uav=uav, meets=name != "clear", sinks=False), rng, first.path))
        kind = None if name == "clear" else AlertKind.CONFLICT
    return Case(name, flights, kind)


def steepened(flight: Flight) -> Flight:
    """Raise the waypoint that is flown to at STEEP_S beyond what the aircraft can climb, and fly the mission."""
    seq = int(flight.seq[int(STEEP_S / 0.5)])
    items = tuple(
        msgspec.structs.replace(item, alt_m=item.alt_m + STEEP_M) if item.seq == seq else item
        for item in flight.plan.items
    )
    return fly(flight.told, flight.plan._replace(items=items), END_S)


class Changed:
    """A simulated aircraft whose plan changes at one instant."""

    def __init__(self, uav: SimulatedUav, change: Change | None, at_s: float) -> None:
        self.uav, self.change, self.at_s = uav, change, at_s
        self.path: list[np.ndarray] = []
        self.missed: list[tuple[int, float]] = []  # item that is flown to, and height above its end [m]

    @property
    def uav_id(self) -> int:
        return self.uav.uav_id

    @property
    def tick(self) -> int:
        return self.uav.tick

    def receive(self, data: bytes) -> list[bytes]:
        return self.uav.receive(data)

    def initial_frames(self) -> list[bytes]:
        return self.uav.initial_frames()

    def step(self, t: float) -> list[bytes]:
        if self.change is not None and t >= self.at_s:
            apply(self.uav, self.change)
            self.change = None
        frames = self.uav.step(t)
        if self.uav.tick % 50 == 0:
            p, leg = self.uav.aircraft.truth().p.copy(), self.uav.leg
            self.path.append(p)
            self.missed.append((int(leg[SEQ]), float(leg[P_D] - p[2])))
        return frames


def apply(uav: SimulatedUav, change: Change) -> None:
    """Change the plan on board."""
    if change.mode:
        uav.mode.command(MODES[change.mode])
        uav._enter_mode()
        return
    if change.items is not None:
        uav.items = change.items
    if change.seq is not None:
        uav._mission_seq = change.seq
    if change.speed is not None:
        uav.params = {**uav.params, "AIRSPEED_CRUISE": change.speed}
        uav.items = tuple(
            msgspec.structs.replace(item, param2=change.speed)
            if item.command == SPEED and item.seq < uav._mission_seq
            else item
            for item in uav.items
        )
        par, _ = laws.parameters(uav._law, uav.params, uav.origin.alt_mm * 1e-3 - uav.estimate.p[2])
        uav._par = laws.with_wind(par, *uav._wind_estimate)
    uav._enter_mode()


@dataclass
class Twins:
    """Offline twins with their alerts and proposals."""

    twins: dict[int, Twin] = field(default_factory=dict)
    traffic: TrafficMonitor = field(default_factory=TrafficMonitor)
    received: int = 0

    def __post_init__(self) -> None:
        self.active: dict[tuple[int, AlertKey], Alert] = {}
        self.proposer = Proposer(self.traffic.separation, self.copy_of, self.traffic.picture.forecasts)

    def copy_of(self, uav: int) -> Twin | None:
        twin = self.twins.get(uav)
        return copy.deepcopy(twin)

    def hear(self, message: Message) -> list[Alert]:
        """Let the twin of an aircraft hear a message; return the alerts that follow."""
        self.received += 1
        twin = self.twins.setdefault(message.uav, Twin.of(message.uav, schedule=SCHEDULE))
        results = self.traffic.process_results(message.uav, twin.telemetry.last_step_t, advance(twin, (message,)))
        alerts = [one for one in results if isinstance(one, Alert) and one.kind in PROPOSED]
        for alert in alerts:
            if alert.active:
                self.active[alert.uav, alert.about] = alert
            else:
                self.active.pop((alert.uav, alert.about), None)
        return alerts


def recording(case: Case, seconds: float, seed: int, changes: tuple[Change, ...] = (), at_s: float = 0.0):
    """Fly a case into a recording, with changes from one instant on; give it, the true paths, and missed heights."""
    by_uav = {change.uav: change for change in changes}
    uavs = [Changed(uav, by_uav.get(uav.uav_id), at_s) for uav in case.make()]
    folder = tempfile.TemporaryDirectory()
    path = Path(folder.name) / "case.tlog"
    to_tlog(path, uavs, seconds=seconds, loss=0.02, seed=seed)
    paths = [
        to_ned(HOME, *to_geodetic(one.plan.origin, np.array(uav.path)).T)
        for one, uav in zip(case.flights, uavs, strict=True)
    ]
    return folder, path, (paths, uavs[0].missed)


def judged(name: str, seed: int, say: Any = print) -> Outcome:
    """Arrange a case, let the twins hear it, and fly what they propose."""
    case, out = arranged(name, seed), Outcome(name, seed)
    twins = Twins()
    folder, path, _ = recording(case, HEARD_S, seed)
    with folder:
        alert, proposal = _until_offered(case, twins, path, out)
    if alert is None or proposal is None:
        return out
    out.event_s, out.offered_s = (alert.predicted_t or alert.t) - T_0, proposal.t - T_0
    out.offered, out.sentences = len(proposal.options), [one.sentence for one in proposal.options]
    say(f"{name} {seed}: alert at {out.alert_s:.0f} s; {'; '.join(out.sentences) or proposal.sentence}")
    for number, option in enumerate(proposal.options):
        _fly_option(case, seed, (out, twins if number == 0 else None), (alert, option), proposal.t)
    return out


def _until_offered(case: Case, twins: Twins, path: Path, out: Outcome) -> tuple[Alert | None, Proposal | None]:
    """Let the twins hear a recording until options against the expected alert are offered; give alert and proposal."""
    for message in replay_messages(path, -1):
        for alert in twins.hear(message):
            if alert.active and alert.kind is case.kind and out.alert_s is None:
                out.alert_s = alert.t - T_0
        now = twins.twins[message.uav].telemetry.last_step_t
        for alert in [one for one in twins.active.values() if twins.proposer.due(one, now)]:
            began = time.thread_time()
            proposal = twins.proposer.update(alert, twins.twins[alert.uav].telemetry.last_step_t)
            if proposal is None or not proposal.options:
                continue
            if alert.kind is case.kind:
                out.took_s = time.thread_time() - began
                return alert, proposal
            out.unneeded += 1
    return None, None


def _fly_option(
    case: Case, seed: int, simulated: tuple[Outcome, Twins | None], chosen: tuple[Alert, Option], offered_t: float
) -> None:
    """Fly an option, approved after a drawn time; let the twins hear it from the proposal on."""
    (out, twins), (alert, option) = simulated, chosen
    at_s = offered_t - T_0 + float(np.random.default_rng((seed, 78)).uniform(*APPROVED_S))
    folder, path, flown = recording(case, END_S, seed, option.changes, at_s)
    with folder:
        out.without_event.append(not happens(case, flown, int(at_s / 0.5)))
        if twins is None:
            return
        out.cleared = False
        for message in _after(replay_messages(path, -1), twins, option.changes, T_0 + at_s + UPLOAD_S):
            for raised in twins.hear(message):
                if raised.about == alert.about and raised.uav == alert.uav:
                    out.cleared = not raised.active
                elif raised.active and raised.t > T_0 + at_s:
                    out.new_alerts.append(raised.sentence)


def _after(messages: Iterator[Message], twins: Twins, changes: tuple[Change, ...], at: float) -> Iterator[Message]:
    """Return the messages that the twins have not received, and the uploaded missions at their time."""
    uploads = {change.uav: change for change in changes if change.items is not None}
    waiting = set(uploads)
    for k, message in enumerate(messages):
        if k < twins.received:
            continue
        change = uploads.get(message.uav)
        if change is not None and change.items is not None and message.t > at:
            if message.uav in waiting:
                waiting.discard(message.uav)
                yield Mission(uav=message.uav, t=message.t, items=change.items, seq=change.seq or 0, complete=True)
                twins.received -= 1
            if isinstance(message, Mission):  # the recording repeats the items at its start
                message = msgspec.structs.replace(message, items=change.items)
        yield message


def happens(case: Case, flown: tuple[list[np.ndarray], list[tuple[int, float]]], since: int) -> bool:
    """Tell whether the event happens from a row on: of the whole case, any loss of separation counts."""
    paths, missed = flown
    for one, other in combinations(paths, 2):
        wide, high = apart(one, other)
        if ((wide < WIDE_M) & (high < HIGH_M))[since:].any():
            return True
    home, path = case.flights[0].home, paths[0][since:]
    if case.kind is AlertKind.GROUND:
        return bool((home[2] - path[:, 2] < SAFE_M).any())
    if case.kind is AlertKind.NOT_ACHIEVABLE:
        ends = [k for k in range(since + 4, len(missed)) if missed[k][0] != missed[k - 1][0]]
        return any(abs(missed[k - 1][1]) > MISSED_M for k in ends)
    return case.kind is AlertKind.GEOFENCE and bool((np.hypot(*(path - home)[:, :2].T) > case.flights[0].radius).any())
