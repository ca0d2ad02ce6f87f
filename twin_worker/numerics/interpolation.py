"""Linear interpolation between rows, all columns at once."""

import numba as nb
import numpy as np


def straight(at: np.ndarray, t: np.ndarray, x: np.ndarray, beyond: float | None = None) -> np.ndarray:
    """Interpolate rows linearly, bit-identical to `numpy.interp` of each column.

    Args:
        query_t: requested times, in any order, (k,) [s]
        t: times of the rows, rising, at least one, (n,) [s]
        x: rows, (n, m)
        fill_value: value after the last row; None: the last row
    Returns:
        (k, m)
    """
    at, t, x = (np.ascontiguousarray(values, float) for values in (at, t, x))
    after = x[-1] if beyond is None else np.full(x.shape[1], beyond)
    out = np.empty((len(at), x.shape[1]))
    _lay(at, t, x, after, out)
    return out


@nb.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath
def _lay(at: np.ndarray, t: np.ndarray, x: np.ndarray, after: np.ndarray, out: np.ndarray) -> None:
    """Compute the rows at each time into `out`, (k, m)."""
    n, j = len(t), 0
    for k in range(len(at)):
        a = at[k]
        while j < n - 1 and t[j + 1] <= a:
            j += 1
        while j > 0 and t[j] > a:
            j -= 1
        for i in range(x.shape[1]):
            if a > t[n - 1]:
                out[k, i] = after[i]
            elif a <= t[0] or a == t[j] or n == 1:
                out[k, i] = x[j, i]
            else:
                slope = (x[j + 1, i] - x[j, i]) / (t[j + 1] - t[j])
                out[k, i] = slope * (a - t[j]) + x[j, i]
