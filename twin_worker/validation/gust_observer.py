"""Alpha-beta filter of state and gust, which provides the start of a free run.

Gusts are decaying accelerations d in u v w p q r in addition to the model. They explain the next step and decay
within a forecast, so that the derivatives do not include them.

    x' = f(x, delta) + d,   d' = -d / TAU,   e = y - x_hat,   x_hat += alpha e,   d_hat += beta e / dt

Source: Bar-Shalom 2001, section 6.5 (alpha-beta filter); Jategaonkar 2015, chapter 5 (filter error method).
"""

from dataclasses import dataclass

import numpy as np

from fleet.physics.dynamics import N_X, lost, step
from fleet.physics.kernel import kernel
from fleet.physics.wrench import OFFSETS
from twin_worker.identification.fixed_wing.derivatives_model import Coupled

TAU = np.array([0.3, 0.3, 0.3, 0.1, 0.1, 0.1])  # decay time of gusts in u v w p q r [s]
_ALPHA = np.array([0.8, 0.8, 0.8, 1.0, 1.0, 1.0, 0.9, 0.9, 0.9])  # u v w over the ground, p q r, angles
_BETA = np.array([0.08, 0.08, 0.08, 0.25, 0.25, 0.25, 0.0, 0.0, 0.0])
_DRIVEN = (0, 2, 4, 1, 3, 5)  # state that each offset drives, in the order of `OFFSETS`
_OFFSET = np.array([OFFSETS[_DRIVEN.index(k)] for k in range(6)])  # the inverse map


@dataclass(frozen=True)
class Observer:
    """Filter for one model at a sample time dt [s]."""

    model: Coupled
    dt: float

    @property
    def left(self) -> np.ndarray:
        """Return the decay factor of each gust over one sample, (6,) [-]."""
        return np.exp(-self.dt / TAU)

    def track(self, y: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Filter a segment: states and gusts at every row, from the rows up to it, (n, 15).

        Args:
            y: measured states, u v w over the ground, (n, 9)
            delta: actuator states, (n, 4)
        """
        out = np.empty((len(y), N_X + 6))
        _track(y, delta, self.model.par, self.model.at, self.dt, self.left, out, np.empty_like(y))
        return out

    def foretell(self, y: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Predict every row from the rows before it, (n, 9); the first is measured. Arguments as for `filter`."""
        foretold = np.empty_like(y)
        _track(y, delta, self.model.par, self.model.at, self.dt, self.left, np.empty((len(y), N_X + 6)), foretold)
        return foretold

    def fly(self, tracked: np.ndarray, begins: np.ndarray, length: int, delta: np.ndarray) -> np.ndarray:
        """Simulate from filtered rows, (m, 15), at `start_rows`, (m,), with decaying gusts; return (m, length, 9)."""
        out = np.empty((len(begins), length, N_X))
        _fly(tracked, begins, delta, self.model.par, self.model.at, self.dt, self.left, out)
        return out


@kernel
def _track(
    y: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    at: np.ndarray,
    dt: float,
    left: np.ndarray,
    out: np.ndarray,
    foretold: np.ndarray,
) -> None:
    x, d, blown, work = y[0].copy(), np.zeros(6), par.copy(), np.empty((3, N_X))
    for k in range(len(y)):
        for i in range(N_X):
            foretold[k, i] = x[i]
            e = y[k, i] - x[i]
            x[i] += _ALPHA[i] * e
            if i < 6:
                d[i] += _BETA[i] * e / dt
        if lost(x):
            x[:] = y[k]
            d[:] = 0.0
        for i in range(N_X):
            out[k, i] = x[i]
        for i in range(6):
            out[k, N_X + i] = d[i]
        _blow(x, d, delta[k], par, at, dt, left, blown, work)


@kernel
def _blow(
    x: np.ndarray,
    d: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    at: np.ndarray,
    dt: float,
    left: np.ndarray,
    blown: np.ndarray,
    work: np.ndarray,
) -> None:
    """Advance x by dt under the gust d and decay the gust."""
    for i in range(6):
        blown[_OFFSET[i]] = par[_OFFSET[i]] + d[i]
        d[i] *= left[i]
    step(x, delta, blown, at, dt, work)


@kernel
def _fly(
    tracked: np.ndarray,
    begins: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    at: np.ndarray,
    dt: float,
    left: np.ndarray,
    out: np.ndarray,
) -> None:
    x, d, blown, work = np.empty(N_X), np.empty(6), par.copy(), np.empty((3, N_X))
    out[:] = np.nan
    for m in range(len(begins)):
        x[:], d[:] = tracked[m, :N_X], tracked[m, N_X:]
        for k in range(min(out.shape[1], len(delta) - begins[m])):
            if lost(x):
                break
            for i in range(N_X):
                out[m, k, i] = x[i]
            _blow(x, d, delta[begins[m] + k], par, at, dt, left, blown, work)
