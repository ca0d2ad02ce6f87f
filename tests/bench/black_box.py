"""Refine black-box A, B, C (K, c, x0) of any order by the prediction error with damped Gauss-Newton steps.

Output error and innovations form are one run of x' = F x + G w, y_hat = C x: w = (u, 1) with F = A, or
w = (u, 1, y) with F = A - K C. All entries are free. Directions that only transform the state do not change the cost,
and the damping suppresses them. A step that moves a pole out of the unit circle is rejected.

J = sum_k e' e,  e = y - y_hat over the measured rows of one long run; D = 0.
Source: Huang 2021, eq. 16-17; Ljung 1999, sections 7.3 and 10.2; McKelvey, Helmersson 2004 (free parametrisation).
"""

from dataclasses import dataclass

import numba as nb
import numpy as np
import scipy.linalg

from twin_worker.identification.linear.state_space import StateSpace

_BLOCK = 64  # samples per block product [-]
_CAP = 1e4  # divergence limit of a run [scaled units]
_GRAMIAN_WEIGHT = 0.01  # weight of the observability Gramian against the fit [-]
_ROW_CAP = 1e6  # bound of the observability rows [scaled units]


@nb.njit(cache=True, nogil=True)
def normal_equations(
    F: np.ndarray, G: np.ndarray, C: np.ndarray, x0: np.ndarray, y: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute squared errors, gradient and Gauss-Newton matrix of one run; parameters in the order [F G] C x0.

    F (n, n); G (n, m); C (l, n); x0 (n,); y (N, l), nan where not measured; w (N, m).
    The squares (l,) are inf if the run diverges.
    """
    n, m, l = len(F), G.shape[1], len(C)
    q = n + m
    dynamic = n * q  # sensitivities of the state: entries of [F G], then of x0
    total = dynamic + l * n + n
    g, H, squares = np.zeros(total), np.zeros((total, total)), np.zeros(l)
    S, S_next = np.zeros((n, dynamic + n)), np.zeros((n, dynamic + n))
    x, z = x0.copy(), np.zeros(q)
    rows, errors, filled = np.zeros((_BLOCK * l, total)), np.zeros(_BLOCK * l), 0
    for i in range(n):
        S[i, dynamic + i] = 1.0
    for k in range(len(y)):
        if np.isfinite(y[k]).all():
            T = C @ S
            for i in range(l):
                e = y[k, i]
                for j in range(n):
                    e -= C[i, j] * x[j]
                squares[i] += e * e
                row, errors[filled] = rows[filled], e
                row[:dynamic] = T[i, :dynamic]
                row[dynamic : dynamic + l * n] = 0.0
                row[dynamic + i * n : dynamic + (i + 1) * n] = x
                row[dynamic + l * n :] = T[i, dynamic:]
                filled += 1
            if filled == len(rows):
                H += rows.T @ rows
                g += rows.T @ errors
                filled = 0
        z[:n] = x
        z[n:] = w[k]
        np.dot(F, S, S_next)
        for i in range(n):
            S_next[i, i * q : (i + 1) * q] += z
        x = F @ x + G @ w[k]
        S, S_next = S_next, S
        if not np.abs(x).max() < _CAP:
            squares[:] = np.inf
            break
    H += rows[:filled].T @ rows[:filled]
    g += rows[:filled].T @ errors[:filled]
    return squares, g, H


@nb.njit(cache=True, nogil=True)
def squared_errors(
    F: np.ndarray, G: np.ndarray, C: np.ndarray, x0: np.ndarray, y: np.ndarray, w: np.ndarray
) -> np.ndarray:
    """Return only the squared errors of `normal_equations`, (l,)."""
    squares, x = np.zeros(len(C)), x0.copy()
    for k in range(len(y)):
        if np.isfinite(y[k]).all():
            squares += (y[k] - C @ x) ** 2
        x = F @ x + G @ w[k]
        if not np.abs(x).max() < _CAP:
            squares[:] = np.inf
            break
    return squares


@dataclass(frozen=True)
class _Parametrisation:
    """Data, and layout of the matrices in the parameter vector."""

    y: np.ndarray  # nan where not measured
    w: np.ndarray
    n: int
    m: int  # inputs
    with_bias: bool
    innovations_form: bool

    @property
    def offsets(self) -> np.ndarray:
        """Return the first index of C and of x0."""
        dynamic = self.n * (self.n + self.w.shape[1])
        return np.array([dynamic, dynamic + self.y.shape[1] * self.n])

    def pack(self, model: StateSpace) -> np.ndarray:
        F, G = model.A, model.B
        if self.with_bias:
            G = np.hstack([G, model.c[:, None]])
        if self.innovations_form:
            F, G = F - model.K @ model.C, np.hstack([G, model.K])
        return np.concatenate([np.hstack([F, G]).ravel(), model.C.ravel(), model.x0])

    def matrices(self, par: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        dynamic, C, x0 = np.split(par, self.offsets)
        FG = dynamic.reshape(self.n, -1)
        return FG[:, : self.n].copy(), FG[:, self.n :].copy(), C.reshape(-1, self.n).copy(), x0.copy()

    def unpack(self, par: np.ndarray) -> StateSpace:
        F, G, C, x0 = self.matrices(par)
        K = G[:, self.m + self.with_bias :] if self.innovations_form else np.zeros((self.n, len(C)))
        c = G[:, self.m] if self.with_bias else np.zeros(self.n)
        return StateSpace.of(F + K @ C, G[:, : self.m], C, K=K, c=c, x0=x0)


def _parametrise(
    model: StateSpace, y: np.ndarray, u: np.ndarray, ok: np.ndarray | None, *, innovations_form: bool, with_bias: bool
) -> _Parametrisation:
    y = np.array(y, float)
    if ok is not None:
        y[~ok] = np.nan
    columns = [u]
    if with_bias:
        columns.append(np.ones((len(u), 1)))
    if innovations_form:
        columns.append(np.nan_to_num(y))
    return _Parametrisation(
        y, np.ascontiguousarray(np.hstack(columns)), model.order, u.shape[1], with_bias, innovations_form
    )


def refine_black_box(
    model: StateSpace,
    y: np.ndarray,
    u: np.ndarray,
    *,
    ok: np.ndarray | None = None,
    innovations: bool = False,
    with_bias: bool = False,
    steps: int = 30,
) -> StateSpace:
    """Refine every matrix of a model by damped Gauss-Newton; the cost on these data never increases.

    Args:
        model: start, any order
        y, u: scaled outputs (N, l) and inputs (N, m)
        ok: fitted rows, (N,) bool; other rows are simulated but not fitted (output error only)
        innovations: refine the one-step prediction (with K) instead of the free run
        with_bias: include a constant state bias c
        steps: maximum Gauss-Newton steps
    """
    parametrisation = _parametrise(model, y, u, ok, innovations_form=innovations, with_bias=with_bias)
    par = parametrisation.pack(model)
    squares = squared_errors(*parametrisation.matrices(par), parametrisation.y, parametrisation.w)
    if not np.isfinite(squares).all():
        return model
    mu, best = 1e-2, float(squares.sum())
    max_radius = max(model.radius, 1.0)
    for _ in range(steps):
        _, g, H = normal_equations(*parametrisation.matrices(par), parametrisation.y, parametrisation.w)
        previous = best
        while mu < 1e8:
            trial = par + _damped_step(g, H, mu)
            total = float(squared_errors(*parametrisation.matrices(trial), parametrisation.y, parametrisation.w).sum())
            if total < best and parametrisation.unpack(trial).radius <= max_radius:
                par, best, mu = trial, total, max(mu / 8, 1e-9)
                break
            mu *= 6
        if previous - best < 1e-5 * previous:
            break
    return parametrisation.unpack(par)


def _damped_step(g: np.ndarray, H: np.ndarray, mu: float) -> np.ndarray:
    """Solve the damped normal equations after diagonal scaling."""
    scaling = 1 / np.sqrt(np.diag(H) + 1e-9 * np.trace(H) / len(H) + 1e-30)
    scaled = scaling[:, None] * H * scaling
    scaled[np.diag_indices_from(scaled)] += mu
    return scaling * scipy.linalg.solve(scaled, scaling * g, assume_a="pos")


def one_step(model: StateSpace, y: np.ndarray, u: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
    """Predict every y (N, l) from the samples before it."""
    predictor = StateSpace(
        A=model.A - model.K @ model.C,
        B=np.hstack([model.B - model.K @ model.D, model.K]),
        C=model.C,
        K=model.K,
        c=model.c,
        x0=model.x0,
        D=np.hstack([model.D, np.zeros((len(model.C), len(model.C)))]),
    )
    return predictor.run(np.hstack([u, y]), x0)


def estimate_x0(model: StateSpace, y: np.ndarray, u: np.ndarray, length: int) -> np.ndarray:
    """Estimate the state at the first sample by regularised least squares, (n,).

    The observability Gramian of the complete run is the regulariser: it prevents an uncertain state from growing
    into a large error later.

    Args:
        y, u: the first outputs (k, l) and inputs (k, m) of the run
        length: samples of the complete run
    """
    residual = y - model.run(u, np.zeros(model.order))
    observability = np.empty((len(y), *model.C.shape))
    gramian, row = np.zeros((model.order, model.order)), model.C
    for k in range(length):
        if k < len(y):
            observability[k] = row
        gramian += row.T @ row
        row = np.clip(row @ model.A, -_ROW_CAP, _ROW_CAP)
    rows = observability.reshape(-1, model.order)
    lhs = rows.T @ rows + _GRAMIAN_WEIGHT * len(y) / length * gramian
    return np.linalg.lstsq(lhs, rows.T @ residual.ravel(), rcond=1e-12)[0]
