"""One experiment of the paper: identify two linear models on a window, and run them free over the seconds after it.

First step: projection (as in the paper) or PBSID; then prediction-error refinement without prior. The models have
4 longitudinal and 5 lateral states.  Source: Huang 2021, sections 3.1 and 4.2.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fleet.airframes.airframe import servo_map
from fleet.contract import Outcome, Params, Sample
from fleet.frames import Origin, ned_to_body
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions
from fleet.telemetry.recording.recordings import replay_messages
from fleet.window import STATES as ALL
from fleet.window import Window
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.linear.linear_model import AXES, INPUTS, STATES, AxisModel
from twin_worker.identification.linear.prediction_error_method import refine
from twin_worker.identification.linear.state_space import StateSpace
from twin_worker.identification.linear.subspace import pbsid, projection
from twin_worker.telemetry.flight_phase import phase_of
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.resample import preprocess
from twin_worker.validation.held_out import HeldOut
from twin_worker.validation.verify import fit_percent, verify

_WIND_S = 0.2  # sampling interval of the wind filter [s]
_WIND_TRANSIENT_S = 20.0  # convergence time of the wind filter [s]


@dataclass(frozen=True)
class RecordedFlight:
    """One aircraft's flight.

    Attributes:
        uav: id
        recording: whole flight, velocities over the ground
        wind: filtered wind at each row, NED, (n, 3) [m/s]
    """

    uav: int
    recording: Window
    wind: np.ndarray

    def window(self, start: int, seen_s: float, unseen_s: float) -> Window:
        """Return the window around row `start`, with air-relative velocities from the wind at `start`."""
        dt = self.recording.dt
        part = self.recording.part(start - round(seen_s / dt), start + round(unseen_s / dt))
        phi, theta, psi = part.columns(("phi", "theta", "psi")).T
        air = ned_to_body(phi, theta, psi, part.v - self.wind[start])
        return replace(part, x=np.hstack([air, part.x[:, 3:]]))

    def starts(self, seen_s: float, unseen_s: float, every_s: float) -> Iterator[int]:
        """Yield the start rows of unseen windows without gaps."""
        dt = self.recording.dt
        seen, unseen, every = (round(s / dt) for s in (seen_s, unseen_s, every_s))
        for start in range(round(_WIND_TRANSIENT_S / dt) + seen, len(self.recording) - unseen + 1, every):
            if self.recording.ok[start - unseen : start + unseen].all():
                yield start


def read_flights(path: Path, offset: int = 0, options: RecordingOptions = NO_OPTIONS) -> Iterator[RecordedFlight]:
    """Read every flight of a recording that has all required rows.

    Args:
        path: recording, e.g. flight.tlog.xz
        offset: UAV id = MAVLink system id + this
        options: mission, parameters and column map from files
    """
    histories: dict[int, TelemetryHistory] = {}
    params: dict[int, dict[str, float]] = {}
    for message in replay_messages(path, offset, options=options):
        if isinstance(message, Sample):
            histories.setdefault(message.uav, TelemetryHistory(keep_s=1e5)).add(message)
        elif isinstance(message, Params):
            params.setdefault(message.uav, {}).update(message.values)
    for uav, history in sorted(histories.items()):
        t, lla = history.rows("position")
        if len(t) < 2:
            continue
        origin, servos = Origin(*(int(k) for k in lla[0])), servo_map(params.get(uav, {}))
        end, length = float(t[-1]), float(t[-1] - t[0])
        recording = preprocess(history, origin, servos, np.zeros(3), until=end, seconds=length)
        if recording is not None:
            yield RecordedFlight(uav, recording, _wind(history, recording))


def _wind(history: TelemetryHistory, recording: Window) -> np.ndarray:
    """Filter the wind along the flight, (n, 3) [m/s]; zero without airspeed."""
    wind = np.zeros((len(recording), 3))
    t_air, air = history.rows("air")
    if not len(t_air):
        return wind
    filt, every = WindFilter(), round(_WIND_S / recording.dt)
    Va = np.interp(recording.t, t_air, air[:, 0])
    for k in range(0, len(recording), every):
        if recording.ok[k]:
            filt.update(float(recording.t[k]), recording.v[k], float(Va[k]), float(recording.x[k, 8]))
        wind[k : k + every] = filt.wind
    return wind


FIRST_STEPS: dict[str, Callable[..., StateSpace]] = {"projection": projection, "pbsid": pbsid}
STATE_NAMES = tuple(name for axis in AXES for name in STATES[axis])
_WEAK_PRECISION = 1e-3  # prior precision that only regularises the normal equations [-]


@dataclass(frozen=True)
class ExperimentPlan:
    """Settings of an experiment.

    Attributes:
        seen_s: length of the identification window [s]
        unseen_s: length of the free run [s]
        every_s: interval between the starts of two experiments [s]
        segment_s: free-run length of the refinement [s]
    """

    seen_s: float = 40.0
    unseen_s: float = 8.0
    every_s: float = 5.0
    segment_s: float = 8.0


@dataclass(frozen=True)
class Experiment:
    """One pair of models with its free run over unseen data.

    Attributes:
        uav, t: UAV id, and start of the unseen window [s since 1970]
        mode, mode_seen: flight mode of the unseen window, and of the window of equal length before it
        seconds: since the start of the unseen window, (n,) [s]
        actual, first, refined: states in the order of `STATE_NAMES`, (n, 9) [m/s, rad/s, rad]
        fit: both steps over the unseen window, (2, 9) [%]
        fit_seen: both steps over the last part of the identification window, (2, 9) [%]
        outcome, sentence: verdict on the refined model
    """

    uav: int
    t: float
    mode: str
    mode_seen: str
    seconds: np.ndarray
    actual: np.ndarray
    first: np.ndarray
    refined: np.ndarray
    fit: np.ndarray
    fit_seen: np.ndarray
    outcome: Outcome
    sentence: str


def both_steps(axis: str, seen: Window, first: str, segment_s: float) -> tuple[AxisModel, AxisModel]:
    """Identify one axis by the first step, and refine it by the prediction error of free runs, without prior.

    Args:
        axis: `longitudinal` or `lateral`
        seen: identification window
        first: name of the first step, `projection` or `pbsid`
        segment_s: free-run length of the refinement [s]
    Raises:
        ValueError: if the data are too short or not informative; the message names the reason.
    """
    states, inputs = STATES[axis], INPUTS[axis]
    y, u, ok = seen.columns(states), seen.columns(inputs), seen.ok
    scale = [np.maximum(data[ok].std(axis=0), least) for data, least in ((y, 1e-3), (u, 1e-6))]
    axis_model = AxisModel(
        states, inputs, np.empty((0, 0)), y[ok].mean(axis=0), scale[0], u[ok].mean(axis=0), scale[1], seen.dt
    )
    y, u = axis_model.scaled(seen)
    model = FIRST_STEPS[first](y, u, len(states), ok=ok).outputs_as_states().stabilised()
    start = np.hstack([model.A, model.B, np.zeros((len(states), 1))])
    precision = np.full(start.shape, _WEAK_PRECISION)
    refined = refine(
        start,
        y,
        u,
        ok,
        prior=start,
        precision=precision,
        length=int(segment_s / seen.dt),
        effective_fraction=1.0,
        steps=20,
    )
    return replace(axis_model, D=start), replace(axis_model, D=refined)


def run_experiment(flight: RecordedFlight, start: int, first: str, plan: ExperimentPlan) -> Experiment:
    """Identify on the window before row `start` and run free from it.

    Raises:
        ValueError: if the data are too short or not informative; the message names the reason.
    """
    window = flight.window(start, plan.seen_s, plan.unseen_s)
    n_seen, n_unseen = round(plan.seen_s / window.dt), round(plan.unseen_s / window.dt)
    axes = [both_steps(axis, window.part(0, n_seen), first, plan.segment_s) for axis in AXES]
    steps = [(axes[0][k], axes[1][k]) for k in (0, 1)]
    runs, seen_runs = ([_free_run(pair, window, at, n_unseen) for pair in steps] for at in (n_seen, n_seen - n_unseen))
    actual, seen_actual = (window.columns(STATE_NAMES)[at : at + n_unseen] for at in (n_seen, n_seen - n_unseen))
    verdict = verify(steps[1], window, n_seen)
    return Experiment(
        uav=flight.uav,
        t=float(window.t[n_seen]),
        mode=phase_of(window.part(n_seen, n_seen + n_unseen)),
        mode_seen=phase_of(window.part(n_seen - n_unseen, n_seen)),
        seconds=window.t[n_seen : n_seen + n_unseen] - window.t[n_seen],
        actual=actual,
        first=runs[0],
        refined=runs[1],
        fit=np.array([fit_percent(actual, run) for run in runs]),
        fit_seen=np.array([fit_percent(seen_actual, run) for run in seen_runs]),
        outcome=verdict.outcome,
        sentence=verdict.sentence,
    )


def _free_run(pair: tuple[AxisModel, AxisModel], window: Window, start: int, length: int) -> np.ndarray:
    """Run both axes free from the measured states of a row, (length, 9)."""
    order = [ALL.index(name) for name in STATE_NAMES]
    return HeldOut(pair, window.part(start, start + length), 0).runs(length)[:, order]


def run_experiments(flights: Iterable[RecordedFlight], first: str, plan: ExperimentPlan) -> Iterator[Experiment | str]:
    """Run all possible experiments; yield the reason as text where one fails."""
    for flight in flights:
        for start in flight.starts(plan.seen_s, plan.unseen_s, plan.every_s):
            try:
                yield run_experiment(flight, start, first, plan)
            except ValueError as error:
                yield f"uav-{flight.uav}: {error}"
