"""Flights by the twin's own coupled dynamics under a plain autopilot: every parameter is known."""

from dataclasses import replace

import numpy as np

from fleet.airframes import GENERIC, load
from fleet.frames import body_to_ned, ned_to_body
from fleet.physics.dynamics import step
from fleet.physics.simulate import TAU
from fleet.physics.wrench import NAMES, OFFSETS, WIND
from fleet.window import Window
from tests.support.flights import DT, T0
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel, prior

V, W0 = 20.0, 1.0  # trim, forward and down the body [m/s]
AT = np.array([V, W0])
TRIM = np.array([0.0, 0.0, 0.0, 0.5])
NOISE = np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01, 0.005, 0.005, 0.005])  # of the measured states
SMALL = load(GENERIC)
_TRIMMED = (*OFFSETS, *(NAMES.index(name) for name in ("X_de", "X_dt", "M_dt")))  # level flight hangs on these


def aircraft(seed: int = 0, *, wind: tuple[float, float] = (3.0, -2.0), blur: float = 0.2) -> np.ndarray:
    """Parameters of a small aircraft whose derivatives are off its class's by a share, in level trim, (37,)."""
    par, _ = prior(SMALL, AT, TRIM, np.array(wind))
    by = 1.0 + blur * np.random.default_rng(seed).standard_normal(len(par))
    by[[*_TRIMMED, WIND, WIND + 1]] = 1.0
    return par * by


def level(par: np.ndarray, psi: float = 0.4) -> np.ndarray:
    """The state of level trim at a heading, u v w over the ground, (9,)."""
    theta = np.arctan2(W0, V)
    x = np.array([V, 0.0, W0, 0.0, 0.0, 0.0, 0.0, theta, psi])
    blow = np.array([[*par[WIND:], 0.0]])
    x[:3] += ned_to_body(*(np.array([angle]) for angle in x[6:]), blow)[0]
    return x


def fly(
    par: np.ndarray, seconds: float, *, seed: int = 0, noise: float = 1.0, lively: float = 1.0, dt: float = DT
) -> Window:
    """Fly random attitudes and speeds; without noise the coupled model's free run is the flight."""
    rng = np.random.default_rng(seed)
    n = round(seconds / dt) + 1
    now, acting, share, work = level(par), None, 1.0 - np.exp(-dt / TAU), np.empty((3, 9))
    y, u, ask = np.empty((n, 9)), np.empty((n, 4)), np.zeros(4)
    for k in range(n):
        if k % round(1.6 / dt) == 0:
            ask = lively * rng.standard_normal(4) * [0.4, 0.08, 0.1, 0.15]
        y[k] = now
        p, q, phi, theta = now[3], now[4], now[6], now[7]
        u[k] = [0.5 * (ask[0] - phi) - 0.05 * p, 0.8 * (ask[1] + W0 / V - theta) - 0.1 * q, ask[2], 0.5 + ask[3]]
        u[k] = np.clip(u[k], [-1, -1, -1, 0], 1)
        acting = u[k].copy() if acting is None else acting
        change = share * (u[k] - acting)
        step(now, acting + 0.5 * change, par, AT, dt, work)
        acting += change
    y += noise * NOISE * rng.standard_normal(y.shape)
    return window_of(y, u, par, dt)


def window_of(y: np.ndarray, u: np.ndarray, par: np.ndarray, dt: float = DT) -> Window:
    """Lay states over the ground and inputs in a window, as telemetry with a known wind would."""
    n = len(y)
    v = body_to_ned(y[:, 6], y[:, 7], y[:, 8], y[:, :3])
    x = y.copy()
    x[:, :3] = ned_to_body(y[:, 6], y[:, 7], y[:, 8], v - [*par[WIND:], 0.0])
    return Window(T0 + dt * np.arange(n), x, u, np.cumsum(v * dt, axis=0), v, np.ones(n, bool), np.zeros(n, bool))


def broken(window: Window, *holes: tuple[float, float]) -> Window:
    """The window with stretches, in seconds from its start, that nobody measured."""
    s = window.t - window.t[0]
    gone = np.logical_or.reduce([(s >= a) & (s < b) for a, b in holes])
    x = np.where(gone[:, None], 1e3, window.x)
    return replace(window, x=x, ok=window.ok & ~gone)


def known(par: np.ndarray, t0: float = T0, t1: float = T0 + 20.0) -> DerivativesModel:
    """A coupled model of these very parameters."""
    mean, sigma = prior(SMALL, AT, TRIM, par[WIND:])
    precision = np.diag(sigma**-2.0)
    return DerivativesModel(par, AT, np.zeros((37, 37)), mean, precision, 1 / NOISE**2, (mean, precision), t0, t1, 0)
