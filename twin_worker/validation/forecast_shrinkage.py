"""Shrinkage of a model's free runs towards the mean and the last value of each state.

    y_hat = m + kappa (run - m) + hold (y0 - m)

m is the mean of the preceding segment (psi: the last value). The weights kappa (model) and hold (persistence), per
state and look-ahead, minimise the error on held-out flight; without held-out flight they are 1 and 0.

Source: James & Stein 1961 (shrinkage); Bates & Granger 1969 (combination of forecasts).
"""

from dataclasses import dataclass, field

import numpy as np

from fleet.window import STATES
from twin_worker.validation.gust_observer import Observer

KNOTS_S = np.array([0.0, 1.0, 4.0, 10.0, 20.0, 40.0])  # look-ahead of the weights [s]
_WEIGHT = 0.3  # updates that the previous look-ahead is equivalent to
_KEEP = 0.8  # of earlier data at each update: aircraft and air change
_PSI = STATES.index("psi")


@dataclass
class Earned:
    """Normal equations of kappa and hold per knot and state, and the usual mean square of each state."""

    H: np.ndarray = field(default_factory=lambda: np.zeros((len(KNOTS_S), 9, 2, 2)))
    g: np.ndarray = field(default_factory=lambda: np.zeros((len(KNOTS_S), 9, 2)))
    usual: np.ndarray = field(default_factory=lambda: np.zeros((len(KNOTS_S), 9)))

    def learn(self, runs: np.ndarray, y: np.ndarray, m: np.ndarray, dt: float, weight: float = 1.0) -> None:
        """Update with free runs and the recorded flight; quiet flight has less weight, other updates equal weight.

        Args:
            runs: free runs from measured starts, (k, n, 9)
            y: measured states from each start on, nan where not measured, (k, n, 9)
            m: mean of the preceding segment, (9,)
            dt: sample time [s]
            weight: weight of this update [-]
        """
        self.H *= _KEEP
        self.g *= _KEEP
        self.usual *= _KEEP
        for knot, s in enumerate(KNOTS_S[1:], 1):
            at = slice(max(round(0.75 * s / dt), 1), round(s / dt) + 1)
            mean = _mean(m, y[:, 0])[:, None]
            run, held, flown = runs[:, at] - mean, np.broadcast_to(y[:, :1] - mean, runs[:, at].shape), y[:, at] - mean
            good = np.isfinite(run) & np.isfinite(flown) & np.isfinite(held)
            z = np.where(good, np.stack([run, held]), 0.0)
            flown = np.where(good, flown, 0.0)
            strayed, rows = np.einsum("knj,knj->j", flown, flown), good.sum(axis=(0, 1))
            self.usual[knot] = np.maximum(self.usual[knot], strayed / np.maximum(rows, 1))
            power = np.maximum(rows * self.usual[knot], np.einsum("knj,knj->j", z[0], z[0])) + 1e-9
            self.H[knot] += weight * np.einsum("aknj,bknj->jab", z, z) / power[:, None, None]
            self.g[knot] += weight * np.einsum("aknj,knj->ja", z, flown) / power[:, None]

    def copy(self) -> "Earned":
        """Return an independent copy."""
        return Earned(self.H.copy(), self.g.copy(), self.usual.copy())

    def shares(self) -> np.ndarray:
        """Return kappa and hold at each knot, (knots, 9, 2); each and their sum are within 0..1."""
        ridge = _WEIGHT * np.eye(2)
        out = np.empty(self.g.shape)
        out[0] = 1.0, 0.0
        for knot in range(1, len(KNOTS_S)):  # default: weights of the previous knot
            k = np.linalg.solve(self.H[knot] + ridge, (self.g[knot] + out[knot - 1] @ ridge)[..., None])[..., 0]
            k = np.clip(k, 0.0, 1.0)
            out[knot] = k / np.maximum(k.sum(axis=-1, keepdims=True), 1.0)
        return out

    def at(self, ahead_s: float) -> dict[str, float]:
        """Return kappa of every state at a look-ahead."""
        kappa = self.shares()[..., 0]
        return {name: float(np.interp(ahead_s, KNOTS_S, kappa[:, j])) for j, name in enumerate(STATES)}

    def forecast(self, run: np.ndarray, y0: np.ndarray, m: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        """Shrink free runs.

        Args:
            run: states at the look-aheads, (..., n, 9)
            y0: start states, (..., 9)
            m: mean of the preceding segment, (9,)
            ahead: look-aheads, (n,) [s]
        """
        k = self.shares()
        kappa, hold = (np.column_stack([np.interp(ahead, KNOTS_S, k[:, j, a]) for j in range(9)]) for a in range(2))
        mean = _mean(m, y0)
        tempered = mean[..., None, :] + kappa * (run - mean[..., None, :]) + hold * (y0 - mean)[..., None, :]
        return np.where(np.isfinite(tempered), tempered, mean[..., None, :])


def runs_and_flown(
    eye: Observer, y: np.ndarray, delta: np.ndarray, begins: np.ndarray, seconds: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return free runs and the measured states over the same rows, nan where not measured, (k, n, 9) each.

    Args:
        gust_filter: filter of the model
        y: measured states, u v w over the ground, nan where not measured, (n, 9)
        delta: actuator states, (n, 4)
        start_rows: first row of each run, (k,)
        seconds: length of a run [s]
    """
    length = min(round(seconds / eye.dt) + 1, len(y))
    runs = eye.fly(eye.track(y, delta)[begins], begins, length, delta)
    rows = begins[:, None] + np.arange(length)
    flown = y[np.minimum(rows, len(y) - 1)]
    flown[rows >= len(y)] = np.nan
    return runs, flown


def _mean(m: np.ndarray, y0: np.ndarray) -> np.ndarray:
    """Return the mean for each start, (..., 9); psi is the start heading, because headings have no mean."""
    out = np.broadcast_to(m, y0.shape).copy()
    out[..., _PSI] = y0[..., _PSI]
    return out
