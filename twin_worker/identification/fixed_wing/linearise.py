"""Linearise the derivatives model about the trim of a window: A B, longitudinal and lateral, C = I, D = 0.

Source: Huang 2021, eq. 2-4; Beard & McLain 2012, section 5.5.
"""

import numpy as np
import scipy.linalg

from fleet.contract import Array, LinearModel
from fleet.frames import ned_to_body
from fleet.physics.dynamics import jacobian, rates_of_change
from fleet.physics.wrench import N_AERO, WIND
from fleet.window import INPUTS, STATES, Window
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel

_AXES = (
    (("u", "w", "q", "theta"), ("delta_e", "delta_t")),
    (("phi", "psi", "p", "r", "v"), ("delta_a", "delta_r")),
)
_ZERO_AT_TRIM = ("p", "q", "r", "v", "phi")  # zero at the trim point
_INPUT_STEP = 1e-4  # step of the input derivatives, in which the model is linear [-]


def linearise(plant: DerivativesModel, window: Window) -> tuple[LinearModel, LinearModel]:
    """Return discrete matrices at the sample time of the window; u v w are through the air, on any heading.

    Args:
        plant: the derivatives model
        window: flight data; mean speed, attitude and inputs are the trim point
    """
    ok, dt = window.ok, window.dt
    x, u = window.x[ok].mean(axis=0), window.u[ok].mean(axis=0)
    wind = np.array([*plant.par[WIND:], 0.0])
    phi, theta, psi = window.x[ok, 6:].T
    x[:3] = ned_to_body(phi, theta, psi, window.v[ok] - wind).mean(axis=0)
    x[[STATES.index(name) for name in _ZERO_AT_TRIM]] = 0.0
    windless = plant.par.copy()
    windless[WIND:] = 0.0
    F, by_wind, term = np.empty((9, 9)), np.empty((9, 2)), np.empty(N_AERO)
    jacobian(x, u, windless, plant.trim_velocity, F, by_wind, term)
    rate, perturbed = np.empty(9), np.empty(9)
    rates_of_change(x, u, windless, plant.trim_velocity, rate)
    G = np.empty((9, 4))
    for k in range(4):
        rates_of_change(x, u + _INPUT_STEP * np.eye(4)[k], windless, plant.trim_velocity, perturbed)
        G[:, k] = (perturbed - rate) / _INPUT_STEP
    lon, lat = (_axis(np.hstack([F, G, rate[:, None]]), x, u, axis, dt) for axis in _AXES)
    return lon, lat


def _axis(slopes: np.ndarray, x: np.ndarray, u: np.ndarray, axis: tuple, dt: float) -> LinearModel:
    """Extract one axis from [F G x'] and discretise it, exp([[A B c] [0 0 0]] dt); c moves into the trim."""
    names, inputs = axis
    rows, columns = [STATES.index(name) for name in names], [INPUTS.index(name) for name in inputs]
    n, m = len(rows), len(columns)
    augmented = np.zeros((n + m + 1, n + m + 1))
    augmented[:n] = slopes[np.ix_(rows, [*rows, *(len(x) + k for k in columns), -1])]
    A, B, c = np.split(scipy.linalg.expm(augmented * dt)[:n], (n, n + m), axis=1)
    shift = np.linalg.lstsq(np.eye(n) - A, c[:, 0], rcond=1e-3)[0]
    return LinearModel(
        states=names,
        inputs=inputs,
        A=Array.of(A),
        B=Array.of(B),
        C=Array.of(np.eye(n)),
        D=Array.of(np.zeros((n, m))),
        x_trim=Array.of(x[rows] + shift),
        u_trim=Array.of(u[columns]),
        dt_s=dt,
    )
