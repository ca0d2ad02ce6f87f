"""Cases, and their flights with the proposed changes: aircraft simulated by JSBSim, whose twins hear them meanwhile.

A change is made in the simulated autopilot, as after an upload: new items and current item, a speed, or a mode.
"""

import copy
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations

import msgspec
import numpy as np

from fleet.autopilots import laws
from fleet.bus.codec import digest_of
from fleet.contract import (
    Alert,
    AlertKey,
    AlertKind,
    Change,
    Execution,
    ExecutionState,
    Item,
    Message,
    Mission,
    Proposal,
)
from fleet.frames import to_geodetic, to_ned
from fleet.mission import P_D, SEQ, SPEED
from fleet.simulator.flight.drive import EPOCH_US, RadioLink
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.missions import HOME
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from tests.bench.alerts.world import Flight, Told, apart, arrange, fly, make
from tests.bench.proposals.surroundings import NOTHING_AROUND, Surroundings, hill, no_fly_area
from twin_worker.alerts.traffic import TrafficMonitor
from twin_worker.proposals.candidates import MODES
from twin_worker.proposals.proposer import PROPOSED, Proposer
from twin_worker.twin.state.budget import Schedule
from twin_worker.twin.state.state import Twin
from twin_worker.twin.step import advance

APPROVED_S = (2.0, 16.0)  # from the first proposal to the approval of its newest version, drawn [s]
UPLOAD_S = 2.0  # from the approval to the change on board [s]
READ_BACK_S = 1.0  # from the change on board to the new mission at the twin [s]
END_S = 200.0  # end of a flight [s]
DECIDED_S = 150.0  # proposals are approved until then: an event has happened, or will not [s]
WIDE_M, HIGH_M, SAFE_M = 50.0, 20.0, 30.0  # separation, and least height above home
KINDS = ("pair", "triple", "ground", "geofence", "clear", "leg", "terrain", "area")
STEEP_S, STEEP_M, MISSED_M = 120.0, 220.0, 30.0  # when and how far a leg climbs; height by which it misses its end
MAX_APPROVED = 3  # proposals that are approved in one flight
AGAIN_S = 30.0  # after an approval, another one against the same event, where its alert is active still or again [s]
LOSS = 0.02  # of telemetry [-]
SCHEDULE = Schedule(identify=5.0)
T_0 = EPOCH_US * 1e-6
_STEP_S, _ROW_S = 0.25, 0.5  # of a flight, of its stored path [s]
Key = tuple[int, AlertKey]


@dataclass
class Case:
    """One arranged case: its flights, and the alert that is expected; None: none."""

    name: str
    flights: list[Flight]
    kind: AlertKind | None
    around: Surroundings = NOTHING_AROUND

    def make(self) -> list[SimulatedUav]:
        fenced = self.name == "geofence"
        return [make(one.told, one.plan, one.radius if fenced else 0.0) for one in self.flights]

    def happens_unchanged(self, uav: int, about: AlertKey) -> bool:
        """Tell whether an event happens without changes, at any time of the arranged flights."""
        kind, other = about
        one = self.flights[uav]
        if kind is AlertKind.CONFLICT:
            wide, high = apart(one.path, self.flights[other].path)
            return bool(((wide < WIDE_M) & (high < HIGH_M)).any())
        if kind is AlertKind.GROUND:
            return bool((self.around.clearance(one.path, one.home) < SAFE_M).any())
        if kind is AlertKind.GEOFENCE:
            return (self.name == "geofence" and one.leaves()) or self.around.enters(one.path)
        return self.name == "leg"


@dataclass
class Approval:
    """A proposal whose first option was approved."""

    uav: int
    about: AlertKey
    alert_s: float  # since the start
    offered_s: float  # the first options, since the start
    took_s: float  # to compute them, CPU of this thread
    event_s: float  # predicted, since the start
    approved_s: float  # since the start
    sentences: list[str]  # of the options offered first
    with_models: bool  # of all aircraft of the case, then
    reasons: list[str] = field(default_factory=list)  # why none was offered before
    flown: str = ""  # the option that was approved; empty: it was withdrawn before
    cleared: bool = False  # the alert, by the twins

    @property
    def waited_s(self) -> float:
        """Return the time from the alert to the options: of the flight, and of computing [s]."""
        return max(self.offered_s - self.alert_s, 0.0) + self.took_s


@dataclass
class Result:
    """What came of one case."""

    name: str
    seed: int
    alert_s: float | None = None  # the first of the expected kind, since the start
    approvals: list[Approval] = field(default_factory=list)
    happened: bool = False  # the event, or a loss of separation, after the first change
    created: list[str] = field(default_factory=list)  # alerts after it, of what does not happen without changes
    unneeded: list[str] = field(default_factory=list)  # proposals against what does not happen without changes
    reasons: list[str] = field(default_factory=list)  # why none was offered

    @property
    def first(self) -> Approval | None:
        """Return the first approval of a change that was flown."""
        return next((one for one in self.approvals if one.flown), None)


def arranged(name: str, seed: int) -> Case:
    """Arrange one case."""
    limits = {
        "ground": AlertKind.GROUND,
        "terrain": AlertKind.GROUND,
        "geofence": AlertKind.GEOFENCE,
        "area": AlertKind.GEOFENCE,
        "leg": AlertKind.NOT_ACHIEVABLE,
    }
    rng = np.random.default_rng((seed, KINDS.index(name)))
    told = partial(Told, seed=seed, may_leave=name == "geofence")
    first = arrange(told(uav=0, meets=None, sinks=name == "ground"), rng, None)
    flights, kind = [steepened(first) if name == "leg" else first], limits.get(name)
    for uav in range(1, {"pair": 2, "triple": 3, "clear": 2}.get(name, 1)):
        flights.append(arrange(told(uav=uav, meets=name != "clear", sinks=False), rng, first.path))
        kind = None if name == "clear" else AlertKind.CONFLICT
    around = NOTHING_AROUND
    if name == "terrain":
        around = hill(first.path, first.height(), _ROW_S)
    elif name == "area":
        around = no_fly_area(first.path, _ROW_S)
    return Case(name, flights, kind, around)


def steepened(flight: Flight) -> Flight:
    """Raise the waypoint that is flown to at STEEP_S beyond what the aircraft can climb, and fly the mission."""
    seq = int(flight.seq[int(STEEP_S / 0.5)])
    items = tuple(
        msgspec.structs.replace(item, alt_m=item.alt_m + STEEP_M) if item.seq == seq else item
        for item in flight.plan.items
    )
    return fly(flight.told, flight.plan._replace(items=items), END_S)


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

    around: Surroundings = NOTHING_AROUND
    twins: dict[int, Twin] = field(default_factory=dict)
    traffic: TrafficMonitor = field(default_factory=TrafficMonitor)

    def __post_init__(self) -> None:
        self.active: dict[Key, Alert] = {}
        self.proposer = Proposer(self.traffic.separation, self.copy_of, self.traffic.picture.forecasts)

    def copy_of(self, uav: int) -> Twin | None:
        return copy.deepcopy(self.twins.get(uav))

    def has_model(self, uav: int) -> bool:
        return self.twins[uav].models.has_model

    def hear(self, message: Message) -> list[Alert]:
        """Let the twin of an aircraft hear a message; return the alerts that follow."""
        if message.uav not in self.twins:
            self.twins[message.uav] = Twin.of(message.uav, schedule=SCHEDULE)
            self.twins[message.uav].terrain, self.twins[message.uav].areas = self.around
        twin = self.twins[message.uav]
        results = self.traffic.process_results(message.uav, twin.telemetry.last_step_t, advance(twin, (message,)))
        alerts = [one for one in results if isinstance(one, Alert) and one.kind in PROPOSED]
        for alert in alerts:
            if alert.active:
                self.active[alert.uav, alert.about] = alert
            else:
                self.active.pop((alert.uav, alert.about), None)
        return alerts


class Scene:
    """One case in the air: aircraft, their radio links, their twins, and a person who approves."""

    def __init__(self, case: Case, seed: int) -> None:
        self.case, self.twins, self.result = case, Twins(case.around), Result(case.name, seed)
        self._uavs = {uav.uav_id: uav for uav in case.make()}
        self._links = {uav: RadioLink(np.random.default_rng((seed, 6, uav)), LOSS) for uav in self._uavs}
        self._receiver = MavlinkReceiver(-1)
        self._approved_rng = np.random.default_rng((seed, 78))
        self._paths: dict[int, list[np.ndarray]] = {uav: [] for uav in self._uavs}
        self._missed: list[tuple[int, float]] = []  # item that is flown to, and height above its end [m]
        self._alert_s: dict[Key, float] = {}  # the first alert of each event [s]
        self._reasons: dict[Key, list[str]] = {}
        self._pending: list[tuple[float, Change]] = []  # changes, and when they are on board [s]
        self._uploads: list[tuple[float, Change]] = []  # missions, and when they are received [s]
        self._items: dict[int, tuple[Item, ...]] = {}  # of changed missions that were read back

    def fly(self) -> Result:
        """Fly to the end."""
        for uav_id, uav in self._uavs.items():
            for frame in uav.initial_frames():
                self._receiver.receive(T_0, frame, uav_id)
        for k in range(1, int(END_S / _STEP_S) + 1):
            self._step(k * _STEP_S, is_row=k % round(_ROW_S / _STEP_S) == 0)
        result = self.result
        for approval in result.approvals:
            approval.cleared = (approval.uav, approval.about) not in self.twins.active
        if result.first is not None:
            result.happened = self._happens(int((result.first.approved_s + UPLOAD_S) / _ROW_S))
        else:
            result.reasons = [text for texts in self._reasons.values() for text in texts][:5]
        return result

    def _step(self, t: float, is_row: bool) -> None:
        self._change_plans(t)
        for uav_id, uav in self._uavs.items():
            self._links[uav_id].send(t, uav.step(t))
            for arrival, frame in self._links[uav_id].receive(t):
                self._receiver.receive(T_0 + arrival, frame, uav_id)
            if is_row:
                self._paths[uav_id].append(uav.aircraft.truth().p.copy())
        if is_row:
            first = self._uavs[0]
            self._missed.append((int(first.leg[SEQ]), float(first.leg[P_D] - self._paths[0][-1][2])))
        for message in (*self._read_back(t), *self._receiver.flush(T_0 + t)):
            if isinstance(message, Mission) and message.uav in self._items:
                message = msgspec.structs.replace(message, items=self._items[message.uav])
            for alert in self.twins.hear(message):
                self._on_alert(alert, t)
        if t <= DECIDED_S:
            self._propose(t)

    def _change_plans(self, t: float) -> None:
        """Approve what is due, and make the changes that are on board by now."""
        for approval in self.result.approvals:
            if not approval.flown and approval.approved_s <= t < approval.approved_s + _STEP_S:
                self._approve(approval)
        for at, change in [one for one in self._pending if one[0] <= t]:
            apply(self._uavs[change.uav], change)
            self._pending.remove((at, change))

    def _read_back(self, t: float) -> Iterable[Mission]:
        """Return the missions that were uploaded and read back."""
        for at, change in [one for one in self._uploads if one[0] <= t]:
            self._uploads.remove((at, change))
            if change.items is not None:
                self._items[change.uav] = change.items
                yield Mission(uav=change.uav, t=T_0 + t, items=change.items, seq=change.seq or 0, complete=True)

    def _on_alert(self, alert: Alert, t: float) -> None:
        if not alert.active:
            self._alert_s.pop((alert.uav, alert.about), None)
            return
        key = alert.uav, alert.about
        self._alert_s.setdefault(key, t)
        if alert.kind is self.case.kind and self.result.alert_s is None:
            self.result.alert_s = t
        first = self.result.first
        if first is not None and t > first.approved_s and not self.case.happens_unchanged(*key):
            self.result.created.append(f"{t:.0f} s: {alert.sentence}")

    def _propose(self, t: float) -> None:
        proposer, approvals = self.twins.proposer, self.result.approvals
        due = [one for one in self.twins.active.values() if proposer.due(one, self._now(one.uav))]
        for alert in sorted(due, key=proposer.computed_t):
            key, began = (alert.uav, alert.about), time.thread_time()
            proposal = proposer.update(alert, self._now(alert.uav))
            took_s = time.thread_time() - began
            if proposal is None or not proposal.options:
                reasons = self._reasons.setdefault(key, [])
                if proposal is not None and len(reasons) < 5:
                    reasons.append(f"{t:.1f} s: {proposal.sentence}")
            elif not self.case.happens_unchanged(*key):
                self.result.unneeded.append(f"{t:.0f} s: {proposal.sentence}")
            elif len(approvals) < MAX_APPROVED and all(
                (one.uav, one.about) != key or t > one.approved_s + AGAIN_S for one in approvals
            ):
                approvals.append(self._noticed(alert, proposal, t, took_s))

    def _now(self, uav: int) -> float:
        return self.twins.twins[uav].telemetry.last_step_t

    def _noticed(self, alert: Alert, proposal: Proposal, t: float, took_s: float) -> Approval:
        """Return the approval of a proposal that is offered for the first time; it follows after a drawn time."""
        key = alert.uav, alert.about
        return Approval(
            uav=alert.uav,
            about=alert.about,
            alert_s=self._alert_s[key],
            offered_s=t,
            took_s=took_s,
            event_s=(alert.predicted_t or alert.t) - T_0,
            approved_s=t + float(self._approved_rng.uniform(*APPROVED_S)),
            sentences=[one.sentence for one in proposal.options],
            with_models=all(self.twins.has_model(uav) for uav in self._uavs),
            reasons=self._reasons.pop(key, []),
        )

    def _approve(self, approval: Approval) -> None:
        """Approve the first option of the newest version; the change is on board soon, on all its aircraft at once."""
        current = self.twins.proposer.current(approval.uav)
        proposal = next((one for one in current if one.options and (one.kind, one.other) == approval.about), None)
        if proposal is None:
            return
        option, at_s = proposal.options[0], approval.approved_s + UPLOAD_S
        approval.flown = option.sentence
        for change in option.changes:
            self._pending.append((at_s, change))
            self._uploads.append((at_s + READ_BACK_S, change))
        execution = Execution(
            uav=approval.uav,
            t=proposal.t,
            proposal=proposal.id,
            digest=digest_of(option),
            state=ExecutionState.ACCEPTED,
        )
        self.twins.proposer.on_execution(execution, self._now(approval.uav))

    def _happens(self, since: int) -> bool:
        """Tell whether the event happens from a row on; any loss of separation counts."""
        flights = self.case.flights
        paths = [
            to_ned(HOME, *to_geodetic(one.plan.origin, np.array(self._paths[uav])).T) for uav, one in enumerate(flights)
        ]
        for one, other in combinations(paths, 2):
            wide, high = apart(one, other)
            if ((wide < WIDE_M) & (high < HIGH_M))[since:].any():
                return True
        home, path = flights[0].home, paths[0][since:]
        if self.case.kind is AlertKind.GROUND:
            return bool((self.case.around.clearance(path, home) < SAFE_M).any())
        if self.case.kind is AlertKind.NOT_ACHIEVABLE:
            ends = [k for k in range(since + 4, len(self._missed)) if self._missed[k][0] != self._missed[k - 1][0]]
            return any(abs(self._missed[k - 1][1]) > MISSED_M for k in ends)
        if self.case.name == "area":
            return self.case.around.enters(path)
        is_outside = np.hypot(*(path - home)[:, :2].T) > flights[0].radius
        return self.case.kind is AlertKind.GEOFENCE and bool(is_outside.any())


def judged(name: str, seed: int) -> Result:
    """Arrange a case and fly it with the options that are proposed."""
    return Scene(arranged(name, seed), seed).fly()
