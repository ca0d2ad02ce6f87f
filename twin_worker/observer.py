"""What a free run starts from: the state behind the noise, and the gust that is blowing.

Gusts are accelerations d beyond the model's in u v w p q r that fade: they explain the next step and leave a forecast,
so that the derivatives need not know them.

    x' = f(x, delta) + d,   d' = -d / TAU,   e = y - x_hat,   x_hat += alpha e,   d_hat += beta e / dt

Each state has its own alpha and beta, those that foretold its next sample best on the stretch of the model.

Source: Bar-Shalom 2001, section 6.5 (alpha-beta filter); Jategaonkar 2015, chapter 5 (filter error method).
"""

from dataclasses import dataclass

import numpy as np

from fleet.physics.dynamics import LOST, N_X, step
from fleet.physics.kernel import kernel
from fleet.physics.wrench import OFFSETS
from twin_worker.coupled import Coupled

TAU = 1.0  # a gust fades in [s]
_ALPHA = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
_BETA = (0.0, 0.05, 0.2)  # share of what an innovation says of acceleration that is believed
_SETTLE = 50  # rows before innovations count
_DRIVEN = (0, 2, 4, 1, 3, 5)  # state each offset drives, in the order of `OFFSETS`
_OFFSET = np.array([OFFSETS[_DRIVEN.index(k)] for k in range(6)])  # and the other way round


@dataclass(frozen=True)
class Observer:
    """A filter for one model.

    Attributes:
        model: the coupled model
        alpha, beta: share of an innovation that moves the state, and its gust, (9,)
        dt: sample time [s]
    """

    model: Coupled
    alpha: np.ndarray
    beta: np.ndarray
    dt: float

    @property
    def left(self) -> float:
        """Give how much of a gust is left after one sample [-]."""
        return float(np.exp(-self.dt / TAU))

    def track(self, y: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Filter a stretch: states and gusts at every row, from the rows up to it, (n, 15).

        Args:
            y: measured states, u v w over the ground, (n, 9)
            delta: inputs as they act, (n, 4)
        """
        out = np.empty((len(y), N_X + 6))
        _track(y, delta, self.model.par, self.model.at, self.dt, (self.alpha, self.beta, self.left), out)
        return out

    def told(self, y: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Give the mean square of the innovations of each state, once settled, (9,)."""
        now = self.track(y, delta)[:-1]
        ahead = self.fly(now, np.arange(len(now)), 2, delta)[:, 1]
        e = (y[1:] - ahead)[_SETTLE:]
        return np.where(np.isfinite(e), e**2, 1e6).mean(axis=0)

    def fly(self, tracked: np.ndarray, begins: np.ndarray, length: int, delta: np.ndarray) -> np.ndarray:
        """Run free from tracked rows, (m, 15), at `begins`, (m,), with fading gusts; give them, (m, length, 9)."""
        out = np.empty((len(begins), length, N_X))
        _fly(tracked, begins, delta, self.model.par, self.model.at, self.dt, self.left, out)
        return out


def observer(model: Coupled, y: np.ndarray, delta: np.ndarray, dt: float) -> Observer:
    """Choose the filter on the stretch a model was identified from.

    Args:
        model: the coupled model
        y: measured states, u v w over the ground, (n, 9)
        delta: inputs as they act, (n, 4)
        dt: sample time [s]
    """
    best, least = Observer(model, np.ones(N_X), np.zeros(N_X), dt), np.full(N_X, np.inf)
    for alpha in _ALPHA:
        for beta in _BETA:
            one = Observer(model, np.full(N_X, alpha), np.full(N_X, alpha * beta), dt)
            told = one.told(y, delta)
            better = told < least
            least = np.where(better, told, least)
            best = Observer(model, np.where(better, alpha, best.alpha), np.where(better, alpha * beta, best.beta), dt)
    return best


@kernel
def _track(
    y: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    at: np.ndarray,
    dt: float,
    gain: tuple,
    out: np.ndarray,
) -> None:
    alpha, beta, left = gain
    x, d, blown, work = y[0].copy(), np.zeros(6), par.copy(), np.empty((3, N_X))
    for k in range(len(y)):
        for i in range(N_X):
            e = y[k, i] - x[i]
            x[i] += alpha[i] * e
            if i < 6:
                d[i] += beta[i] * e / dt
        if not np.abs(x).max() < LOST:
            x[:] = y[k]
            d[:] = 0.0
        out[k, :N_X] = x
        out[k, N_X:] = d
        _blow(x, d, delta[k], par, at, dt, left, blown, work)


@kernel
def _blow(
    x: np.ndarray,
    d: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    at: np.ndarray,
    dt: float,
    left: float,
    blown: np.ndarray,
    work: np.ndarray,
) -> None:
    """Advance x by dt in the gust d, and let that fade."""
    for i in range(6):
        blown[_OFFSET[i]] = par[_OFFSET[i]] + d[i]
        d[i] *= left
    step(x, delta, blown, at, dt, work)


@kernel
def _fly(
    tracked: np.ndarray,
    begins: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    at: np.ndarray,
    dt: float,
    left: float,
    out: np.ndarray,
) -> None:
    x, d, blown, work = np.empty(N_X), np.empty(6), par.copy(), np.empty((3, N_X))
    out[:] = np.nan
    for m in range(len(begins)):
        x[:], d[:] = tracked[m, :N_X], tracked[m, N_X:]
        for k in range(min(out.shape[1], len(delta) - begins[m])):
            if not np.abs(x).max() < LOST:
                break
            out[m, k] = x
            _blow(x, d, delta[begins[m] + k], par, at, dt, left, blown, work)
