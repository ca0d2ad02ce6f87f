"""Is what a model leaves over noise? The autocorrelation of its one-step residuals.

Source: Ljung 1999, section 16.6 (residual analysis).
"""

import numpy as np

LAGS = 20  # samples
_BOUND = 1.96  # of white noise, 95 %, over the root of its count


def whiteness(y: np.ndarray, y_hat: np.ndarray) -> np.ndarray:
    """Return the share of autocorrelations of y - y_hat within white noise's 95 % band, per column, 0..1.

    Args:
        y, y_hat: measured and predicted, (n, k); rows with nan, as every fresh start, are left out
    """
    e = (y - y_hat)[np.isfinite(y_hat).all(axis=1)]
    e = e[np.abs(e).sum(axis=1) > 0]
    if len(e) < 3 * LAGS:
        return np.zeros(y.shape[1])
    e = e - e.mean(axis=0)
    power = np.maximum((e**2).sum(axis=0), 1e-30)
    rho = np.array([(e[lag:] * e[:-lag]).sum(axis=0) / power for lag in range(1, LAGS + 1)])
    return (np.abs(rho) < _BOUND / np.sqrt(len(e))).mean(axis=0)
