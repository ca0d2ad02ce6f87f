"""Interpolation between rows, linear or zero-order hold, all columns at once."""

import numba as nb
import numpy as np


def interpolate_rows(query_t: np.ndarray, t: np.ndarray, x: np.ndarray, fill_value: float | None = None) -> np.ndarray:
    """Interpolate rows linearly, bit-identical to `numpy.interp` of each column.

    Args:
        query_t: requested times, in any order, (k,) [s]
        t: times of the rows, rising, at least one, (n,) [s]
        x: rows, (n, m)
        fill_value: value after the last row; None: the last row
    Returns:
        (k, m)
    """
    query_t, t, x = (np.ascontiguousarray(values, float) for values in (query_t, t, x))
    end_row = x[-1] if fill_value is None else np.full(x.shape[1], fill_value)
    out = np.empty((len(query_t), x.shape[1]))
    _interpolate_each(query_t, t, x, end_row, out)
    return out


@nb.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath
def _interpolate_each(query_t: np.ndarray, t: np.ndarray, x: np.ndarray, end_row: np.ndarray, out: np.ndarray) -> None:
    """Compute the rows at each time into `out`, (k, m)."""
    n, j = len(t), 0
    for k in range(len(query_t)):
        a = query_t[k]
        while j < n - 1 and t[j + 1] <= a:
            j += 1
        while j > 0 and t[j] > a:
            j -= 1
        for i in range(x.shape[1]):
            if a > t[n - 1]:
                out[k, i] = end_row[i]
            elif a <= t[0] or a == t[j] or n == 1:
                out[k, i] = x[j, i]
            else:
                slope = (x[j + 1, i] - x[j, i]) / (t[j + 1] - t[j])
                out[k, i] = slope * (a - t[j]) + x[j, i]


def zero_order_hold(t: np.ndarray, x: np.ndarray, query_t: np.ndarray, max_age: float) -> np.ndarray:
    """Sample rows with zero-order hold, nan before the first and after `max_age` seconds, (len(query_t), k)."""
    if not len(t):
        return np.full((len(query_t), x.shape[1]), np.nan)
    out = np.empty((len(query_t), x.shape[1]))
    _hold_rows(t, x, np.ascontiguousarray(query_t), max_age, out)
    return out


@nb.njit(cache=True, nogil=True)
def _hold_rows(t: np.ndarray, x: np.ndarray, query_t: np.ndarray, max_age: float, out: np.ndarray) -> None:
    """Compute the last row before each of the rising times, nan if there is none or it is too old, (k, m)."""
    k = -1
    for i in range(len(query_t)):
        while k + 1 < len(t) and t[k + 1] <= query_t[i]:
            k += 1
        valid = k >= 0 and not query_t[i] - t[k] > max_age
        for j in range(x.shape[1]):
            out[i, j] = x[k, j] if valid else np.nan
