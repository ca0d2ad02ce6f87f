"""Prediction from the turn rate: three interacting models of straight flight and of turns to either side.

Source: Bar-Shalom 2001, 11.6.6 (interacting multiple models, moments of the mixture).
"""

import sys
from math import cos, exp, log, pi, sin

import numpy as np

from fleet.physics.kernel import no_alloc_kernel
from twin_worker.numerics.interpolation import interpolate_rows
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


_N, _N_MODELS = 4, 3  # number of states, and of models: straight on, and a turn to either side
_TRANSITIONS = np.stack([_transition(rate) for rate in (0.0, _TURN_RATE, -_TURN_RATE)])
_STEP_NOISE = np.array([[STEP**4 / 4, STEP**3 / 2], [STEP**3 / 2, STEP**2]])
_PROCESS_NOISE = np.stack([np.kron(np.eye(2), noise * _STEP_NOISE) for noise in (0.5, 1.0, 1.0)])
_MEASUREMENT_NOISE = np.array([0.5, 0.05, 0.5, 0.05])  # variances [m2, m2/s2]
_START_PROBABILITY = np.array([0.8, 0.1, 0.1])  # of each model [-]
_MODELS = _TRANSITIONS, _PROCESS_NOISE  # F and Q of each model
_MIN_LIKELIHOOD = sys.float_info.min  # of an innovation, so that one model remains


@no_alloc_kernel
def _predict_mixed(
    models: tuple[np.ndarray, np.ndarray],
    x: np.ndarray,
    P: np.ndarray,
    mu: np.ndarray,
    new_x: np.ndarray,
    work: np.ndarray,
) -> None:
    """Mix the models by their transition probabilities, and propagate each by one step, in place.

    Args:
        models: F and Q of each model, (3, 4, 4)
        x, P: mean and covariance of each model, (3, 4) and (3, 4, 4)
        mu: probability of each model, (3,)
        new_x, work: overwritten, (3, 4) and (5, 4, 4)
    """
    F, Q = models
    for j in range(_N_MODELS):
        mixed = 0.0
        for i in range(_N_MODELS):
            mixed += _MODEL_TRANSITION[i, j] * mu[i]
        start = work[4, 0]
        for a in range(_N):
            start[a] = 0.0
            for i in range(_N_MODELS):
                start[a] += _MODEL_TRANSITION[i, j] * mu[i] / mixed * x[i, a]
        for a in range(_N):
            new_x[j, a] = 0.0
            for b in range(_N):
                new_x[j, a] += F[j, a, b] * start[b]
                work[3, a, b] = 0.0
                for i in range(_N_MODELS):
                    share = _MODEL_TRANSITION[i, j] * mu[i] / mixed
                    work[3, a, b] += share * (P[i, a, b] + (x[i, a] - start[a]) * (x[i, b] - start[b]))
        _propagate(F[j], work[3], Q[j], work[4], work[j])
    for j in range(_N_MODELS):
        work[4, 1, j] = 0.0
        for i in range(_N_MODELS):
            work[4, 1, j] += _MODEL_TRANSITION[i, j] * mu[i]
    for j in range(_N_MODELS):
        mu[j] = work[4, 1, j]
        for a in range(_N):
            x[j, a] = new_x[j, a]
            for b in range(_N):
                P[j, a, b] = work[j, a, b]


@no_alloc_kernel
def _propagate(F: np.ndarray, P: np.ndarray, Q: np.ndarray, scratch: np.ndarray, out: np.ndarray) -> None:
    """Compute F P F' + Q, (4, 4)."""
    for a in range(_N):
        for b in range(_N):
            scratch[a, b] = 0.0
            for c in range(_N):
                scratch[a, b] += F[a, c] * P[c, b]
    for a in range(_N):
        for b in range(_N):
            out[a, b] = Q[a, b]
            for c in range(_N):
                out[a, b] += scratch[a, c] * F[b, c]


@no_alloc_kernel
def _update(z: np.ndarray, x: np.ndarray, P: np.ndarray, work: np.ndarray) -> float:
    """Update one model, (4,) and (4, 4), with a measured state z, in place; return the likelihood of the innovation.

    S = P + R, K = P S^-1, P = (I - K) P (I - K)' + K R K'
    """
    inverse, K, rest, error = work[0], work[1], work[2], work[4, 0]
    det = 1.0
    for a in range(_N):
        error[a] = z[a] - x[a]
        for b in range(_N):
            inverse[a, b] = P[a, b]
        inverse[a, a] += _MEASUREMENT_NOISE[a]
    for k in range(_N):  # Gauss-Jordan: S is symmetric and positive definite
        pivot = inverse[k, k]
        det *= 2.0 * pi * pivot
        inverse[k, k] = 1.0
        for b in range(_N):
            inverse[k, b] /= pivot
        for a in range(_N):
            if a != k:
                factor = inverse[a, k]
                inverse[a, k] = 0.0
                for b in range(_N):
                    inverse[a, b] -= factor * inverse[k, b]
    distance = 0.0
    for a in range(_N):
        for b in range(_N):
            distance += error[a] * inverse[a, b] * error[b]
            K[a, b] = 0.0
            for c in range(_N):
                K[a, b] += P[a, c] * inverse[c, b]
            rest[a, b] = -K[a, b]
        rest[a, a] += 1.0
    for a in range(_N):
        for b in range(_N):
            x[a] += K[a, b] * error[b]
            inverse[a, b] = 0.0
            for c in range(_N):
                inverse[a, b] += K[a, c] * _MEASUREMENT_NOISE[c] * K[b, c]
    _propagate(rest, P, inverse, work[3], work[4])
    for a in range(_N):
        for b in range(_N):
            P[a, b] = work[4, a, b]
    return max(exp(-0.5 * (log(det) + distance)), _MIN_LIKELIHOOD)


@no_alloc_kernel
def _filter_and_run(
    rows: np.ndarray,
    models: tuple[np.ndarray, np.ndarray],
    x: np.ndarray,
    P: np.ndarray,
    mu: np.ndarray,
    new_x: np.ndarray,
    work: np.ndarray,
    out: np.ndarray,
) -> None:
    """Filter past rows by three interacting models, and run on without measurements.

    The same operations as `filterpy.kalman.IMMEstimator`, which takes 50 times as long.

    Args:
        rows: measured p_n, v_n, p_e, v_e every `STEP`, (n, 4)
        models: as for `_predict_mixed`
        x, P, mu, new_x, work: overwritten, as for `_predict_mixed`
        out: mean p_n and p_e of the mixture after each step, and the variance of p_n plus that of p_e, (steps, 3)
    """
    for j in range(_N_MODELS):
        mu[j] = _START_PROBABILITY[j]
        for a in range(_N):
            x[j, a] = rows[0, a]
            for b in range(_N):
                P[j, a, b] = 1.0 if a == b else 0.0
    for k in range(1, len(rows)):
        _predict_mixed(models, x, P, mu, new_x, work)
        total = 0.0
        for j in range(_N_MODELS):
            mu[j] *= _update(rows[k], x[j], P[j], work)
            total += mu[j]
        for j in range(_N_MODELS):
            mu[j] /= total
    for k in range(len(out)):
        if k > 0:
            _predict_mixed(models, x, P, mu, new_x, work)
        out[k, 2] = 0.0
        for i in range(2):
            a = 2 * i
            mean, square = 0.0, 0.0
            for j in range(_N_MODELS):
                mean += mu[j] * x[j, a]
            for j in range(_N_MODELS):
                square += mu[j] * ((x[j, a] - mean) ** 2 + P[j, a, a])
            out[k, i] = mean
            out[k, 2] += square


def constant_turn_prediction(track: Track, ahead: np.ndarray) -> np.ndarray | None:
    """Predict from the end of a track, NED, (k, 3) [m]; None with fewer than four gap-free steps.

    Args:
        track: newest flight
        ahead: requested look-ahead times, (k,) [s]
    """
    p, v = recent_rows(track)
    return imm(p, v, ahead) if len(p) >= 4 else None


def recent_rows(track: Track) -> tuple[np.ndarray, np.ndarray]:
    """Return the newest positions and velocities every `STEP` without a gap, NED, (n, 3) [m, m/s].

    A clock jump puts rows of two times on one grid; rows before the last jump are ignored.
    """
    stride = round(STEP / TRACK_STEP)
    unbroken = track.unbroken_tail()
    rows = slice((len(unbroken) - 1) % stride, None, stride)
    return _after_jump(unbroken.p[rows][-_FILTER_STEPS:], unbroken.v[rows][-_FILTER_STEPS:])


def turn_models() -> tuple[np.ndarray, np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the parameters of the filter: transition and start probabilities, R, and F and Q of each model."""
    models = list(zip(_TRANSITIONS, _PROCESS_NOISE, strict=True))
    return _MODEL_TRANSITION, _START_PROBABILITY, np.diag(_MEASUREMENT_NOISE), models


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
    return imm_with_variance(p, v, ahead)[0]


def imm_with_variance(p: np.ndarray, v: np.ndarray, ahead: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the path of `imm` and the variance of its horizontal position, north plus east, (k,) [m2]."""
    rows = np.column_stack([p[:, 0], v[:, 0], p[:, 1], v[:, 1]])
    x, P, new_x = (np.empty((_N_MODELS, *shape)) for shape in ((_N,), (_N, _N), (_N,)))
    moments = np.empty((int(np.ceil(ahead[-1] / STEP)) + 1, 3))
    _filter_and_run(rows, _MODELS, x, P, np.empty(_N_MODELS), new_x, np.empty((_N_MODELS + 2, _N, _N)), moments)
    v_d = v[-4:, 2].mean()
    climb = np.clip(v_d, -8.0, 8.0) * 6.0 * (1 - np.exp(-ahead / 6.0))  # the climb decays
    p_n, p_e, variance = interpolate_rows(ahead, STEP * np.arange(len(moments)), moments).T
    return np.column_stack([p_n, p_e, p[-1, 2] + climb]), variance
