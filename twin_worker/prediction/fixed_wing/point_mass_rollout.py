"""Rollout of the point-mass model from the present state of the aircraft."""

from math import asin
from typing import NamedTuple

import numpy as np

from fleet.frames import air_direction
from fleet.physics import point_mass as H
from fleet.window import Window
from twin_worker.estimation.wind_field import PathWind
from twin_worker.estimation.wind_filter import DRIFT_S, GUST, GUST_S
from twin_worker.identification.fixed_wing.point_mass_model import PointMassModel, airspeed_of
from twin_worker.prediction.closed_loop import InitialCondition, sample_rollout
from twin_worker.prediction.fixed_wing.path_wind import drift_draws, surer_field, with_drift, with_mean_wind
from twin_worker.prediction.replay_window import PredictionContext, Rollout
from twin_worker.telemetry.velocity import present_velocity

_AIRSPEED_ROWS = 8  # rows of 0.1 s in the mean airspeed at the start
_WINDOW_ROWS = 60  # rows of the window that they use
_GROUND_ROWS = 3  # rows of 0.04 s in the mean of the ground velocity
_MAX_PATH_SINE = 0.5  # largest sine of the path angle at the start [-]
_MIN_WIND_HEIGHT = 10.0  # minimum reference height of the wind profile [m]
_NO_NOISE = np.empty((0, 4))


def start_state(context: PredictionContext, window: Window, velocity: np.ndarray) -> np.ndarray:
    """Return the state at the end of the window, (N_START,), where the ground velocity is `velocity`, (3,) [m/s]."""
    V = _present_airspeed(context, window)
    out = np.empty(H.N_START)
    out[:3], out[H.V] = window.p[-1], V
    out[[H.PHI, H.THETA, H.PSI, H.P_RATE, H.Q_RATE]] = window.x[-1, [6, 7, 8, 3, 4]]
    climb = -float(velocity[2])
    out[H.GAMMA] = asin(float(np.clip(climb / max(V, 5.0), -_MAX_PATH_SINE, _MAX_PATH_SINE)))
    out[H.THROTTLE] = window.u[-1, 3]
    return out


def _present_airspeed(context: PredictionContext, window: Window) -> float:
    """Return the true airspeed at the end of the window: that by velocity and mean wind, plus the mean residual [m/s].

    V = |v(t_n) - w| + mean_k(Va_k - |v_k - w|): a mean of the readings alone lags an aircraft that accelerates.
    """
    window = window.part(max(len(window) - _WINDOW_ROWS, 0), len(window))
    t, airspeed = (rows[-_AIRSPEED_ROWS:] for rows in airspeed_of(window, context.history, context.wind_filter.scale))
    by_velocity = np.linalg.norm(window.x[:, :3], axis=1)
    return float(by_velocity[-_GROUND_ROWS:].mean() + (airspeed - np.interp(t, window.t, by_velocity)).mean())


def air_state(context: PredictionContext, start: np.ndarray) -> np.ndarray:
    """Return mean wind, drift and biases, (N_AIR,), without the unexplained ground velocity."""
    air = np.zeros(H.N_AIR)
    air[H.W_N : H.DRIFT_E + 1] = context.wind_filter.state[0][2:6]
    air[H.SCALE], air[H.D_PSI] = context.wind_filter.scale, context.wind_filter.heading_bias
    air[[H.DRIFT, H.DRIFT_S, H.REST, H.REST_S]] = context.wind_filter.drift_sigma, DRIFT_S, GUST, GUST_S
    home = next((item for item in context.onboard.items if item.seq == 0), None)
    if home is not None:
        air[H.GROUND] = context.origin.alt_mm * 1e-3 - home.alt_m
        height = air[H.GROUND] - start[2]
        air[H.H_0] = max(height, _MIN_WIND_HEIGHT) if height > 0 else 0.0
    return air


def unexplained_velocity(start: np.ndarray, air: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the ground velocity v (..., 2) minus airspeed and mean wind, NED [m/s].

    Args:
        start: (..., N_START)
        air: (..., N_AIR)
        v: north and east
    """
    phi, theta, psi, gamma = (start[..., k] for k in (H.PHI, H.THETA, H.PSI, H.GAMMA))
    level, course = start[..., H.V] * np.cos(gamma), air_direction(phi, theta, psi + air[..., H.D_PSI], gamma)
    along = np.stack([level * np.cos(course), level * np.sin(course)], axis=-1)
    return v - along - air[..., [H.W_N, H.W_E]] - air[..., [H.DRIFT_N, H.DRIFT_E]]


def ground_velocity(window: Window) -> np.ndarray:
    """Return the newest ground velocity, NED, (3,) [m/s]."""
    return present_velocity(window.p, window.v, window.dt, _GROUND_ROWS)


def start_and_air(context: PredictionContext, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Return state (N_START,) and air (N_AIR,) at the end of the window."""
    velocity = ground_velocity(window)
    start = start_state(context, window, velocity)
    air = air_state(context, start)
    air[[H.REST_N, H.REST_E]] = unexplained_velocity(start, air, velocity[:2])
    if context.onboard.override is not None and context.onboard.override.speed is not None:
        start[H.V] = context.onboard.override.speed
    return start, air


def model_ground_velocity(start: np.ndarray, air: np.ndarray) -> np.ndarray:
    """Return the ground velocity of a start state and its air, north and east, (2,) [m/s]."""
    return air[[H.REST_N, H.REST_E]] - unexplained_velocity(start, air, np.zeros(2))


class FieldStart(NamedTuple):
    """Start of rollouts, and the wind along their path.

    Attributes:
        state, air: as of `start_and_air`
        shared: as of `surer_field`
    """

    state: np.ndarray
    air: np.ndarray
    shared: tuple[PathWind, np.ndarray] | None


def start_in_field(
    context: PredictionContext, initial: InitialCondition, model: PointMassModel, span_s: float
) -> FieldStart:
    """Return the start of rollouts of `span_s` in the shared wind field where it is surer than the own wind."""
    state, air = start_and_air(context, initial.window)
    return FieldStart(state, air, surer_field(context, initial, model, (state, air), span_s))


def in_field_wind(initial: InitialCondition, start: FieldStart) -> InitialCondition:
    """Return the start of `fly_from` in the wind of `start`, which reaches at least `FIELD_SPAN_S`."""
    return initial if start.shared is None else with_mean_wind(initial, start.shared[0])


def fly_point_mass(
    context: PredictionContext,
    initial: InitialCondition,
    model: PointMassModel,
    ahead: np.ndarray,
    start: FieldStart | None = None,
) -> Rollout:
    """Simulate the identified point-mass model; the path is nan beyond its envelope.

    Args:
        context, initial: inputs of the prediction and start of the rollout
        model: identified model
        ahead: requested look-ahead times, rising, (k,) [s]
        start: result of `start_in_field` for at least this span; None: computed here
    """
    ctl, par, legs = initial.synchronised
    state, air, shared = start or start_in_field(context, initial, model, float(ahead[-1]))
    out, draws = np.empty((int(ahead[-1] / H.STEP) + 2, 3)), _NO_NOISE
    if shared is not None:
        wind, drift = shared
        air = with_drift(air, drift[0])
        draws = np.zeros((int(ahead[-1]) + 2, 4))
        draws[:, :2] = drift_draws(wind, drift, air, len(draws))
    ctl = ctl.copy()
    n_rows = H.simulate_route(ctl, par, legs, model.parameters, air, state, draws, H.STEP, out)
    return sample_rollout(out[:n_rows], H.STEP, initial, ctl, ahead)
