"""Ridge regression, independent of the units of the terms."""

import numpy as np


def solve_ridge(A: np.ndarray, y: np.ndarray, penalty: float | np.ndarray) -> np.ndarray:
    """Return x of  min |y - A x|^2 + sum (penalty_k |a_k| x_k)^2, a_k the k-th column, (k,).

    Args:
        A: terms, (n, k)
        y: targets, (n,)
        penalty: fraction of a term's norm, scalar or (k,)
    Source: Hoerl & Kennard 1970 (ridge regression), terms scaled to unit length.
    """
    length = np.linalg.norm(A, axis=0) + 1e-12
    k = A.shape[1]
    rows, targets = np.vstack([A / length, np.diag(np.full(k, penalty))]), np.concatenate([y, np.zeros(k)])
    solution: np.ndarray = np.linalg.lstsq(rows, targets, rcond=None)[0] / length
    return solution
