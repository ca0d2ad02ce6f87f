"""State of one twin: telemetry, active model, past predictions; and the ingestion of messages."""

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from fleet.airframes import GENERIC, Airframe, load
from fleet.airframes.airframe import ServoMap, servo_map
from fleet.contract import Event, Message, Mission, Model, Outcome, Params, Prediction, Sample, State, Status, Verdict
from fleet.frames import Origin
from fleet.mission import FIRST
from fleet.window import Window
from twin_worker.alerts.hysteresis import Ledger
from twin_worker.confidence.tube_and_horizon import Record
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.identification.fixed_wing.point_mass_model import Hybrid
from twin_worker.prediction.autopilot_identification import OWN, Learnt
from twin_worker.prediction.autopilot_parameters import Control
from twin_worker.prediction.closed_loop import Onboard, Situation
from twin_worker.prediction.kinematic import Grey
from twin_worker.prediction.method_selection import Contest
from twin_worker.prediction.multirotor.rollout import Rotor
from twin_worker.prediction.route_override import Instead
from twin_worker.telemetry.arrival_delay import Delay
from twin_worker.telemetry.history import History
from twin_worker.telemetry.resample import Grid
from twin_worker.twin.state.budget import Quota
from twin_worker.twin.state.checkpoint import MOST, Extension, Mark
from twin_worker.twin.state.events import Note, void
from twin_worker.twin.state.flight_phase import Ground
from twin_worker.twin.state.message_changes import changed, mission_said, parameters_said
from twin_worker.twin.state.schedule import Pace, Work
from twin_worker.validation.forecast_shrinkage import Earned
from twin_worker.validation.verify import OMEGA

AUTO = "auto"  # use the prediction method with the lowest error
ROUTE_MODES = ("AUTO", "MISSION", "AUTO.MISSION")


def _unheard() -> Verdict:
    return Verdict(outcome=Outcome.STARVED, sentence="no samples yet")


_MODES = 64  # number of mode changes kept
_NEWS = 0.3  # weight of the newest error in a model's mean closed-loop error [-]


@dataclass
class Believed:
    """A verified model and its closed-loop error on the newest held-out data.

    Attributes:
        plant: the model
        verdict: its verification result
        t: end of the data of the verification [s since 1970]
        closed_loop_error: smoothed mean position error on the route [m]; nan before any route, inf outside the envelope
    """

    plant: Plant
    verdict: Verdict
    t: float
    miss: float

    def flown(self, miss: float) -> None:
        """Update the smoothed error with one more closed-loop run; nan (no route) changes nothing."""
        if not np.isnan(miss):
            self.miss = miss if np.isnan(self.miss) else (1 - _NEWS) * self.miss + _NEWS * miss

    def rank(self) -> tuple[bool, float]:
        """Return the sort key: lowest error first; models without a route run last, newest first."""
        return (True, -self.t) if np.isnan(self.miss) else (False, self.miss)


@dataclass
class Twin:
    """Digital twin of one aircraft: telemetry, active model, and errors of past predictions."""

    uav: int
    omega: float = OMEGA
    method: str = AUTO
    airframe: Airframe = field(default_factory=lambda: load(GENERIC))
    history: History = field(default_factory=History)
    grid: Grid = field(default_factory=Grid)
    wind: WindFilter = field(default_factory=WindFilter)
    record: Record = field(default_factory=Record)
    ledger: Ledger = field(default_factory=Ledger)
    rotor: Rotor = field(default_factory=Rotor)
    grey: Grey = field(default_factory=Grey)
    modes: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=_MODES))  # mode changes, (time, name)
    origin: Origin | None = None
    status: Status | None = None
    mission: Mission | None = None
    params: Params | None = None
    servos: ServoMap = field(default_factory=lambda: servo_map({}))
    learnt: Learnt = field(default_factory=Learnt)  # controller parameters identified from flight
    instead: Instead | None = None  # route override for a what-if; only on copies
    plant: Plant | None = None  # active model
    near: Coupled | None = None  # newest derivatives model, verified or not: initial value of the next estimation
    last: Coupled | None = None  # newest verified derivatives model: prior of the next estimation
    hybrid: Hybrid | None = None  # active point-mass model
    near_hybrid: Hybrid | None = None  # newest point-mass model, active or not
    strays: float = float("nan")  # point-mass error at the end of a 20 s hold-out, over path length [-]
    contest: Contest = field(default_factory=Contest)
    spread: np.ndarray | None = None  # spread of the newest ensemble: along, cross, vertical, (k, 3) [m]
    earned: Earned = field(default_factory=Earned)
    marks: deque[Mark] = field(default_factory=lambda: deque(maxlen=MOST))  # of the last minutes
    extended: Extension | None = None  # diagnosed effects added to the active models
    learn_from: float = -np.inf  # start of the data used for identification [s since 1970]
    verdict: Verdict = field(default_factory=_unheard)
    pool: list[Believed] = field(default_factory=list)
    in_force: Verdict | None = None  # verdict of the active model
    model: Model | None = None
    prediction: Prediction | None = None
    base: Prediction | None = None  # newest rollout
    pace: Pace = field(default_factory=Pace)
    quota: Quota | None = None  # set by the driver; None: unlimited
    control: Control | None = None  # controller model of the newest prediction
    control_t: float = -np.inf  # and when that was last told
    state: State = State.WAITING
    tries: int = 0
    ground: Ground = field(default_factory=Ground)
    noted: Note | None = None  # the newest event
    since: float = -np.inf  # last change of mode, mission or parameters
    data_t: float = -np.inf  # newest time in any message, on the time axis of telemetry
    delay: Delay = field(default_factory=Delay)  # of telemetry behind the gateway's clock
    turned_t: float = -np.inf  # data time of the last turn of the loop
    wind_t: float = -np.inf
    identify_t: float = -np.inf
    afresh_t: float = -np.inf  # last identification without a warm start
    predict_t: float = -np.inf
    renew_t: float = -np.inf
    score_t: float = -np.inf
    flown_t: float = -np.inf  # last closed-loop run of the models
    told_t: float = -np.inf  # last published model
    hybrid_t: float = -np.inf  # last point-mass identification
    checked_t: float = -np.inf  # last hold-out check of the point-mass model
    spread_t: float = -np.inf  # last ensemble
    put_off: float | None = None  # due time of a deferred ensemble [s since 1970]
    achievable_t: float = -np.inf  # last feasibility check of the mission
    turning_t: float = np.inf  # start of the predictions by turn rate alone
    stood: Origin | None = None  # last position at rest and disarmed
    peak: float = -np.inf  # maximum height above home since disarmed [m]
    lost: bool = False  # link lost
    back_t: float = -np.inf  # last link recovery
    broken: bool = False  # telemetry without positions
    over: bool = False  # coasting has exceeded the confidence horizon
    bad: int = 0

    def may(self, work: Work) -> bool:
        """Return whether the compute budget allows due heavy work now."""
        return self.quota is None or self.quota.grants(work)

    @property
    def name(self) -> str:
        """Return the name used in texts, e.g. uav-7."""
        return f"uav-{self.uav}"

    @property
    def standing(self) -> str:
        """Return the verdict of the active model, and the outcome of the newest identification if it differs."""
        if self.in_force is None or self.verdict.outcome is Outcome.VERIFIED:
            return self.verdict.sentence
        return f"{self.in_force.sentence}; newest identification: {self.verdict.outcome.value.replace('_', ' ')}"

    @property
    def first_item(self) -> int:
        """Return the sequence number of the first mission item to fly: 0 if item 0 is not home."""
        return FIRST.get(self.autopilot, 1)

    @property
    def autopilot(self) -> str:
        """Return the autopilot type from the heartbeat, e.g. px4."""
        return self.status.autopilot if self.status else "unknown"

    @property
    def received(self) -> dict[str, float]:
        """Return the received autopilot parameters, in the autopilot's names and units."""
        return self.params.values if self.params else {}

    @property
    def vehicle(self) -> str:
        """Return the vehicle type from the heartbeat, e.g. fixed_wing."""
        return self.status.vehicle if self.status else "unknown"

    def window(self, seconds: float) -> Window | None:
        """Return the newest `seconds`, equally sampled; None if a required kind of row is missing."""
        assert self.origin is not None
        newest = self.history.newest
        return self.grid.window(self.history, self.origin, self.servos, self.wind.wind, until=newest, seconds=seconds)

    def situation(self, window: Window) -> Situation:
        """Return the initial data of a prediction from the end of `window`."""
        assert self.origin is not None
        items = self.mission.items if self.mission else ()
        law = OWN.get(self.autopilot, self.learnt.law)
        onboard = Onboard(
            items, self.received, self.since, self.learnt.values, self.instead, self.autopilot, law, self.learnt.said
        )
        return Situation(window, self.history, onboard, self.wind, self.origin)

    def why_no_route(self) -> str:
        """Return why the aircraft follows no mission; empty if it does."""
        mode = self.status.mode if self.status else ""
        if mode not in ROUTE_MODES:
            return f"mode {mode or 'unknown'} follows no mission"
        if self.mission is None or not self.mission.items:
            return "no mission on board"
        return ""


def hear(twin: Twin, message: Message) -> None:
    """Ingest one message from the gateway."""
    if isinstance(message, Sample):
        twin.bad += twin.history.add(message)
        if twin.origin is None and message.position is not None:
            twin.origin = _first_place(twin.history)
    elif isinstance(message, Status):
        _hear_status(twin, message)
    elif isinstance(message, Mission):
        if twin.mission is None or twin.mission.items != message.items:
            void(twin, Event.MISSION, message.t, mission_said(twin.mission, message))
        twin.mission = message
    elif isinstance(message, Params):
        names = changed(twin.received, message.values)
        if names or twin.params is None:
            said = parameters_said(names, twin.received, message.values)
            void(twin, Event.PARAMETERS if names else None, message.t, said)
        twin.params, twin.servos = message, servo_map(message.values)


def _first_place(history: History) -> Origin | None:
    """Return the first position within valid limits; None if there is none."""
    for lat, lon, alt in history.rows("position")[1]:
        if abs(lat) <= 9e8 and abs(lon) <= 1.8e9 and abs(alt) <= 1e8:
            return Origin(int(lat), int(lon), int(alt))
    return None


def _hear_status(twin: Twin, status: Status) -> None:
    before = twin.status
    twin.status = status
    if before is None or status.mode != before.mode:
        twin.modes.append((status.t, status.mode))
    if before is None:
        return
    if status.clock_jumps != before.clock_jumps:
        twin.history.clear()
        twin.grid.clear()
        twin.wind.t = twin.wind_t = twin.identify_t = twin.score_t = -np.inf  # the new time may be earlier
        twin.flown_t = twin.told_t = twin.back_t = twin.hybrid_t = twin.checked_t = -np.inf
        twin.near = twin.last = twin.extended = None
        twin.learn_from = -np.inf
        twin.marks.clear()
        twin.data_t = twin.turned_t = -np.inf
        twin.delay = Delay(twin.delay.gateway_t)
        twin.ground = Ground()
        void(twin, Event.CLOCK, status.t)
        return
    if 0 < (step := status.clock_advance_s - before.clock_advance_s) < np.inf:
        _advance_clock(twin, step)
    if status.mode != before.mode:
        void(twin, Event.MODE if before.mode else None, status.t, f"{status.mode[:20]}, previously {before.mode[:20]}")


def _advance_clock(twin: Twin, step: float) -> None:
    """Shift all stored times forward after the gateway re-anchored the telemetry clock."""
    newest = twin.history.newest
    if not np.isfinite(newest):
        return
    arrived = twin.delay.gateway_t - newest < 0.5 * step  # the first re-anchored sample came before the status
    twin.history.advance(newest - 0.5 * step if arrived else np.inf, step)
    twin.grid.clear()
    twin.wind.t, twin.wind_t = twin.wind.t + step, twin.wind_t + step
    twin.learn_from, twin.back_t = twin.learn_from + step, twin.back_t + step
    twin.modes = deque(((t + step, mode) for t, mode in twin.modes), maxlen=_MODES)
    twin.pool = [replace(one, t=one.t + step) for one in twin.pool]
    twin.marks.clear()
    since = twin.since + step
    void(twin, None, twin.history.newest)
    said = f"telemetry was {step:.1f} s behind its arrival and was re-anchored: earlier predictions are void"
    twin.since, twin.noted = since, Note(Event.CLOCK, twin.history.newest, said)
