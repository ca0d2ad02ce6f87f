"""One experiment of the paper: identify on a window of flight, run free over the seconds after it.

Three models of the same window:

- first step: projection (as in the paper) or PBSID, 4 longitudinal and 5 lateral states, with bias;
- refined: the same model after prediction-error refinement over free runs of growing length, start states and output
  biases estimated, with a ridge towards the result of the shorter runs, at first towards the first step;
- coupled: the derivatives model of the twin, both axes in one model with exact kinematics.

Source: Huang 2021, sections 3.1 and 4.2.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fleet.airframes import GENERIC, load
from fleet.airframes.airframe import servo_map
from fleet.contract import Outcome, Params, Sample
from fleet.frames import Origin, ned_to_body
from fleet.physics.simulate import TAU, lagged
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions
from fleet.telemetry.recording.recordings import replay_messages
from fleet.window import STATES as ALL
from fleet.window import Window
from twin_worker.estimation.wind_filter import WindFilter, reported_direction
from twin_worker.identification.fixed_wing.derivatives_model import identify
from twin_worker.identification.linear.linear_model import AXES, INPUTS, STATES, AxisModel
from twin_worker.identification.linear.multiple_shooting import refine_with_starts
from twin_worker.identification.linear.state_space import StateSpace
from twin_worker.identification.linear.subspace import pbsid, projection
from twin_worker.paper_experiments.free_run import coupled_free_run, linear_free_run, sensor_errors
from twin_worker.telemetry.flight_phase import PHASES, phase_of
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.resample import preprocess
from twin_worker.validation.verify import fit_percent, verify_free_run

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
            phi, theta, psi = recording.x[k, 6:].tolist()
            direction = reported_direction(phi, theta, psi, float(recording.v[k, 2]), float(Va[k]))
            filt.update(float(recording.t[k]), recording.v[k], float(Va[k]), direction)
        wind[k : k + every] = filt.wind
    return wind


FIRST_STEPS: dict[str, Callable[..., StateSpace]] = {"projection": projection, "pbsid": pbsid}
STATE_NAMES = tuple(name for axis in AXES for name in STATES[axis])
MODELS = ("first", "refined", "coupled")
_ORDER = [ALL.index(name) for name in STATE_NAMES]
# free-run lengths of the refinement, one after the other [s], and precision of an entry of [A B c] about the result
# before, scaled units [-]; the first is low, because the projection is biased in closed loop
_REFINEMENT = ((0.5, 1e2), (2.0, 1e3), (4.0, 1e3))
SEEN_RUN_S = 8.0  # free run over the end of the identification data [s]
START_S = 1.0  # data before the free run that determine its start [s]


@dataclass(frozen=True)
class ExperimentPlan:
    """Settings of an experiment.

    Attributes:
        seen_s: length of the identification window [s]
        unseen_s: length of the free run [s]
        every_s: interval between two possible starts [s]
        each: maximum number of experiments of one mode, spread evenly over all flights
    """

    seen_s: float = 40.0
    unseen_s: float = 4.0
    every_s: float = 1.0
    each: int = 200


@dataclass(frozen=True)
class Experiment:
    """Three models with their free runs over unseen data.

    Attributes:
        uav, t: UAV id, and start of the unseen window [s since 1970]
        mode, mode_seen: flight mode of the unseen window, and of the end of the identification data
        seconds: since the start of the unseen window, (n,) [s]
        actual: states in the order of `STATE_NAMES`, (n, 9) [m/s, rad/s, rad]
        runs: free run of each of `MODELS`, (3, n, 9)
        fit: of each model over the unseen window, (3, 9) [%]
        fit_seen: of each model over the end of the identification data, (3, 9) [%]
        outcome, sentence: verdict on the refined model
    """

    uav: int
    t: float
    mode: str
    mode_seen: str
    seconds: np.ndarray
    actual: np.ndarray
    runs: np.ndarray
    fit: np.ndarray
    fit_seen: np.ndarray
    outcome: Outcome
    sentence: str


def both_steps(axis: str, seen: Window, first: str) -> tuple[AxisModel, AxisModel]:
    """Identify one axis by the first step, and refine it by the prediction error of free runs.

    Args:
        axis: `longitudinal` or `lateral`
        seen: identification window
        first: name of the first step, `projection` or `pbsid`
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
    refined = refine_with_starts(
        start,
        y,
        u,
        ok,
        runs=[(round(run_s / seen.dt), ridge) for run_s, ridge in _REFINEMENT],
        errors=sensor_errors(states, scale[0]),
    )
    return replace(axis_model, D=start), replace(axis_model, D=refined)


def run_experiment(flight: RecordedFlight, start: int, first: str, plan: ExperimentPlan) -> Experiment:
    """Identify on the window before row `start` and run free from it.

    Raises:
        ValueError: if the data are too short or not informative; the message names the reason.
    """
    window = flight.window(start, plan.seen_s, plan.unseen_s)
    dt = window.dt
    n, before, tail = round(plan.seen_s / dt), round(START_S / dt), round(min(SEEN_RUN_S, plan.seen_s) / dt)
    training, wind = window.part(0, n), flight.wind[start]
    lagged_inputs = replace(window, u=lagged(window.u, dt, TAU))
    axes = [both_steps(axis, lagged_inputs.part(0, n), first) for axis in AXES]
    coupled = identify(training, wind, load(GENERIC))
    states = window.columns(STATE_NAMES)
    runs, actual = {}, {}
    for name, fitted, shown in (
        ("unseen", slice(n - before, n), slice(n, len(window))),
        ("seen", slice(n - tail, n), slice(n - tail, n)),
    ):
        steps = [np.hstack([linear_free_run(axis[k], lagged_inputs, fitted, shown) for axis in axes]) for k in (0, 1)]
        runs[name] = np.array([*steps, coupled_free_run(coupled, window, fitted, shown, wind)[:, _ORDER]])
        actual[name] = states[shown]
    refined = np.empty_like(runs["unseen"][1])
    refined[:, _ORDER] = runs["unseen"][1]
    outcome, reason = verify_free_run(window.x[n:], refined, training)
    fit, fit_seen = (np.array([fit_percent(actual[k], run) for run in runs[k]]) for k in ("unseen", "seen"))
    return Experiment(
        uav=flight.uav,
        t=float(window.t[n]),
        mode=phase_of(window.part(n, len(window))),
        mode_seen=phase_of(window.part(n - tail, n)),
        seconds=window.t[n:] - window.t[n],
        actual=actual["unseen"],
        runs=runs["unseen"],
        fit=fit,
        fit_seen=fit_seen,
        outcome=outcome,
        sentence=f"mean fit {fit[1].mean():.0f} %, {reason}",
    )


def choose_starts(flights: Sequence[RecordedFlight], plan: ExperimentPlan) -> list[tuple[RecordedFlight, int]]:
    """Return flight and start row of every experiment: of each mode at most `plan.each`, spread evenly."""
    by_mode: dict[str, list[tuple[RecordedFlight, int]]] = {mode: [] for mode in PHASES}
    for flight in flights:
        unseen = round(plan.unseen_s / flight.recording.dt)
        for start in flight.starts(plan.seen_s, plan.unseen_s, plan.every_s):
            by_mode[phase_of(flight.recording.part(start, start + unseen))].append((flight, start))
    chosen = []
    for starts in by_mode.values():
        count = min(plan.each, len(starts))
        chosen += [starts[k * len(starts) // count] for k in range(count)]
    return chosen


def run_experiments(
    starts: Iterable[tuple[RecordedFlight, int]], first: str, plan: ExperimentPlan
) -> Iterator[Experiment | str]:
    """Run experiments; yield the reason as text where one fails."""
    for flight, start in starts:
        try:
            yield run_experiment(flight, start, first, plan)
        except ValueError as error:
            yield f"uav-{flight.uav}: {error}"
