"""Compile the twin's physics before the first aircraft needs it, on a synthetic straight flight."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from fleet.airframes import GENERIC, load
from fleet.airframes.airframe import servo_map
from fleet.autopilots import arduplane, copter, copter_legs, greybox, position_loop, px4_multirotor
from fleet.autopilots.laws import remember
from fleet.autopilots.shadow import NO_MEMORY, replay_controller
from fleet.contract import Array, Item, Prediction, TwinState
from fleet.frames import Origin, to_geodetic, wrap
from fleet.mission import unroll_route
from fleet.physics import point_mass, wrench
from fleet.physics.simulate import N_STATE, coupled_plant, linear_plant, simulate
from fleet.terrain.areas import Area
from fleet.window import Window
from twin_worker import CACHE_COMPLETE
from twin_worker.alerts.traffic import TrafficMonitor
from twin_worker.confidence.adaptive_conformal import AdaptiveLevels
from twin_worker.confidence.prediction_log import PredictionLog
from twin_worker.estimation.wind_filter import WindFilter, reported_direction
from twin_worker.identification.fixed_wing.derivatives_model import identify, linearise
from twin_worker.identification.fixed_wing.energy_balance import PointMassData, fit_attitude_lag, fit_turn_rate
from twin_worker.identification.fixed_wing.plant import bias_corrected
from twin_worker.identification.linear.linear_model import AXES, identify_axis
from twin_worker.identification.multirotor.rotor_model import HIGH, free_run, start_states
from twin_worker.identification.multirotor.rotor_window import RotorWindow
from twin_worker.numerics.interpolation import zero_order_hold
from twin_worker.numerics.prediction_errors import AHEAD, displacement_along_path
from twin_worker.prediction.constant_turn import imm
from twin_worker.prediction.fixed_wing.point_mass_rollout import unexplained_velocity
from twin_worker.prediction.method_selection import MethodSelector
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.resample import Resampler
from twin_worker.twin.state.flight_phase import speed_extremes
from twin_worker.twin.steps.extrapolate import continue_path, widen_tube
from twin_worker.validation.held_out import HeldOut
from twin_worker.validation.verify import verify, with_diagnostics

_SPEED = 22.0  # [m/s]
_HOME = Origin(470_000_000, 80_000_000, 100_000)
_ITEMS = tuple(
    Item(seq=k, command=16, lat_e7=470_000_000 + 90_000 * k, lon_e7=80_000_000, alt_m=100.0) for k in range(3)
)


def warm_up() -> None:
    """Run every compiled function of the worker once; about one second from the disk cache.

    With an empty cache two processes compile at once. Workers that start together wait for the first one's cache.
    """
    for step in warm_up_steps():
        step()


def warm_up_steps() -> tuple[Callable[[], None], ...]:
    """Return the steps of the warm-up, in order."""
    return _fill_cache, *(step for group in _GROUPS for step in group)


def _fill_cache() -> None:
    """Compile everything if no process has done so before."""
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    complete = folder / CACHE_COMPLETE
    if not complete.exists():
        with _locked(folder / "lock"):
            if not complete.exists():
                _compile_in_two_processes()
                complete.touch()


def _compile_in_two_processes() -> None:
    """Compile the first group here and the second in a process of its own, which ends with this one."""
    command = f"from {__name__} import compile_second_group; compile_second_group()"
    with subprocess.Popen([sys.executable, "-c", command], stdin=subprocess.PIPE) as other:
        for step in _GROUPS[0]:
            step()
        other.wait()  # what it failed to compile is compiled here


def compile_second_group() -> None:
    """Compile what the parent does not; end when the parent ends and closes standard input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    threading.Thread(target=_exit_at_end_of_input, daemon=True).start()
    for step in _GROUPS[1]:
        step()


def _exit_at_end_of_input() -> None:
    os.read(sys.stdin.fileno(), 1)  # not through a buffer, which the interpreter could not close meanwhile
    os._exit(1)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock against other processes; without one on Windows, where every process compiles."""
    with path.open("w", encoding="ascii") as file:
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _run_fixed_wings() -> None:
    """Run the predictions of fixed wings."""
    window = _synthetic_flight()
    par, _ = arduplane.parameters({})
    legs = unroll_route(_ITEMS, seq=1, origin=_HOME, params={}).legs
    n = len(window)
    euler, rates = np.ascontiguousarray(window.x[:, 6:]), np.ascontiguousarray(window.x[:, 3:6])
    inputs = [np.full(n, _SPEED), np.zeros(n), np.zeros(n), window.u, np.ones(n, np.int64)]
    rows = [window.t - window.t[0], window.p, window.v, euler, rates, *inputs]
    ctl, _ = replay_controller(par, legs, window.p[0], *rows, NO_MEMORY)  # type: ignore
    remember(ctl, par, 0.0)
    state = np.concatenate([window.p[-1], window.x[-1]])
    linear = linear_plant(np.zeros((4, 8)), np.full(7, _SPEED), np.zeros((5, 8)), np.zeros(7))
    coupled = coupled_plant(np.zeros(wrench.N_PAR), np.array([_SPEED, 0.0]))
    air = np.array([0.0, 0.0, 1.0, 0.0])
    kinematic_ctl = ctl.copy()
    for plant in (linear, coupled):
        simulate(ctl.copy(), par, legs, plant, state, np.zeros(6), air, window.dt, np.empty((50, N_STATE)))

    _run_point_mass((ctl.copy(), par, legs), window)
    ahead, factors = np.empty((5, 3)), np.ones(greybox.N_PAR)
    start = np.array([*window.p[-1], _SPEED, 0.0, 0.0, 0.0])
    greybox.follow(kinematic_ctl, par, legs, factors, start, np.zeros(2), 0.1, ahead)  # type: ignore
    _run_propagation()


def _run_point_mass(control: tuple[np.ndarray, np.ndarray, np.ndarray], window: Window) -> None:
    """Run the point-mass model, alone and as a batch of two."""
    parameters, air, start = np.ones(point_mass.N_PARAMETERS), np.ones(point_mass.N_AIR), np.zeros(point_mass.N_START)
    parameters[point_mass.V_0] = start[point_mass.V] = _SPEED
    start[:3], noise = window.p[-1], np.zeros((2, 5, 4))
    point_mass.simulate_route(
        control[0].copy(), *control[1:], parameters, air, start, noise[0], point_mass.STEP, np.empty((5, 3))
    )
    batch = [np.tile(row, (2, 1)) for row in (parameters, air, start)]
    point_mass.simulate_ensemble(control, *batch, noise, np.arange(0, 17, 4), np.empty((2, 5, 3)))  # type: ignore
    fit_attitude_lag(np.ascontiguousarray(window.x[:, 6]), window.x[:, 6])
    fit_turn_rate(PointMassData(*(np.ones(len(window)),) * 11))


def _run_multirotors() -> None:
    """Run the three multirotor laws along two segments."""
    segments, out, motion = np.ones((2, copter.N_SEGMENT)), np.empty((5, 3)), np.zeros((4, 3))
    copter.follow(np.zeros(copter.N_FOLLOW), segments, np.zeros(3), np.zeros(3), np.ones(copter.N_PAR), 0.1, out)
    segments = np.ones((2, px4_multirotor.N_COLUMNS))
    state, par = np.zeros(px4_multirotor.N_STATE), np.ones(px4_multirotor.N_PAR)
    px4_multirotor.begin_trajectory(state, motion, par)
    px4_multirotor.follow(state, segments, motion, par, 0.1, out)
    segments, par = np.ones((2, copter_legs.N_COLUMNS)), np.ones(position_loop.N_PAR)
    copter_legs.follow(np.zeros(copter_legs.N_STATE), segments, motion, par, 0.1, out)
    states, simulated = np.empty((5, copter_legs.N_STATE)), np.empty((5, 4, 3))
    copter_legs.simulated_states(segments, 1, par, 0.1, states, simulated)
    position_loop.drag_integrator(np.zeros((2, 2)), np.zeros((2, 2)), par, 0.1, 1.0)
    x, first = np.zeros((4, 3)), np.zeros(1, int)
    window = RotorWindow(x[:, 0], x, x, x[:, :2].copy(), x[:, :2].copy(), np.full((4, 4), 0.5), np.ones(4, bool))
    free_run(HIGH, window, first, start_states(window, first), 2, commanded=True)


def _run_traffic() -> None:
    """Run the conflict detection for two aircraft on a collision course."""
    traffic, ahead = TrafficMonitor(), np.arange(0.0, 20.0)
    for uav, direction in ((0, 1.0), (1, -1.0)):
        path = np.column_stack([direction * _SPEED * (ahead - 10.0), 0.0 * ahead, -100.0 + 0.0 * ahead])
        prediction = Prediction(
            uav=uav,
            t=1e9,
            state=TwinState.PREDICTING,
            method="",
            origin=(_HOME.lat_e7, _HOME.lon_e7, _HOME.alt_mm),
            ahead=Array.of(ahead),
            path=Array.of(path),
            prediction_region_half_axes=Array.of(np.ones((20, 3))),
        )
        traffic.receive(prediction)
    traffic.assess(0, 1e9)


def _run_propagation() -> None:
    """Propagate a prediction, predict turns, update the wind filter, detect flight, and compare with an area."""
    ahead, path = (Array.of(values).numpy() for values in (np.arange(5.0), np.zeros((5, 3))))
    imm(np.zeros((4, 3)), np.zeros((4, 3)), AHEAD)
    displacement_along_path(np.outer(AHEAD, [_SPEED, 0.0, 0.0]), AHEAD)
    keeps_along = continue_path(ahead, path, 1.0, np.zeros(3), np.zeros(3), np.empty((4, 3), np.float32))  # type: ignore[call-arg]
    widen_tube(ahead, path, 1.0, keeps_along, np.empty((4, 3), np.float32))  # type: ignore[call-arg]
    speed_extremes(np.zeros((3, 3)))  # type: ignore[call-arg]
    Area("area", ((_HOME.lat_e7, 0), (0, _HOME.lon_e7), (0, 0)), exclusion=True).depth(np.zeros((1, 3)), _HOME)
    WindFilter().update(1e9, np.array([_SPEED, 0.0, 0.0]), _SPEED, reported_direction(0.0, 0.0, 0.0, 0.0, _SPEED))
    for rows in ((), (2,)):
        start, air = np.ones((*rows, point_mass.N_START)), np.ones((*rows, point_mass.N_AIR))
        unexplained_velocity(start, air, np.zeros((*rows, 2)))


def _run_telemetry() -> None:
    """Resample telemetry, hold an input, and score a prediction."""
    window = _synthetic_flight()
    positions = to_geodetic(_HOME, window.p).astype(float)
    history = TelemetryHistory()
    for name, rows in (("attitude", window.x[:, 3:]), ("velocity", window.v), ("position", positions)):
        history.replace_rows(name, window.t, rows)
    history.replace_rows("servo", window.t, np.full((len(window), 8), 1500.0))
    Resampler().window(history, _HOME, servo_map({}), np.zeros(3), until=float(window.t[-1]), seconds=10.0)
    zero_order_hold(window.t, window.v, window.t, 1.0)
    log = PredictionLog()
    log.add(0.0, "", "", np.outer(AHEAD, [_SPEED, 0.0, 0.0]), _SPEED)
    AdaptiveLevels().update(log, *log.evaluate(window.t, window.p), log.live)
    selector = MethodSelector()
    selector.add(float(window.t[0]), _SPEED, AHEAD, {"hybrid": np.outer(AHEAD, [_SPEED, 0.0, 0.0])})
    selector.score(window.t, window.p)


def _run_identification() -> None:
    """Identify, verify and compute the shrinkage sample, as the first identification holds an aircraft's lock."""
    for axis in AXES:
        identify_axis(axis, _synthetic_flight(), 2.0)
    window = _synthetic_flight(60.0)
    plant, n_train = identify(window, np.zeros(2), load(GENERIC)), len(window) // 2
    held_out = HeldOut(plant, window, n_train)
    with_diagnostics(verify(plant, window, n_train, 0.0, None), held_out)
    bias_corrected(plant, window)
    held_out.shrinkage_sample(20.0, 5.0)
    linearise(plant, window)
    wrap(np.zeros((2, 3))[:, 2])


_GROUPS = (  # each takes half of the time of all
    (_run_fixed_wings,),
    (_run_identification, _run_multirotors, _run_telemetry, _run_traffic),
)


def _synthetic_flight(seconds: float = 20.0, dt: float = 0.04) -> Window:
    """Return a synthetic flight due north with noise in every channel."""
    n = int(seconds / dt)
    rng = np.random.default_rng(0)
    t = dt * np.arange(n)
    x = 0.05 * rng.standard_normal((n, 9))
    x[:, 0] += _SPEED
    u = 0.05 * rng.standard_normal((n, 4))
    u[:, 3] += 0.5
    v = np.tile([_SPEED, 0.0, 0.0], (n, 1))
    return Window(t, x, u, v * t[:, None], v, np.ones(n, bool), np.zeros(n, bool))
