"""Refine [A B c] by the prediction error of free runs whose start states and output biases are estimated too.

    J = sum_s sum_k e' W e + (par - par0)' Lambda (par - par0) + sum_s z_s' K z_s,   e = y - b_s - y_hat

over free-run segments s, W the inverse residual variances. The nuisance parameters z_s of a segment are its start state
x_s, relative to the measured one, and a constant output bias b_s: sensor errors that drift slowly. Every Gauss-Newton
step eliminates them by their Schur complement. Free runs grow: the ridge Lambda draws the parameters to those that the
shorter runs found, and the shortest runs to the first step.

Source: Huang 2021, eq. 16-17 (prediction error); Jategaonkar 2015, chapter 4 (multiple shots, bias parameters).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np

from twin_worker.numerics.gauss_newton import gauss_newton

_DIVERGED = 50.0  # larger states have diverged [scaled units]
_MIN_SEGMENT = 10  # shorter segments between gaps are ignored [samples]
_WEIGHT_UPDATES = (0, 2)  # steps before which the weights are updated
_STEPS = 12  # maximum Gauss-Newton steps of one segment length
Point = tuple[np.ndarray, np.ndarray]  # parameters (P,), start states and biases (s, 2n)


@nb.njit(cache=True, nogil=True)
def residuals_and_jacobian(
    D: np.ndarray,
    starts: np.ndarray,
    segments: np.ndarray,
    y: np.ndarray,
    u: np.ndarray,
    weight: np.ndarray,
    e: np.ndarray,
    J: np.ndarray,
) -> float:
    """Simulate every segment; store residuals e = (y - b - y_hat) weight and, if J has rows, their sensitivities.

    Args:
        D: [A B c], (n, q)
        starts: start state and bias of each segment, (s, 2n)
        segments: first row and the row after the last, (s, 2)
        y, u: outputs (N, n) and inputs (N, m)
        weight: square roots of the weights, (n,)
        e: output, (rows, n)
        J: output, d(y_hat + b) / d(par, x0, b) weight, (rows, n, n q + 2n) zeros, or no rows
    Returns:
        the sum of squares; inf if a run diverges
    """
    n, q = D.shape
    m, total = q - n - 1, n * q
    z, x, x_next = np.zeros(q), np.zeros(n), np.zeros(n)
    A, S, S_next = D[:, :n].copy(), np.zeros((n, total + n)), np.zeros((n, total + n))
    z[q - 1] = 1.0
    cost, row = 0.0, 0
    for s in range(len(segments)):
        x[:] = starts[s, :n]
        S[:] = 0.0
        for i in range(n):
            S[i, total + i] = 1.0
        for k in range(segments[s, 0], segments[s, 1]):
            for i in range(n):
                e[row, i] = (y[k, i] - starts[s, n + i] - x[i]) * weight[i]
                cost += e[row, i] ** 2
                if len(J):
                    for a in range(total + n):
                        J[row, i, a] = S[i, a] * weight[i]
                    J[row, i, total + n + i] = weight[i]
            row += 1
            z[:n] = x
            z[n : n + m] = u[k]
            if len(J):
                S_next[:] = A @ S
                for i in range(n):
                    for j in range(q):
                        S_next[i, i * q + j] += z[j]
                S[:] = S_next
            for i in range(n):
                x_next[i] = 0.0
                for j in range(q):
                    x_next[i] += D[i, j] * z[j]
            x[:] = x_next
            if not np.abs(x).max() < _DIVERGED:
                return np.inf
    return cost


@dataclass(frozen=True)
class SensorErrors:
    """Standard deviations of the sensor errors of every output, scaled units, each (n,).

    Attributes:
        white: white noise
        drift: errors that are constant within one free run
    """

    white: np.ndarray
    drift: np.ndarray


def segments_of(ok: np.ndarray, length: int) -> np.ndarray:
    """Split the gap-free rows into segments of about `length` rows: first row and the row after the last, (s, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ok, [False]]).astype(int)))
    pieces: list[tuple[int, int]] = []
    for start, stop in edges.reshape(-1, 2):
        count = max(round((stop - start) / length), 1)
        rows = (stop - start) // count
        if rows >= _MIN_SEGMENT:
            pieces += [(start + k * rows, start + (k + 1) * rows) for k in range(count)]
    return np.array(pieces, dtype=np.int64).reshape(-1, 2)


class _Problem:
    """Cost and normal equations for one segment length."""

    def __init__(
        self,
        y: np.ndarray,
        u: np.ndarray,
        segments: np.ndarray,
        first: np.ndarray,
        *,
        ridge: float,
        errors: SensorErrors,
    ) -> None:
        n, self.size = y.shape[1], first.size
        self.y, self.u, self.segments, self.par0, self.ridge = y, u, segments, first.ravel(), ridge
        self.floor, self.W = errors.white**2, np.ones(n)
        self.K = np.concatenate([1 / (errors.white**2 + errors.drift**2), errors.drift**-2.0])
        self.measured = np.hstack([y[segments[:, 0]], np.zeros((len(segments), n))])
        self.bounds = np.concatenate([[0], np.cumsum(np.diff(segments, axis=1)[:, 0])])
        self.e = np.empty((self.bounds[-1], n))
        self.J = np.zeros((self.bounds[-1], n, self.size + 2 * n))
        self.trial, self.no_sensitivities = np.empty_like(self.e), np.empty((0, n, self.size + 2 * n))
        self.moves = np.empty(0)

    def simulate(self, x: Point, slopes: bool) -> float:
        e, J = (self.e, self.J) if slopes else (self.trial, self.no_sensitivities)
        D = x[0].reshape(len(self.W), -1)
        return self.cost(residuals_and_jacobian(D, x[1], self.segments, self.y, self.u, np.sqrt(self.W), e, J), x)

    def cost(self, squares: float, x: Point) -> float:
        ridge = self.ridge * float(((x[0] - self.par0) ** 2).sum())
        return squares + ridge + float((self.K * (x[1] - self.measured) ** 2).sum())

    def linearise(self, x: Point, count: int) -> tuple[float, np.ndarray, np.ndarray]:
        cost, P = self.simulate(x, True), self.size
        H, g = self.ridge * np.eye(P), -self.ridge * (x[0] - self.par0)
        if not np.isfinite(cost):
            return cost, H, g
        if count in _WEIGHT_UPDATES:
            W = 1 / np.maximum((self.e**2).mean(axis=0) / self.W, self.floor)
            ratio = np.sqrt(W / self.W)
            self.e *= ratio
            self.J *= ratio[:, None]
            self.W, cost = W, self.cost(float((self.e**2).sum()), x)
        moves = []
        for s in range(len(self.segments)):
            rows = slice(self.bounds[s], self.bounds[s + 1])
            J = self.J[rows].reshape(-1, self.J.shape[2])
            HH, gg = J.T @ J, J.T @ self.e[rows].ravel()
            cross, nuisance = HH[P:, :P], gg[P:] - self.K * (x[1][s] - self.measured[s])
            moves.append(np.linalg.solve(HH[P:, P:] + np.diag(self.K), np.column_stack([cross, nuisance])))
            H += HH[:P, :P] - cross.T @ moves[-1][:, :-1]
            g += gg[:P] - cross.T @ moves[-1][:, -1]
        self.moves = np.array(moves)
        return cost, H, g

    def move(self, x: Point, change: np.ndarray) -> tuple[Point, float]:
        candidate = x[0] + change, x[1] + self.moves[..., -1] - self.moves[..., :-1] @ change
        return candidate, self.simulate(candidate, False)


def refine_with_starts(
    first: np.ndarray,
    y: np.ndarray,
    u: np.ndarray,
    ok: np.ndarray,
    *,
    runs: Sequence[tuple[int, float]],
    errors: SensorErrors,
) -> np.ndarray:
    """Refine [A B c] by free runs of increasing length; start states and output biases are estimated too.

    Short runs come first: a poor first step diverges in long ones, and they have more local minima. They also remove
    the bias of a first step that ignores feedback, to which a ridge would otherwise draw the result of long runs.

    Args:
        first: model of the first step, scaled units, (n, n + m + 1)
        y, u, ok: scaled outputs (N, n) and inputs (N, m), measured rows (N,)
        runs: free-run length [samples] and precision of every entry about the result before it [-], one after the other
        errors: sensor errors
    Returns:
        the refined [A B c]; a length in which no run stays finite leaves its start unchanged
    Raises:
        ValueError: if no segment is free of gaps; wait for more data.
    """
    D = first
    for length, ridge in runs:
        segments = segments_of(ok, length)
        if not len(segments):
            raise ValueError(f"refine: found no {_MIN_SEGMENT} rows without a gap, needs them; wait for more")
        problem = _Problem(y, u, segments, D, ridge=ridge, errors=errors)
        start = D.ravel().copy(), problem.measured.copy()
        (par, _), cost, _ = gauss_newton(
            start, problem.linearise, problem.move, steps=_STEPS, converges_from=_WEIGHT_UPDATES[-1] + 1
        )
        if np.isfinite(cost):
            D = par.reshape(D.shape)
    return D
