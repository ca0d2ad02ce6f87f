"""Residuals of free runs and their sensitivities over one window, segment by segment.

    S' = F S + d x' / d par,  S = d x / d(par, x0):  F is constant over a group of samples,
    S <- Phi S + Gamma d x' / d par,  Phi = exp(F h),  Gamma = integral of Phi

There is one residual per group, because gusts correlate neighbouring residuals.

Source: Jategaonkar 2015, section 4.6 (output error, sensitivity equations); exact for constant F.
"""

import numpy as np

from fleet.physics.dynamics import N_X, is_diverged, jacobian, step
from fleet.physics.kernel import kernel, no_alloc_kernel
from fleet.physics.wrench import N_AERO, N_PAR, ROW, WIND

GROUP = 4  # samples per residual; 2 ** _DOUBLINGS
_DOUBLINGS = 2
N_COLUMN = N_PAR + N_X


@no_alloc_kernel
def _matmul(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Compute a b, (9, n), of a (9, 9) and b (9, n); named elements of a row stay in registers, indexed ones do not."""
    for i in range(N_X):
        a0, a1, a2, a3, a4, a5, a6, a7, a8 = a[i]
        for j in range(b.shape[1]):
            low = a0 * b[0, j] + a1 * b[1, j] + a2 * b[2, j] + a3 * b[3, j]
            out[i, j] = low + a4 * b[4, j] + a5 * b[5, j] + a6 * b[6, j] + a7 * b[7, j] + a8 * b[8, j]


@kernel
def _transition(F: np.ndarray, dt: float, Phi: np.ndarray, Gamma: np.ndarray, work: np.ndarray) -> None:
    """Compute Phi = exp(F GROUP dt) and its integral: fourth-order Runge-Kutta over one sample, then doubling.

    Phi = I + F Gamma must be exact, otherwise the equilibrium S = -F^-1 G would drift.
    """
    square, cube, scratch = work[0], work[1], work[2]
    _matmul(F, F, square)
    _matmul(F, square, cube)
    for i in range(N_X):
        for j in range(N_X):
            Gamma[i, j] = dt**2 / 2 * F[i, j] + dt**3 / 6 * square[i, j] + dt**4 / 24 * cube[i, j]
        Gamma[i, i] += dt
    for doubling in range(_DOUBLINGS + 1):
        if doubling:
            _matmul(Phi, Gamma, scratch)
            Gamma += scratch
        _matmul(F, Gamma, Phi)
        for i in range(N_X):
            Phi[i, i] += 1.0


@no_alloc_kernel
def _propagate(
    S: np.ndarray, Phi: np.ndarray, Gamma: np.ndarray, term: np.ndarray, by_wind: np.ndarray, out: np.ndarray
) -> None:
    """Compute the sensitivities one group later."""
    _matmul(Phi, S, out)
    for i in range(N_X):
        for a in range(N_AERO):
            out[i, a] += Gamma[i, ROW[a]] * term[a]
        for k in range(6):
            out[i, WIND] += Gamma[i, k] * by_wind[k, 0]
            out[i, WIND + 1] += Gamma[i, k] * by_wind[k, 1]


@kernel
def residuals_and_jacobian(
    par: np.ndarray,
    starts: np.ndarray,
    segments: np.ndarray,
    y: np.ndarray,
    delta: np.ndarray,
    trim_velocity: np.ndarray,
    dt: float,
    weight: np.ndarray,
    e: np.ndarray,
    J: np.ndarray,
) -> float:
    """Simulate every segment; store residuals e = (y - y_hat) weight and, if J has rows, their sensitivities.

    Args:
        par: parameters, (37,)
        starts: start state of each segment, (m, 9)
        segments: first and last row of each, an integer number of groups apart, (m, 2)
        y: measured states, (n, 9)
        delta: actuator states, (n, 4)
        trim_velocity: U0, W0, (2,) [m/s]
        dt: sample time [s]
        weight: square roots of the weights, (9,)
        e: output, residuals by group, (groups, 9)
        J: output, d y_hat / d(par, x0) weight, (groups, 9, 46), or no rows
    Returns:
        the sum of squares; inf if a segment leaves the envelope
    """
    x, half = np.empty(N_X), np.empty(N_X)
    work, matrices = np.empty((3, N_X)), np.empty((5, N_X, N_X))
    F, Phi, Gamma, by_wind = np.empty((N_X, N_X)), matrices[3], matrices[4], np.empty((N_X, 2))
    mean = np.empty(4)
    S, S_next, term = np.empty((N_X, N_COLUMN)), np.empty((N_X, N_COLUMN)), np.empty(N_AERO)
    cost, row = 0.0, 0
    for m in range(len(segments)):
        x[:] = starts[m]
        S[:] = 0.0
        for i in range(N_X):
            S[i, N_PAR + i] = 1.0
        for k in range(segments[m, 0], segments[m, 1], GROUP):
            for i in range(N_X):
                e[row, i] = (y[k, i] - x[i]) * weight[i]
                cost += e[row, i] ** 2
                if len(J):
                    for a in range(N_COLUMN):
                        J[row, i, a] = S[i, a] * weight[i]
            row += 1
            for j in range(GROUP):
                if 2 * j == GROUP:
                    half[:] = x
                step(x, delta[k + j], par, trim_velocity, dt, work)
            if is_diverged(x):
                return np.inf
            if len(J):
                for i in range(4):
                    mean[i] = delta[k : k + GROUP, i].mean()
                jacobian(half, mean, par, trim_velocity, F, by_wind, term)
                _transition(F, dt, Phi, Gamma, matrices)
                _propagate(S, Phi, Gamma, term, by_wind, S_next)
                S, S_next = S_next, S
    return cost
