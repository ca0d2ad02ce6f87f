"""Shrinkage of a model's free runs towards the mean and the last value of each state.

    y_hat = m + kappa (run - m) + hold (y0 - m)

m is the mean of the preceding segment (psi: the last value). The weights kappa (model) and hold (persistence), per
state and look-ahead, minimise the error on held-out flight; without held-out flight they are 1 and 0.

Source: James & Stein 1961 (shrinkage); Bates & Granger 1969 (combination of forecasts).
"""

from dataclasses import dataclass, field

import numpy as np

from fleet.window import STATES
from twin_worker.validation.gust_observer import AlphaBetaFilter

KNOTS_S = np.array([0.0, 1.0, 4.0, 10.0, 20.0, 40.0])  # look-ahead of the weights [s]
_PRIOR_WEIGHT = 0.3  # updates that the previous look-ahead is equivalent to
_FORGETTING = 0.8  # of earlier data at each update: aircraft and air change
_PSI = STATES.index("psi")


@dataclass
class Shrinkage:
    """Normal equations of kappa and hold per knot and state, and the usual mean square of each state."""

    H: np.ndarray = field(default_factory=lambda: np.zeros((len(KNOTS_S), 9, 2, 2)))
    g: np.ndarray = field(default_factory=lambda: np.zeros((len(KNOTS_S), 9, 2)))
    mean_square: np.ndarray = field(default_factory=lambda: np.zeros((len(KNOTS_S), 9)))

    def update(self, runs: np.ndarray, y: np.ndarray, m: np.ndarray, dt: float, weight: float = 1.0) -> None:
        """Update with free runs and the recorded flight; quiet flight has less weight, other updates equal weight.

        Args:
            runs: free runs from measured starts, (k, n, 9)
            y: measured states from each start on, nan where not measured, (k, n, 9)
            m: mean of the preceding segment, (9,)
            dt: sample time [s]
            weight: weight of this update [-]
        """
        self.H *= _FORGETTING
        self.g *= _FORGETTING
        self.mean_square *= _FORGETTING
        for knot, s in enumerate(KNOTS_S[1:], 1):
            span = slice(max(round(0.75 * s / dt), 1), round(s / dt) + 1)
            mean = _fallback_mean(m, y[:, 0])[:, None]
            run, persistence, measured = (
                runs[:, span] - mean,
                np.broadcast_to(y[:, :1] - mean, runs[:, span].shape),
                y[:, span] - mean,
            )
            valid = np.isfinite(run) & np.isfinite(measured) & np.isfinite(persistence)
            z = np.where(valid, np.stack([run, persistence]), 0.0)
            measured = np.where(valid, measured, 0.0)
            square_sum, n_valid = np.einsum("knj,knj->j", measured, measured), valid.sum(axis=(0, 1))
            self.mean_square[knot] = np.maximum(self.mean_square[knot], square_sum / np.maximum(n_valid, 1))
            power = np.maximum(n_valid * self.mean_square[knot], np.einsum("knj,knj->j", z[0], z[0])) + 1e-9
            self.H[knot] += weight * np.einsum("aknj,bknj->jab", z, z) / power[:, None, None]
            self.g[knot] += weight * np.einsum("aknj,knj->ja", z, measured) / power[:, None]

    def copy(self) -> "Shrinkage":
        """Return an independent copy."""
        return Shrinkage(self.H.copy(), self.g.copy(), self.mean_square.copy())

    def weights(self) -> np.ndarray:
        """Return kappa and hold at each knot, (knots, 9, 2); each and their sum are within 0..1."""
        ridge = _PRIOR_WEIGHT * np.eye(2)
        out = np.empty(self.g.shape)
        out[0] = 1.0, 0.0
        for knot in range(1, len(KNOTS_S)):  # default: weights of the previous knot
            clipped = np.linalg.solve(self.H[knot] + ridge, (self.g[knot] + out[knot - 1] @ ridge)[..., None])[..., 0]
            clipped = np.clip(clipped, 0.0, 1.0)
            out[knot] = clipped / np.maximum(clipped.sum(axis=-1, keepdims=True), 1.0)
        return out

    def kappa_at(self, ahead_s: float) -> dict[str, float]:
        """Return kappa of every state at a look-ahead."""
        kappa = self.weights()[..., 0]
        return {name: float(np.interp(ahead_s, KNOTS_S, kappa[:, j])) for j, name in enumerate(STATES)}

    def forecast(self, run: np.ndarray, y0: np.ndarray, m: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        """Shrink free runs.

        Args:
            run: states at the look-aheads, (..., n, 9)
            y0: start states, (..., 9)
            m: mean of the preceding segment, (9,)
            ahead: look-aheads, (n,) [s]
        """
        knot_weights = self.weights()
        kappa, persistence = (
            np.column_stack([np.interp(ahead, KNOTS_S, knot_weights[:, j, a]) for j in range(9)]) for a in range(2)
        )
        mean = _fallback_mean(m, y0)
        shrunk = mean[..., None, :] + kappa * (run - mean[..., None, :]) + persistence * (y0 - mean)[..., None, :]
        return np.where(np.isfinite(shrunk), shrunk, mean[..., None, :])


def runs_and_measured(
    gust_filter: AlphaBetaFilter,
    y: np.ndarray,
    delta: np.ndarray,
    start_rows: np.ndarray,
    seconds: float,
    *,
    filtered: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return free runs and the measured states over the same rows, nan where not measured, (k, n, 9) each.

    Args:
        gust_filter: filter of the model
        y: measured states, u v w over the ground, nan where not measured, (n, 9)
        delta: actuator states, (n, 4)
        start_rows: first row of each run, (k,)
        seconds: length of a run [s]
        filtered: result of the filter for these states, (n, 15); None: computed here
    """
    length = min(round(seconds / gust_filter.dt) + 1, len(y))
    filtered = gust_filter.filter(y, delta) if filtered is None else filtered
    runs = gust_filter.free_run(filtered[start_rows], start_rows, length, delta)
    rows = start_rows[:, None] + np.arange(length)
    measured = y[np.minimum(rows, len(y) - 1)]
    measured[rows >= len(y)] = np.nan
    return runs, measured


def _fallback_mean(m: np.ndarray, y0: np.ndarray) -> np.ndarray:
    """Return the mean for each start, (..., 9); psi is the start heading, because headings have no mean."""
    out = np.broadcast_to(m, y0.shape).copy()
    out[..., _PSI] = y0[..., _PSI]
    return out
