"""Refine [A B c] by the prediction error of free runs, with Gauss-Newton steps and a prior.

J = sum_k e' W e + (par - par0)' Lambda (par - par0),  e = y - y_hat,  y_hat a free run of one segment,
W = effective_fraction / residual variance.
Source: Huang 2021, eq. 16-17 (Newton-Raphson on J = e'e); Ljung 1999, section 10.2 (Gauss-Newton, damping).
"""

import numba as nb
import numpy as np
import scipy.linalg

from fleet.compiled_frames import assign

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
            assign(x, y[k])
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
        assign(S_next.ravel(), (A @ S).ravel())
        for i in range(n):
            s = 0.0
            for j in range(q):
                s += D[i, j] * z[j]
                S_next[i, i * q + j] += z[j]
            x_next[i] = min(max(s, -50.0), 50.0)
        assign(x, x_next)
        assign(S.ravel(), S_next.ravel())
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
    par, par0, Lambda = D0.ravel().copy(), prior.ravel(), precision.ravel()
    shape, W = D0.shape, np.full(len(D0), 1.0)
    ok = np.ascontiguousarray(ok)
    mu, best = 1e-3, np.inf
    slopes = None
    for step in range(steps):
        if slopes is None:
            cost, g, H, squares = normal_equations(par.reshape(shape), y, u, ok, W, length)
            if step in (0, 2):  # new weights from the residuals, then a new cost
                W = effective_fraction / np.maximum(squares[:-1] / max(squares[-1], 1.0), 1e-4)
                cost, g, H, squares = normal_equations(par.reshape(shape), y, u, ok, W, length)
            best = cost + float(Lambda @ (par - par0) ** 2)
            slopes = g, H
        g, H = slopes
        lhs = H + np.diag(Lambda + mu * (np.diag(H) + Lambda))
        scaling = 1 / np.sqrt(np.diag(lhs))  # variances differ by orders of magnitude
        scaled = scaling[:, None] * lhs * scaling
        trial = par + scaling * scipy.linalg.solve(scaled, scaling * (g - Lambda * (par - par0)), assume_a="pos")
        cost, g, H, _ = normal_equations(trial.reshape(shape), y, u, ok, W, length)
        total = cost + float(Lambda @ (trial - par0) ** 2)
        if np.isfinite(total) and total < best:
            converged = best - total < 1e-3 * best
            par, best, mu, slopes = trial, total, mu / 5, (None if step == 1 else (g, H))
            if converged:
                break
        else:
            mu *= 8
    return par.reshape(shape)
