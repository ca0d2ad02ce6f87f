"""Replay recordings through the twins as if live, with forecasts of every method at the same instants."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from fleet.contract import Message, Params, Prediction, Status
from twin_worker.confidence.tube_and_horizon import AHEAD
from twin_worker.evaluation.baselines.methods import BASELINES, Now
from twin_worker.evaluation.scoring.case import OURS, Asked, Case, Told
from twin_worker.evaluation.scoring.log import Log
from twin_worker.evaluation.scoring.truth import FIRST_S, WHOLE_S, answer
from twin_worker.identification.fixed_wing.plant import DYNAMICS, PAPER
from twin_worker.twin.state.state import AUTO, hear
from twin_worker.twin.state.vehicle_class import seen
from twin_worker.twin.step import Twin, advance, silence

STAND_IN = "imm"  # fallback of a method that cannot predict
_LOOK_BACK_S = 62.0  # telemetry available to the baselines [s]
_SAME_S = 0.01  # predictions whose starts differ by more are different [s]


@dataclass(frozen=True)
class Plan:
    """Settings of an evaluation.

    Attributes:
        every_s: interval between starts [s]
        method: method of the twin
        methods: names of the methods to compare with
        without_params: withhold the autopilot's parameters from every twin
    """

    every_s: float = 5.0
    method: str = AUTO
    methods: tuple[str, ...] = (*BASELINES, PAPER)
    without_params: bool = False


@dataclass
class Examined:
    """One aircraft under evaluation.

    Attributes:
        flight: name of the flight in every result
        twin: the twin, driven as live
        paper_twin: twin of the paper's method on the same telemetry, stepped at starts only; None without that method
        reference: the actual flight
        starts: starts so far
        slot: number of the present interval of `every_s`
        predicted: whether the twin predicted in this interval
        missed: intervals on a mission, late enough to count, without any prediction
    """

    flight: str
    twin: Twin
    paper: Twin | None
    log: Log = field(default_factory=Log)
    asked: list[Asked] = field(default_factory=list)
    slot: int = -1
    answered: bool = True
    silent: int = 0


@dataclass
class Drive:
    """Evaluation of the aircraft of one recording.

    Attributes:
        name: name of the recording
        plan: settings
        is_selected: whether to evaluate an aircraft, by its order of appearance
        uavs: aircraft by UAV id; None: not selected
    """

    name: str
    plan: Plan
    mine: Callable[[int], bool] = lambda _: True
    examined: dict[int, Examined | None] = field(default_factory=dict)

    def run(self, messages: Iterable[Message]) -> Iterator[Case]:
        """Replay messages through the twins in the order they were received; yield every resolved start."""
        for message in messages:
            one = self._whose(message.uav)
            if one is None:
                continue
            if _clock_jumps(one, message):
                yield from _answers(one)
                one.log, one.slot = Log(), -1
            one.log.hear(message)
            if not (self.plan.without_params and isinstance(message, Params)):
                _advance(one, message, self.plan)
        for one in self.examined.values():
            if one is not None:
                yield from _answers(one)

    @property
    def silent(self) -> int:
        """Return the number of intervals without any prediction."""
        return sum(one.silent for one in self.examined.values() if one is not None)

    def _whose(self, uav: int) -> Examined | None:
        if uav not in self.examined:
            paper = Twin(uav, method=PAPER) if PAPER in self.plan.methods else None
            one = Examined(f"{self.name}:uav-{uav}", Twin(uav, method=self.plan.method), paper)
            self.examined[uav] = one if self.mine(len(self.examined)) else None
        return self.examined[uav]


def _clock_jumps(one: Examined, message: Message) -> bool:
    before = one.twin.status
    if not isinstance(message, Status) or before is None:
        return False
    now, then = ((status.clock_jumps, status.clock_advance_s) for status in (message, before))
    return now != then


def _answers(one: Examined) -> Iterator[Case]:
    """Yield every start so far, compared with the actual flight."""
    yield from (answer(one.log, asked) for asked in one.asked)
    one.asked.clear()


def _advance(one: Examined, message: Message, plan: Plan) -> None:
    """Advance the twin by one message and record its predictions, with no later data available to any method."""
    for at in silence(one.twin, message):
        _ask(one, advance(one.twin, (), at), plan)
    if one.paper is not None:
        hear(one.paper, message)
    _ask(one, advance(one.twin, (message,)), plan)


def _ask(one: Examined, results: Iterable[Message], plan: Plan) -> None:
    """Record a start at the first prediction of every interval of `every_s`."""
    made = [result for result in results if isinstance(result, Prediction)]
    at = made[-1].t if made else one.twin.data_t
    if not np.isfinite([at, one.log.begun]).all():
        return
    slot = int((at - one.log.begun) // plan.every_s)
    if slot > one.slot:
        late = one.slot * plan.every_s >= FIRST_S
        one.silent += late and not one.answered and not one.twin.why_no_route()
        one.slot, one.answered = slot, False
    if made and not one.answered:
        one.answered = True
        _start(one, made[-1], plan)


def _start(one: Examined, made: Prediction, plan: Plan) -> None:
    twin = one.twin
    flown = seen(twin, _LOOK_BACK_S)
    if flown is None or twin.origin is None:
        return
    flown = flown.whole()
    ahead = AHEAD
    now = Now(twin, flown, ahead + (made.t - flown.t[-1]))
    told = {OURS: _told(made, ahead, made.t)}
    for name in plan.methods:
        path = _paper(one, made, ahead) if name == PAPER else _path(name, now, told[OURS])
        if path is None:
            fallback = BASELINES[STAND_IN](now)
            path = None if fallback is None else Told(fallback, STAND_IN)
        if path is not None:
            told[name] = path
    group, spread = _kept(twin, made, ahead)
    one.asked.append(
        Asked(
            flight=one.flight,
            uav=twin.uav,
            t=made.t,
            first_s=made.t - one.log.begun,
            ahead=ahead,
            origin=twin.origin,
            speed=float(np.linalg.norm(flown.v[-1])),
            follows=twin.why_no_route(),
            group=group,
            told=told,
            spread=spread,
        )
    )


def _path(name: str, now: Now, ours: Told) -> Told | None:
    """Return the forecast of one baseline; `dynamics` reuses ours where ours is `dynamics`."""
    if name == DYNAMICS and ours.made_by == DYNAMICS:
        return Told(ours.path, DYNAMICS)
    path = BASELINES[name](now)
    near = now.ahead <= WHOLE_S
    return None if path is None or not np.isfinite(path[near]).all() else Told(path, name)


def _told(made: Prediction, ahead: np.ndarray, t: float) -> Told:
    """Resample a prediction to look-aheads from `t`, which is within one step of its own time."""
    own = made.t + made.ahead.numpy().astype(float)
    path, tube = (
        np.column_stack([np.interp(t + ahead, own, column, right=np.nan) for column in rows.numpy().astype(float).T])
        for rows in (made.path, made.tube)
    )
    return Told(path, made.method, tube, made.horizon_s)


def _paper(one: Examined, made: Prediction, ahead: np.ndarray) -> Told | None:
    """Step the paper's twin once and return its forecast by the paper's method; None without one."""
    assert one.paper is not None
    results = advance(one.paper, (), one.twin.turned_t)
    found = [r for r in results if isinstance(r, Prediction) and r.method == PAPER]
    return _told(found[-1], ahead, made.t) if found else None


def _kept(twin: Twin, made: Prediction, ahead: np.ndarray) -> tuple[str, np.ndarray]:
    """Return the calibration group of a prediction and its ensemble spread, (k, 3) [m] or nan."""
    latest = twin.record.latest
    spread = np.full((len(ahead), 3), np.nan)
    if latest is None or abs(latest[0].t + latest[0].ahead[0] - made.t) > _SAME_S:
        return made.method, spread
    if latest[0].spread is not None:
        spread[: len(latest[0].spread)] = latest[0].spread
    return latest[0].group, spread
