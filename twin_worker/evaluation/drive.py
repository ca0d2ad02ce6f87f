"""Replay recordings through the twins as if live, with forecasts of every method at the same instants."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from fleet.contract import Message, Params, Prediction, Status
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions
from twin_worker.confidence.tube_and_horizon import AHEAD
from twin_worker.evaluation.baselines import BASELINES, BaselineInput
from twin_worker.evaluation.scoring.compare import MIN_EVENT_FREE_S, MIN_FIRST_S, resolve_starts
from twin_worker.evaluation.scoring.log import OURS, EvaluationCase, EvaluationStart, MethodForecast, ReferenceFlight
from twin_worker.identification.fixed_wing.plant import DYNAMICS, PAPER
from twin_worker.twin.state.state import AUTO, ingest
from twin_worker.twin.step import Twin, advance, silent_step_times
from twin_worker.twin.steps.kinematic_prediction import recent_track

FALLBACK = "imm"  # fallback of a method that cannot predict
_HISTORY_S = 62.0  # telemetry available to the baselines [s]
_TIME_TOLERANCE_S = 0.01  # predictions whose starts differ by more are different [s]


@dataclass(frozen=True)
class EvaluationPlan:
    """Settings of an evaluation.

    Attributes:
        every_s: interval between starts [s]
        method: method of the twin
        methods: names of the methods to compare with
        without_params: withhold the autopilot's parameters from every twin
        options: mission, parameters and column map from files
        first_s: minimum time of a start since the first sample [s]
        event_free_s: minimum flight without an event after a start [s]
    """

    every_s: float = 5.0
    method: str = AUTO
    methods: tuple[str, ...] = (*BASELINES, PAPER)
    without_params: bool = False
    options: RecordingOptions = NO_OPTIONS
    first_s: float = MIN_FIRST_S
    event_free_s: float = MIN_EVENT_FREE_S


@dataclass
class EvaluatedUav:
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
    paper_twin: Twin | None
    reference: ReferenceFlight = field(default_factory=ReferenceFlight)
    starts: list[EvaluationStart] = field(default_factory=list)
    slot: int = -1
    predicted: bool = True
    missed: int = 0


@dataclass
class RecordingDriver:
    """Evaluation of the aircraft of one recording.

    Attributes:
        name: name of the recording
        plan: settings
        share: aircraft before this recording, remainder and divisor: evaluate the aircraft whose number, in order of
            appearance over all recordings, has this remainder
        uavs: aircraft by UAV id; None: not selected
    """

    name: str
    plan: EvaluationPlan
    share: tuple[int, int, int] = (0, 0, 1)
    uavs: dict[int, EvaluatedUav | None] = field(default_factory=dict)

    def run(self, messages: Iterable[Message]) -> Iterator[EvaluationCase]:
        """Replay messages through the twins in the order they were received; yield every resolved start."""
        for message in messages:
            evaluated = self._evaluated(message.uav)
            if evaluated is None:
                continue
            before = evaluated.twin.onboard.status
            if isinstance(message, Status) and before is not None:
                now, earlier = ((status.clock_jumps, status.clock_advance_s) for status in (message, before))
                if now != earlier:
                    yield from _resolve_starts(evaluated, self.plan)
                    evaluated.reference, evaluated.slot = ReferenceFlight(), -1
            evaluated.reference.add(message)
            if not (self.plan.without_params and isinstance(message, Params)):
                _advance(evaluated, message, self.plan)
        for evaluated in self.uavs.values():
            if evaluated is not None:
                yield from _resolve_starts(evaluated, self.plan)

    @property
    def missed(self) -> int:
        """Return the number of intervals without any prediction."""
        return sum(evaluated.missed for evaluated in self.uavs.values() if evaluated is not None)

    def _evaluated(self, uav: int) -> EvaluatedUav | None:
        if uav not in self.uavs:
            before, remainder, divisor = self.share
            paper_twin = Twin.of(uav, method=PAPER) if PAPER in self.plan.methods else None
            evaluated = EvaluatedUav(f"{self.name}:uav-{uav}", Twin.of(uav, method=self.plan.method), paper_twin)
            self.uavs[uav] = evaluated if (before + len(self.uavs)) % divisor == remainder else None
        return self.uavs[uav]


def _resolve_starts(evaluated: EvaluatedUav, plan: EvaluationPlan) -> Iterator[EvaluationCase]:
    """Yield every start so far, compared with the actual flight."""
    yield from resolve_starts(evaluated.reference, evaluated.starts, plan.first_s, plan.event_free_s)
    evaluated.starts.clear()


def _advance(evaluated: EvaluatedUav, message: Message, plan: EvaluationPlan) -> None:
    """Advance the twin by one message and record its predictions, with no later data available to any method."""
    for t in silent_step_times(evaluated.twin, message):
        _record_results(evaluated, advance(evaluated.twin, (), t), plan)
    if evaluated.paper_twin is not None:
        ingest(evaluated.paper_twin, message)
    _record_results(evaluated, advance(evaluated.twin, (message,)), plan)


def _record_results(evaluated: EvaluatedUav, results: Iterable[Message], plan: EvaluationPlan) -> None:
    """Record a start at the first prediction of every interval of `every_s`."""
    predictions = [result for result in results if isinstance(result, Prediction)]
    t = predictions[-1].t if predictions else evaluated.twin.telemetry.data_t
    if not np.isfinite([t, evaluated.reference.first_t]).all():
        return
    slot = int((t - evaluated.reference.first_t) // plan.every_s)
    if slot > evaluated.slot:
        late = evaluated.slot * plan.every_s >= plan.first_s
        evaluated.missed += late and not evaluated.predicted and not evaluated.twin.no_route_reason()
        evaluated.slot, evaluated.predicted = slot, False
    if predictions and not evaluated.predicted:
        evaluated.predicted = True
        _record_start(evaluated, predictions[-1], plan)


def _record_start(evaluated: EvaluatedUav, prediction: Prediction, plan: EvaluationPlan) -> None:
    twin = evaluated.twin
    track = recent_track(twin, _HISTORY_S)
    if track is None or twin.telemetry.origin is None:
        return
    track = track.unbroken_tail()
    inputs = BaselineInput(twin, track, AHEAD + (prediction.t - track.t[-1]))
    forecasts = {OURS: _resampled_forecast(prediction, prediction.t)}
    for name in plan.methods:
        if name == PAPER:
            forecast = _paper_forecast(evaluated, prediction)
        else:
            forecast = _baseline_forecast(name, inputs, forecasts[OURS])
        if forecast is None and (path := BASELINES[FALLBACK](inputs)) is not None:
            forecast = MethodForecast(path, FALLBACK)
        if forecast is not None:
            forecasts[name] = forecast
    group, spread = _group_and_spread(twin, prediction)
    evaluated.starts.append(
        EvaluationStart(
            flight=evaluated.flight,
            uav=twin.config.uav,
            t=prediction.t,
            first_s=prediction.t - evaluated.reference.first_t,
            ahead=AHEAD,
            origin=twin.telemetry.origin,
            speed=float(np.linalg.norm(track.v[-1])),
            no_route_reason=twin.no_route_reason(),
            group=group,
            forecasts=forecasts,
            spread=spread,
        )
    )


def _baseline_forecast(name: str, inputs: BaselineInput, ours: MethodForecast) -> MethodForecast | None:
    """Return the forecast of one baseline; `dynamics` reuses ours where ours is `dynamics`."""
    if name == DYNAMICS and ours.source == DYNAMICS:
        return MethodForecast(ours.path, DYNAMICS)
    path = BASELINES[name](inputs)
    required = inputs.ahead <= MIN_EVENT_FREE_S
    return None if path is None or not np.isfinite(path[required]).all() else MethodForecast(path, name)


def _resampled_forecast(prediction: Prediction, t: float) -> MethodForecast:
    """Resample a prediction to look-aheads from `t`, which is within one step of its own time."""
    prediction_t = prediction.t + prediction.ahead.numpy().astype(float)

    def resampled(rows: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(t + AHEAD, prediction_t, column, right=np.nan) for column in rows.T])

    path, tube = (
        resampled(rows.numpy().astype(float)) for rows in (prediction.path, prediction.prediction_region_half_axes)
    )
    return MethodForecast(path, prediction.method, tube, prediction.horizon_s)


def _paper_forecast(evaluated: EvaluatedUav, prediction: Prediction) -> MethodForecast | None:
    """Step the paper's twin once and return its forecast by the paper's method; None without one."""
    assert evaluated.paper_twin is not None
    results = advance(evaluated.paper_twin, (), evaluated.twin.telemetry.last_step_t)
    predictions = [result for result in results if isinstance(result, Prediction) and result.method == PAPER]
    return _resampled_forecast(predictions[-1], prediction.t) if predictions else None


def _group_and_spread(twin: Twin, prediction: Prediction) -> tuple[str, np.ndarray]:
    """Return the calibration group of a prediction and its ensemble spread, (k, 3) [m] or nan."""
    latest = twin.confidence.tracker.latest
    spread = np.full((len(AHEAD), 3), np.nan)
    if latest is None or abs(latest[0].t + latest[0].ahead[0] - prediction.t) > _TIME_TOLERANCE_S:
        return prediction.method, spread
    if latest[0].spread is not None:
        spread[: len(latest[0].spread)] = latest[0].spread
    return latest[0].group, spread
