"""The coupled model as the paper's matrices: A B about the trim of a window, longitudinal and lateral, C = I, D = 0.

Source: Huang 2021, eq. 2-4; Beard & McLain 2012, section 5.5.
"""

import numpy as np
import scipy.linalg

from fleet.contract import Array, Linear
from fleet.physics.dynamics import jacobian, rates_of_change
from fleet.physics.wrench import N_AERO
from fleet.window import INPUTS, STATES, Window
from twin_worker.coupled import Coupled, states

_AXES = (
    (("u", "w", "q", "theta"), ("delta_e", "delta_t")),
    (("phi", "psi", "p", "r", "v"), ("delta_a", "delta_r")),
)
_STILL = ("p", "q", "r", "v", "phi")  # zero at the trim point
_H = 1e-4  # step of the input derivatives, in which the model is linear [-]


def linearise(plant: Coupled, window: Window) -> tuple[Linear, Linear]:
    """Export the paper's matrices, discrete at the window's sample time; u v w are over the ground.

    Args:
        plant: the coupled model
        window: flight whose mean speed, attitude and inputs are the trim point
    """
    y, dt = states(window)[window.ok], window.dt
    x, u = y.mean(axis=0), window.u[window.ok].mean(axis=0)
    x[[STATES.index(name) for name in _STILL]] = 0.0
    F, by_wind, term = np.empty((9, 9)), np.empty((9, 2)), np.empty(N_AERO)
    jacobian(x, u, plant.par, plant.at, F, by_wind, term)
    rate, moved = np.empty(9), np.empty(9)
    rates_of_change(x, u, plant.par, plant.at, rate)
    G = np.empty((9, 4))
    for k in range(4):
        rates_of_change(x, u + _H * np.eye(4)[k], plant.par, plant.at, moved)
        G[:, k] = (moved - rate) / _H
    lon, lat = (_axis(np.hstack([F, G]), x, u, axis, dt) for axis in _AXES)
    return lon, lat


def _axis(FG: np.ndarray, x: np.ndarray, u: np.ndarray, axis: tuple, dt: float) -> Linear:
    """Cut one axis out and make it discrete: exp([[A B] [0 0]] dt)."""
    names, inputs = axis
    rows, columns = [STATES.index(name) for name in names], [INPUTS.index(name) for name in inputs]
    n, m = len(rows), len(columns)
    whole = np.zeros((n + m, n + m))
    whole[:n] = FG[np.ix_(rows, [*rows, *(len(x) + k for k in columns)])]
    discrete = scipy.linalg.expm(whole * dt)[:n]
    return Linear(
        states=names,
        inputs=inputs,
        A=Array.of(discrete[:, :n]),
        B=Array.of(discrete[:, n:]),
        C=Array.of(np.eye(n)),
        D=Array.of(np.zeros((n, m))),
        x_trim=Array.of(x[rows]),
        u_trim=Array.of(u[columns]),
        dt_s=dt,
    )
