"""Whiteness test of the one-step residuals of a model by their autocorrelation.

Source: Ljung 1999, section 16.6 (residual analysis).
"""

import numpy as np

LAGS = 20  # samples
_BOUND = 1.96  # 95 % bound of white noise, times the root of the count


def whiteness(y: np.ndarray, y_hat: np.ndarray) -> np.ndarray:
    """Return the fraction of autocorrelations of y - y_hat within the 95 % band of white noise, per column, 0..1.

    Args:
        y, y_hat: measured and predicted, (n, k); rows with nan, such as every start, are excluded
    """
    e = (y - y_hat)[np.isfinite(y_hat).all(axis=1)]
    e = e[np.abs(e).sum(axis=1) > 0]
    if len(e) < 3 * LAGS:
        return np.zeros(y.shape[1])
    e = e - e.mean(axis=0)
    power = np.maximum((e**2).sum(axis=0), 1e-30)
    rho = np.array([(e[lag:] * e[:-lag]).sum(axis=0) / power for lag in range(1, LAGS + 1)])
    return (np.abs(rho) < _BOUND / np.sqrt(len(e))).mean(axis=0)
