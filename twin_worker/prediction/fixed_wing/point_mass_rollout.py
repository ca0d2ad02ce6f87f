"""Rollout of the point-mass model from the present state of the aircraft."""

from math import asin

import numpy as np

from fleet.physics import point_mass as H
from fleet.window import Window
from twin_worker.estimation.wind_filter import DRIFT, DRIFT_S, GUST, GUST_S
from twin_worker.identification.fixed_wing.point_mass_model import Hybrid, airspeed_of
from twin_worker.prediction.closed_loop import Flown, Situation, Start, at_times

_SPEED_ROWS = 8  # rows of 0.1 s in the mean airspeed at the start
_LOOK_ROWS = 60  # rows of the window that they use
_GROUND_ROWS, _CLIMB_ROWS = 3, 12  # rows of 0.04 s in the means of ground velocity and climb
_STEEPEST = 0.5  # largest sine of the path angle at the start [-]
_NEAREST = 10.0  # minimum reference height of the wind profile [m]
_NO_CHANCE = np.empty((0, 4))


def start_of(now: Situation, good: Window) -> np.ndarray:
    """Return the state at the end of the window, (N_START,)."""
    _, airspeed = airspeed_of(good.part(max(len(good) - _LOOK_ROWS, 0), len(good)), now.history, now.wind.scale)
    V = float(airspeed[-_SPEED_ROWS:].mean())
    out = np.empty(H.N_START)
    out[:3], out[H.V] = good.p[-1], V
    out[[H.PHI, H.THETA, H.PSI, H.P_RATE, H.Q_RATE]] = good.x[-1, [6, 7, 8, 3, 4]]
    climb = -float(good.v[-_CLIMB_ROWS:, 2].mean())
    out[H.GAMMA] = asin(float(np.clip(climb / max(V, 5.0), -_STEEPEST, _STEEPEST)))
    out[H.THR] = good.u[-1, 3]
    return out


def air_of(now: Situation, start: np.ndarray) -> np.ndarray:
    """Return mean wind, drift and biases, (N_AIR,), without the unexplained ground velocity."""
    air = np.zeros(H.N_AIR)
    air[H.W_N : H.DRIFT_E + 1] = now.wind.state[0][2:6]
    air[H.SCALE], air[H.D_PSI] = now.wind.scale, now.wind.heading_bias
    air[[H.DRIFT, H.DRIFT_S, H.REST, H.REST_S]] = DRIFT, DRIFT_S, GUST, GUST_S
    home = next((item for item in now.onboard.items if item.seq == 0), None)
    if home is not None:
        air[H.GROUND] = now.origin.alt_mm * 1e-3 - home.alt_m
        height = air[H.GROUND] - start[2]
        air[H.H_0] = max(height, _NEAREST) if height > 0 else 0.0
    return air


def rest(start: np.ndarray, air: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the ground velocity v (..., 2) minus airspeed and mean wind, NED [m/s].

    Args:
        start: (..., N_START)
        air: (..., N_AIR)
        v: north and east
    """
    level, course = start[..., H.V] * np.cos(start[..., H.GAMMA]), start[..., H.PSI] + air[..., H.D_PSI]
    along = np.stack([level * np.cos(course), level * np.sin(course)], axis=-1)
    return v - along - air[..., [H.W_N, H.W_E]] - air[..., [H.DRIFT_N, H.DRIFT_E]]


def ground_velocity(good: Window) -> np.ndarray:
    """Return the newest ground velocity, north and east, (2,) [m/s]."""
    return good.v[-_GROUND_ROWS:, :2].mean(axis=0)


def begin(now: Situation, good: Window) -> tuple[np.ndarray, np.ndarray]:
    """Return state (N_START,) and air (N_AIR,) at the end of the window."""
    start = start_of(now, good)
    air = air_of(now, start)
    air[[H.REST_N, H.REST_E]] = rest(start, air, ground_velocity(good))
    if now.onboard.instead is not None and now.onboard.instead.speed is not None:
        start[H.V] = now.onboard.instead.speed
    return start, air


def over_ground(start: np.ndarray, air: np.ndarray) -> np.ndarray:
    """Return the ground velocity of a start state and its air, north and east, (2,) [m/s]."""
    return air[[H.REST_N, H.REST_E]] - rest(start, air, np.zeros(2))


def fly_hybrid(now: Situation, start: Start, found: Hybrid, ahead: np.ndarray) -> Flown:
    """Simulate the identified point-mass model; the path is nan beyond its envelope.

    Args:
        context, initial: inputs of the prediction and start of the rollout
        model: identified model
        ahead: requested look-ahead times, rising, (k,) [s]
    """
    ctl, par, legs = start.control
    state, air = begin(now, start.good)
    out = np.empty((int(ahead[-1] / H.STEP) + 2, 3))
    ctl = ctl.copy()
    done = H.fly(ctl, par, legs, found.body, air, state, _NO_CHANCE, H.STEP, out)
    return at_times(out[:done], H.STEP, start, ctl, ahead)
