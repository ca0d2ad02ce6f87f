"""Prediction without a route: interacting multiple model (IMM) of straight flight, left and right turns.

Source: Bar-Shalom 2001, section 11.6 (IMM), 11.7 (coordinated turn); filterpy.kalman.IMMEstimator.
"""

from math import cos, sin

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter

from twin_worker.telemetry.track import STEP as TRACK_STEP
from twin_worker.telemetry.track import Track

STEP = 0.5  # filter step [s]
_FILTER_STEPS = 24  # past steps that the filter uses
_TURN_RATE = 0.3  # turn rate of the two turning models [rad/s]
_MAX_SPEED = 1e3  # faster rows are invalid [m/s]
# transition probabilities per step
_MODEL_TRANSITION = np.array([[0.97, 0.015, 0.015], [0.06, 0.93, 0.01], [0.06, 0.01, 0.93]])


def _transition(rate: float) -> np.ndarray:
    """Return the transition matrix of p_n, v_n, p_e, v_e at one turn rate [rad/s]."""
    if rate == 0.0:
        block = np.array([[1.0, STEP], [0.0, 1.0]])
        return np.kron(np.eye(2), block)
    s, c = sin(rate * STEP), cos(rate * STEP)
    return np.array(
        [
            [1, s / rate, 0, -(1 - c) / rate],
            [0, c, 0, -s],
            [0, (1 - c) / rate, 1, s / rate],
            [0, s, 0, c],
        ]
    )


def _filter(rate: float, noise: float, start: np.ndarray) -> KalmanFilter:
    filt = KalmanFilter(dim_x=4, dim_z=4)
    q = np.array([[STEP**4 / 4, STEP**3 / 2], [STEP**3 / 2, STEP**2]])
    filt.F, filt.H, filt.R = _transition(rate), np.eye(4), np.diag([0.5, 0.05, 0.5, 0.05])
    filt.Q, filt.x, filt.P = np.kron(np.eye(2), q) * noise, start.copy(), np.eye(4)
    return filt


def constant_turn_prediction(track: Track, ahead: np.ndarray) -> np.ndarray | None:
    """Predict from the end of a track, NED, (k, 3) [m]; None with fewer than four gap-free steps.

    A clock jump puts rows of two times on one grid; rows before the last jump are ignored.

    Args:
        track: newest flight
        ahead: requested look-ahead times, (k,) [s]
    """
    stride = round(STEP / TRACK_STEP)
    unbroken = track.unbroken_tail()
    rows = slice((len(unbroken) - 1) % stride, None, stride)
    p, v = _after_jump(unbroken.p[rows][-_FILTER_STEPS:], unbroken.v[rows][-_FILTER_STEPS:])
    return imm(p, v, ahead) if len(p) >= 4 else None


def _after_jump(p: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities, (n, 3), after the last implausible row; nan is implausible."""
    plausible = np.linalg.norm(v, axis=1) < _MAX_SPEED
    plausible[1:] &= np.linalg.norm(np.diff(p, axis=0), axis=1) < _MAX_SPEED * STEP
    jumps = np.flatnonzero(~plausible)
    first = int(jumps[-1]) if len(jumps) else 0
    # the row after a position jump is valid
    first += int(len(jumps) > 0 and not np.linalg.norm(v[first]) < _MAX_SPEED)
    return p[first:], v[first:]


def imm(p: np.ndarray, v: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Predict from recent positions and velocities.

    Args:
        p: recent positions every `STEP` seconds, NED, newest last, (n, 3) [m]
        v: recent velocities over ground, NED, (n, 3) [m/s]
        ahead: requested look-ahead times, (k,) [s]
    Returns:
        mean path, NED, (k, 3) [m]
    """
    rows = np.column_stack([p[:, 0], v[:, 0], p[:, 1], v[:, 1]])
    filters = [_filter(rate, noise, rows[0]) for rate, noise in ((0.0, 0.5), (_TURN_RATE, 1.0), (-_TURN_RATE, 1.0))]
    estimator = IMMEstimator(filters, np.array([0.8, 0.1, 0.1]), _MODEL_TRANSITION)
    for row in rows[1:]:
        estimator.predict()
        estimator.update(row)
    steps = int(np.ceil(ahead[-1] / STEP))
    track = _run_forward(estimator, steps)
    t = STEP * np.arange(steps + 1)
    climb = np.clip(v[-4:, 2].mean(), -8.0, 8.0) * 6.0 * (1 - np.exp(-ahead / 6.0))  # the climb decays
    return np.column_stack([np.interp(ahead, t, track[:, 0]), np.interp(ahead, t, track[:, 1]), p[-1, 2] + climb])


def _run_forward(estimator: IMMEstimator, steps: int) -> np.ndarray:
    """Propagate the mixed models without measurements; return the mean p_n, p_e, (steps + 1, 2) [m]."""
    mu = estimator.mu.copy()
    x = np.stack([filt.x for filt in estimator.filters])
    F = np.stack([filt.F for filt in estimator.filters])
    track = [mu @ x]
    for _ in range(steps):
        mixed = mu @ _MODEL_TRANSITION
        x = np.einsum("jab,jb->ja", F, (_MODEL_TRANSITION * mu[:, None]).T @ x / mixed[:, None])
        mu = mixed
        track.append(mu @ x)
    return np.array(track)[:, [0, 2]]
