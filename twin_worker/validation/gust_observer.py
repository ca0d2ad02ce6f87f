"""Alpha-beta filter of state and gust, which provides the start of a free run.

Gusts are decaying accelerations d in u v w p q r in addition to the model. They explain the next step and decay
within a forecast, so that the derivatives do not include them.

    x' = f(x, delta) + d,   d' = -d / TAU,   e = y - x_hat,   x_hat += alpha e,   d_hat += beta e / dt

Source: Bar-Shalom 2001, section 6.5 (alpha-beta filter); Jategaonkar 2015, chapter 5 (filter error method).
"""

from dataclasses import dataclass

import numpy as np

from fleet.compiled_frames import assign
from fleet.physics.dynamics import N_X, is_diverged, step
from fleet.physics.kernel import kernel
from fleet.physics.wrench import OFFSETS
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel

TAU = np.array([0.3, 0.3, 0.3, 0.1, 0.1, 0.1])  # decay time of gusts in u v w p q r [s]
_ALPHA = np.array([0.8, 0.8, 0.8, 1.0, 1.0, 1.0, 0.9, 0.9, 0.9])  # u v w over the ground, p q r, angles
_BETA = np.array([0.08, 0.08, 0.08, 0.25, 0.25, 0.25, 0.0, 0.0, 0.0])
_DRIVEN_STATE = (0, 2, 4, 1, 3, 5)  # state that each offset drives, in the order of `OFFSETS`
_OFFSET = np.array([OFFSETS[_DRIVEN_STATE.index(k)] for k in range(6)])  # the inverse map


@dataclass(frozen=True)
class AlphaBetaFilter:
    """Filter for one model at a sample time dt [s]."""

    model: DerivativesModel
    dt: float

    @property
    def gust_decay(self) -> np.ndarray:
        """Return the decay factor of each gust over one sample, (6,) [-]."""
        return np.exp(-self.dt / TAU)

    def filter(self, y: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Filter a segment: states and gusts at every row, from the rows up to it, (n, 15).

        Args:
            y: measured states, u v w over the ground, (n, 9)
            delta: actuator states, (n, 4)
        """
        return self.filter_and_predict(y, delta)[0]

    def one_step(self, y: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Predict every row from the rows before it, (n, 9); the first is measured. Arguments as for `filter`."""
        return self.filter_and_predict(y, delta)[1]

    def filter_and_predict(self, y: np.ndarray, delta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the results of `filter` and of `one_step`; both restart at nan."""
        par, trim_velocity = self.model.par, self.model.trim_velocity
        filtered, predicted = np.empty((len(y), N_X + 6)), np.empty_like(y)
        _filter_rows(y, delta, par, trim_velocity, self.dt, self.gust_decay, filtered, predicted)
        return filtered, predicted

    def free_run(self, filtered: np.ndarray, start_rows: np.ndarray, length: int, delta: np.ndarray) -> np.ndarray:
        """Simulate from filtered rows, (m, 15), at `start_rows`, (m,), with decaying gusts; return (m, length, 9)."""
        out = np.empty((len(start_rows), length, N_X))
        _free_run(filtered, start_rows, delta, self.model.par, self.model.trim_velocity, self.dt, self.gust_decay, out)
        return out


@kernel
def _filter_rows(
    y: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    trim_velocity: np.ndarray,
    dt: float,
    gust_decay: np.ndarray,
    out: np.ndarray,
    predicted: np.ndarray,
) -> None:
    x, d, par_with_gust, work = y[0].copy(), np.zeros(6), par.copy(), np.empty((3, N_X))
    for k in range(len(y)):
        for i in range(N_X):
            predicted[k, i] = x[i]
            e = y[k, i] - x[i]
            x[i] += _ALPHA[i] * e
            if i < 6:
                d[i] += _BETA[i] * e / dt
        if is_diverged(x):
            assign(x, y[k])
            d[:] = 0.0
        for i in range(N_X):
            out[k, i] = x[i]
        for i in range(6):
            out[k, N_X + i] = d[i]
        _step_with_gust(x, d, delta[k], par, trim_velocity, dt, gust_decay, par_with_gust, work)


@kernel
def _step_with_gust(
    x: np.ndarray,
    d: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    trim_velocity: np.ndarray,
    dt: float,
    gust_decay: np.ndarray,
    par_with_gust: np.ndarray,
    work: np.ndarray,
) -> None:
    """Advance x by dt under the gust d and decay the gust."""
    for i in range(6):
        par_with_gust[_OFFSET[i]] = par[_OFFSET[i]] + d[i]
        d[i] *= gust_decay[i]
    step(x, delta, par_with_gust, trim_velocity, dt, work)


@kernel
def _free_run(
    filtered: np.ndarray,
    start_rows: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    trim_velocity: np.ndarray,
    dt: float,
    gust_decay: np.ndarray,
    out: np.ndarray,
) -> None:
    x, d, par_with_gust, work = np.empty(N_X), np.empty(6), par.copy(), np.empty((3, N_X))
    out[:] = np.nan
    for m in range(len(start_rows)):
        assign(x, filtered[m, :N_X])
        assign(d, filtered[m, N_X:])
        for k in range(min(out.shape[1], len(delta) - start_rows[m])):
            if is_diverged(x):
                break
            for i in range(N_X):
                out[m, k, i] = x[i]
            _step_with_gust(x, d, delta[start_rows[m] + k], par, trim_velocity, dt, gust_decay, par_with_gust, work)
