"""First step: a state-space model straight from the data, by predictor-based subspace identification.

The paper projects future outputs orthogonally to the inputs (Huang 2021, eq. 5-15), which is biased when an
autopilot closes the loop. This is the closed-loop consistent form of the same idea: the past enters through a
vector autoregression, so that the innovations stay uncorrelated with it.

Source: Chiuso 2007, "The role of vector autoregressive modeling in predictor-based subspace identification",
Automatica 43, 1034-1048 (PBSIDopt); D = 0; the state is turned so that C = I.
"""

import numpy as np

PAST = 12  # samples of the past in the regression [-]
FUTURE = 8  # block rows of the observability matrix [-]


def subspace(y: np.ndarray, u: np.ndarray, ok: np.ndarray, ridge: float = 1e-3) -> tuple[np.ndarray, np.ndarray]:
    """Identify x' = A x + B u + K e, y = x + e of order n = number of outputs.

    Args:
        y: outputs, zero mean and unit scale, (N, n)
        u: inputs, likewise, (N, m)
        ok: rows that were measured, (N,) bool
        ridge: regularisation per sample [-]
    Returns:
        A (n, n), B (n, m)
    Raises:
        ValueError: when too few unbroken rows are left; wait for a longer window.
    """
    n, m = y.shape[1], u.shape[1]
    past = np.hstack([np.hstack([y[PAST - i : -i], u[PAST - i : -i]]) for i in range(1, PAST + 1)])
    whole = np.lib.stride_tricks.sliding_window_view(ok, PAST + 1).all(axis=1)
    if whole.sum() < 3 * past.shape[1]:
        raise ValueError(f"subspace: found {whole.sum()} unbroken rows, needs {3 * past.shape[1]}; wait for more")
    z, target = past[whole], y[PAST:][whole]
    gram = z.T @ z + ridge * len(z) * np.eye(z.shape[1])
    markov = np.linalg.solve(gram, z.T @ target).T  # [C B~, C A~ B~, ...], (n, PAST (n + m))
    # block row i of the observability matrix times the reachability matrix: the same coefficients, i steps later
    k = n + m
    shifted = [np.hstack([markov[:, i * k :], np.zeros((n, i * k))]) for i in range(FUTURE)]
    product = np.vstack(shifted)
    squared, left = np.linalg.eigh(product @ (z.T @ z) @ product.T)  # of (product z')(product z')', a small matrix
    weight = np.maximum(squared[::-1][:n], 1e-12) ** -0.25
    x = weight[:, None] * (left[:, ::-1][:, :n].T @ product @ z.T)  # sqrt(S) V', the states, (n, N')
    C = np.linalg.lstsq(x.T, target, rcond=None)[0].T
    e = target - (C @ x).T
    follows = np.flatnonzero(np.diff(np.flatnonzero(whole)) == 1)
    regressor = np.hstack([x.T, u[PAST:][whole], e])[follows]
    solved = np.linalg.lstsq(regressor, x.T[follows + 1], rcond=None)[0].T
    A, B = solved[:, :n], solved[:, n : n + m]
    turn = np.linalg.inv(C + 1e-9 * np.eye(n))
    return C @ A @ turn, C @ B
