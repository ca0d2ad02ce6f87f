"""Subspace identification by orthogonal projection of future outputs, for open-loop data.

In closed loop the inputs depend on the noise of past outputs, which biases A; `subspace.py` has no such bias. This
module reproduces the paper and demonstrates the bias.

Source: Huang 2021, eq. 5-15; Verhaegen 1994 (ordinary MOESP); D = 0.
"""

import numpy as np

from twin_worker.identification.linear.black_box_prediction_error import fit_inputs
from twin_worker.identification.linear.state_space import StateSpace
from twin_worker.identification.linear.subspace import check_excitation

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
    unbroken = (
        np.lib.stride_tricks.sliding_window_view(ok, depth).all(axis=1) if len(ok) >= depth else np.zeros(0, bool)
    )
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


def _hankel(data: np.ndarray, depth: int) -> np.ndarray:
    """Return the block Hankel matrix: (N, k) to (depth k, N - depth + 1)."""
    windows = np.lib.stride_tricks.sliding_window_view(data, depth, axis=0)  # (N', k, depth)
    return windows.transpose(2, 1, 0).reshape(depth * data.shape[1], -1)
