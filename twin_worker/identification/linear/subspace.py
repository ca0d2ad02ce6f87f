"""Predictor-based subspace identification of a state-space model.

The paper projects future outputs orthogonally to the inputs (Huang 2021, eq. 5-15; `projection`), which is
biased when an autopilot closes the loop. This form is consistent in closed loop: a vector autoregression models the
past, so that the innovations are uncorrelated with it.

Source: Chiuso 2007, "The role of vector autoregressive modeling in predictor-based subspace identification",
Automatica 43, 1034-1048 (PBSIDopt); D = 0.
"""

from dataclasses import dataclass

import numpy as np

from twin_worker.identification.linear.state_space import StateSpace
from twin_worker.numerics.ridge_regression import solve_ridge

PAST = 12  # samples of the past in the regression [-]
FUTURE = 8  # block rows of the observability matrix [-]
_RIDGE = 1e-3  # regularisation per sample [-]
_INPUT_PENALTY = 1e-5  # ridge penalty of B, c and x0 [-]
_MIN_INDEPENDENCE = 1e-8  # minimum fraction of a column that is independent of the others [-]


@dataclass(frozen=True)
class SubspaceStates:
    """States of all orders: the model of order n uses the first n.

    Attributes:
        x: sqrt(S) V', most important first, (most, N')
        y, u: outputs and inputs of the same samples, (N', l), (N', m)
        rows: indices of these samples, (N',)
    """

    x: np.ndarray
    y: np.ndarray
    u: np.ndarray
    rows: np.ndarray

    def model(self, order: int) -> StateSpace:
        """Solve x' = A x + B u + K e, y = C x + e for the first `order` states.

        Raises:
            ValueError: if there are fewer states; lower the order or widen the past.
        """
        if not 1 <= order <= len(self.x):
            raise ValueError(f"subspace: found order {order}, expected 1..{len(self.x)}; lower it or widen the past")
        x, m = self.x[:order], self.u.shape[1]
        C = np.linalg.lstsq(x.T, self.y, rcond=None)[0].T
        e = self.y - (C @ x).T
        consecutive = np.flatnonzero(np.diff(self.rows) == 1)
        regressor = np.hstack([x.T, self.u, e])[consecutive]
        coefficients = np.linalg.lstsq(regressor, x.T[consecutive + 1], rcond=None)[0].T
        return StateSpace.of(
            coefficients[:, :order], coefficients[:, order : order + m], C, K=coefficients[:, order + m :]
        )


def subspace_states(
    y: np.ndarray, u: np.ndarray, ok: np.ndarray, *, past: int = PAST, future: int = FUTURE
) -> SubspaceStates:
    """Estimate the states of all orders up to outputs times `future`.

    Args:
        y: outputs, zero mean and unit scale, (N, l)
        u: inputs, zero mean and unit scale, (N, m)
        ok: measured rows, (N,) bool
        past: samples in the vector autoregression, at least `future`
        future: block rows of the observability matrix
    Raises:
        ValueError: if there are too few gap-free rows; wait for a longer window.
    """
    n = y.shape[1]
    k = n + u.shape[1]
    past_rows = np.hstack([np.hstack([y[past - i : -i], u[past - i : -i]]) for i in range(1, past + 1)])
    unbroken = _unbroken(ok, past + 1)
    if unbroken.sum() < 3 * past * k:
        raise ValueError(f"subspace: found {unbroken.sum()} unbroken rows, needs {3 * past * k}; wait for more")
    z, target = past_rows[unbroken], y[past:][unbroken]
    moment = z.T @ z
    markov = np.linalg.solve(moment + _RIDGE * len(z) * np.eye(z.shape[1]), z.T @ target).T  # [C B~, C A~ B~, ...]
    # block row i of the observability matrix times the reachability matrix: the same coefficients, i steps later
    shifted = [np.hstack([markov[:, i * k :], np.zeros((n, i * k))]) for i in range(future)]
    product = np.vstack(shifted)
    squared, left_vectors = np.linalg.eigh(product @ moment @ product.T)  # of (product z')(product z')', a small matrix
    squared, left_vectors = np.maximum(squared[::-1], 1e-12), left_vectors[:, ::-1]
    x = squared[:, None] ** -0.25 * (left_vectors.T @ product @ z.T)  # sqrt(S) V'
    return SubspaceStates(x, target, u[past:][unbroken], np.flatnonzero(unbroken))


def _unbroken(ok: np.ndarray, length: int) -> np.ndarray:
    """Return at which rows `length` measured rows begin, (N - length + 1,) bool."""
    if len(ok) < length:
        return np.zeros(0, bool)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(ok, length).all(axis=1))


def pbsid(
    y: np.ndarray, u: np.ndarray, order: int, *, ok: np.ndarray | None = None, past: int = PAST, future: int = FUTURE
) -> StateSpace:
    """Identify a model of any order from open-loop or closed-loop data.

    Args:
        y: outputs, zero mean and unit scale, (N, l)
        u: inputs, zero mean and unit scale, (N, m)
        order: number of states, at most outputs times `future`
        ok: measured rows, (N,) bool; default all
        past, future: horizons [samples]
    Raises:
        ValueError: if the data are too short or not exciting enough; the message contains the remedy.
    """
    ok = np.ones(len(y), bool) if ok is None else ok
    check_excitation(y, u, ok)
    return subspace_states(y, u, ok, past=past, future=future).model(order)


def check_excitation(y: np.ndarray, u: np.ndarray, ok: np.ndarray) -> None:
    """Check that the data are finite and sufficiently exciting.

    Raises:
        ValueError: if columns are not finite, constant or linearly dependent, or rows are missing.
    """
    if not len(y) == len(u) == len(ok):
        raise ValueError(f"subspace: found {len(y)} outputs, {len(u)} inputs, {len(ok)} marks; pass equal numbers")
    for name, data in (("output", y[ok]), ("input", u[ok])):
        if not np.isfinite(data).all():
            column = int(np.argmin(np.isfinite(data).all(axis=0)))
            raise ValueError(f"subspace: {name} {column} is not finite in rows marked as measured; mark them not ok")
        centred = data - data.mean(axis=0) if len(data) else data
        norms = np.linalg.norm(centred, axis=0)
        if not len(data) or (norms <= 1e-12 * (1 + np.linalg.norm(data, axis=0))).any():
            column = int(np.argmin(norms))
            raise ValueError(f"subspace: {name} {column} is constant, expected some motion; excite it or leave it out")
        independent = np.abs(np.diag(np.linalg.qr(centred / norms, mode="r")))
        if len(centred) < centred.shape[1] or independent.min() < _MIN_INDEPENDENCE:
            column = int(np.argmin(independent))
            raise ValueError(f"subspace: {name} {column} repeats the columns before it; leave it out")


def subspace(y: np.ndarray, u: np.ndarray, ok: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Identify x' = A x + B u + K e, y = x + e of order n = number of outputs.

    Args:
        y: outputs, zero mean and unit scale, (N, n)
        u: inputs, zero mean and unit scale; a constant input gets almost no effect, (N, m)
        ok: measured rows, (N,) bool
    Returns:
        A (n, n), B (n, m)
    Raises:
        ValueError: if there are too few gap-free rows; wait for a longer window.
    """
    model = subspace_states(y, u, ok).model(y.shape[1]).outputs_as_states()
    return model.A, model.B


DEPTH = 12  # q: block rows of the Hankel matrices [-]


def projection(
    y: np.ndarray, u: np.ndarray, order: int, *, ok: np.ndarray | None = None, depth: int = DEPTH
) -> StateSpace:
    """Identify a model by orthogonal projection as in the paper.

    Args:
        y: outputs, zero mean and unit scale, (N, l)
        u: inputs, zero mean and unit scale, (N, m)
        order: number of states, at most outputs times (`depth` - 1)
        ok: measured rows, (N,) bool; default all
        depth: q of the paper [samples]
    Raises:
        ValueError: if the data are too short or not exciting enough; the message contains the remedy.
    """
    ok = np.ones(len(y), bool) if ok is None else ok
    check_excitation(y, u, ok)
    l, m = y.shape[1], u.shape[1]
    if not 1 <= order <= l * (depth - 1):
        raise ValueError(f"projection: found order {order}, expected 1..{l * (depth - 1)}; lower it or raise the depth")
    unbroken = _unbroken(ok, depth)
    if unbroken.sum() < 2 * depth * (l + m):
        raise ValueError(
            f"projection: found {unbroken.sum()} unbroken rows, needs {2 * depth * (l + m)}; wait for more"
        )
    Y, U = (_hankel(data, depth)[:, unbroken] for data in (y, u))  # eq. 9
    # eq. 11-13: projection of Y orthogonal to U by the triangular factor; the projector itself would be N x N
    R = np.asarray(np.linalg.qr(np.vstack([U, Y]).T, mode="r")).T
    left_vectors, singular, _ = np.linalg.svd(R[depth * m :, depth * m :])
    O = left_vectors[:, :order] * np.sqrt(singular[:order])  # eq. 14
    C, A = O[:l], np.linalg.lstsq(O[:-l], O[l:], rcond=None)[0]  # eq. 7
    start = StateSpace.of(A, np.zeros((order, m)), C)
    return fit_inputs(start.stabilised(), y, u, ok=ok)  # eq. 15


def fit_inputs(
    model: StateSpace, y: np.ndarray, u: np.ndarray, *, ok: np.ndarray, with_bias: bool = False
) -> StateSpace:
    """Solve B, x0 and, with a bias, c for given A and C by least squares on the free run.

    Args:
        model: A and C
        y, u: scaled outputs (N, l) and inputs (N, m)
        ok: fitted rows, (N,) bool; the others are simulated
        with_bias: include a constant state bias c
    Source: Huang 2021, eq. 15 with D = 0.
    """
    n, m = model.order, u.shape[1]
    w = np.hstack([u, np.ones((len(u), 1))]) if with_bias else u
    q = w.shape[1]
    responses = [
        StateSpace.of(model.A, unit[: n * q].reshape(n, q), model.C, x0=unit[n * q :]).run(w)[ok].ravel()
        for unit in np.eye(n * q + n)
    ]
    solution = solve_ridge(np.column_stack(responses), y[ok].ravel(), _INPUT_PENALTY)
    G = solution[: n * q].reshape(n, q)
    c = G[:, m] if with_bias else np.zeros(n)
    return StateSpace.of(model.A, G[:, :m], model.C, c=c, x0=solution[n * q :])


def _hankel(data: np.ndarray, depth: int) -> np.ndarray:
    """Return the block Hankel matrix: (N, k) to (depth k, N - depth + 1)."""
    windows = np.lib.stride_tricks.sliding_window_view(data, depth, axis=0)  # (N', k, depth)
    return windows.transpose(2, 1, 0).reshape(depth * data.shape[1], -1)
