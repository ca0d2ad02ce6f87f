"""Refine [A B c] by the prediction error of free runs, with Gauss-Newton steps and a prior.

J = sum_k e' W e + (par - par0)' Lambda (par - par0),  e = y - y_hat,  y_hat a free run of one segment,
W = effective_fraction / residual variance.
Source: Huang 2021, eq. 16-17 (Newton-Raphson on J = e'e); Ljung 1999, section 10.2 (Gauss-Newton, damping).
"""

import numba as nb
import numpy as np

from twin_worker.numerics.gauss_newton import gauss_newton

_WEIGHT_UPDATES = (0, 2)  # steps before which the weights are estimated from the residuals
_MAX_ERROR = 20.0  # errors are clipped to this [scaled units]


@nb.njit(cache=True, nogil=True)
def free_run(D: np.ndarray, x0: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
    """Simulate x' = A x + B u + c from x0, D = [A B c] (n, n + m + 1), u (N, m), out (N, n) with out[0] = x0."""
    n, m = out.shape[1], u.shape[1]
    out[0] = x0
    for k in range(len(u) - 1):
        for i in range(n):
            s = D[i, n + m]
            for j in range(n):
                s += D[i, j] * out[k, j]
            for j in range(m):
                s += D[i, n + j] * u[k, j]
            out[k + 1, i] = min(max(s, -1e6), 1e6)


@nb.njit(cache=True, nogil=True)
def normal_equations(
    D: np.ndarray, y: np.ndarray, u: np.ndarray, ok: np.ndarray, W: np.ndarray, length: int
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Compute cost, gradient, Gauss-Newton matrix and squared residual sums over segments of `length` samples.

    Each segment starts at its measured state; S = d y_hat / d par satisfies S' = A S + d(D z)/d par. A run outside
    +-50 has diverged: each later measured row costs the maximum error, `_MAX_ERROR`, with zero gradient.
    D (n, q); y (N, n); u (N, m); ok (N,) bool; W (n,) weights.
    """
    n, q = D.shape
    m = q - n - 1
    total = n * q
    H, g, squares = np.zeros((total, total)), np.zeros(total), np.zeros(n + 1)
    cost = 0.0
    z, x, x_next = np.zeros(q), np.zeros(n), np.zeros(n)
    A, S, S_next = D[:, :n].copy(), np.zeros((n, total)), np.zeros((n, total))
    z[q - 1] = 1.0
    running = diverged = False
    for k in range(len(y)):
        if k % length == 0 or not running:
            running, diverged = ok[k], False
            x[:] = y[k]
            S[:] = 0.0
        elif ok[k]:
            for i in range(n):
                e = _MAX_ERROR if diverged else min(max(y[k, i] - x[i], -_MAX_ERROR), _MAX_ERROR)
                cost += W[i] * e * e
                squares[i] += e * e
                for a in range(total):
                    sa = S[i, a] * W[i]
                    if sa != 0.0:
                        g[a] += sa * e
                        for b in range(a + 1):
                            H[a, b] += sa * S[i, b]
            squares[n] += 1.0
        for j in range(n):
            z[j] = x[j]
        for j in range(m):
            z[n + j] = u[k, j]
        S_next[:] = A @ S
        for i in range(n):
            s = 0.0
            for j in range(q):
                s += D[i, j] * z[j]
                S_next[i, i * q + j] += z[j]
            x_next[i] = min(max(s, -50.0), 50.0)
        x[:] = x_next
        S[:] = S_next
        if not np.abs(x).max() < 50.0:
            diverged = True
        if diverged:
            x[:] = 0.0
            S[:] = 0.0
    for a in range(total):
        for b in range(a):
            H[b, a] = H[a, b]
    return cost, g, H, squares


def refine(
    D0: np.ndarray,
    y: np.ndarray,
    u: np.ndarray,
    ok: np.ndarray,
    *,
    prior: np.ndarray,
    precision: np.ndarray,
    length: int,
    effective_fraction: float = 0.2,
    steps: int = 8,
) -> np.ndarray:
    """Refine [A B c] by damped Gauss-Newton on the prediction error of free runs.

    Args:
        D0: start, scaled units, (n, n + m + 1)
        y, u, ok: scaled outputs (N, n), inputs (N, m), measured rows (N,)
        prior: prior mean, (n, n + m + 1)
        precision: inverse prior variance, (n, n + m + 1)
        length: free-run length [samples]
        effective_fraction: effective fraction of residuals, which gusts correlate [-]
        steps: maximum Gauss-Newton steps
    Returns:
        the refined [A B c]; the start if no step descends
    """
    par0, Lambda = prior.ravel(), precision.ravel()
    shape, W = D0.shape, np.full(len(D0), 1.0)
    ok = np.ascontiguousarray(ok)
    newest = normal_equations(D0, y, u, ok, W, length)  # at the point evaluated last

    def linearise(par: np.ndarray, count: int) -> tuple[float, np.ndarray, np.ndarray]:
        nonlocal W, newest
        if count in _WEIGHT_UPDATES:
            squares = newest[3]
            W = effective_fraction / np.maximum(squares[:-1] / max(squares[-1], 1.0), 1e-4)
            newest = normal_equations(par.reshape(shape), y, u, ok, W, length)
        cost, g, H, _ = newest
        offset = par - par0
        return cost + float(Lambda @ offset**2), H + np.diag(Lambda), g - Lambda * offset

    def move(par: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, float]:
        nonlocal newest
        candidate = par + change
        newest = normal_equations(candidate.reshape(shape), y, u, ok, W, length)
        return candidate, newest[0] + float(Lambda @ (candidate - par0) ** 2)

    return gauss_newton(D0.ravel().copy(), linearise, move, steps=steps)[0].reshape(shape)
