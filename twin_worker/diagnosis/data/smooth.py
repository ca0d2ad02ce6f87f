"""Zero-phase low-pass filter and differentiator from the 0.04 s grid to the 0.2 s grid, the same for all series."""

import numpy as np
from scipy.signal import firwin, upfirdn

DT = 0.04  # grid of a flight [s]
DECIMATION = 5  # grid steps between two residuals
STEP_S = DT * DECIMATION
CUTOFF_HZ = 1.5  # band of the residuals
SLOW_CUTOFF_HZ = 0.6  # band of residuals between two sensors
_HALF = 31  # half length of the filter [grid steps]

_LOWPASS = firwin(2 * _HALF + 1, CUTOFF_HZ, fs=1 / DT)
_SLOPE = np.convolve(_LOWPASS, [0.5 / DT, 0.0, -0.5 / DT])
_SLOW = firwin(21, SLOW_CUTOFF_HZ, fs=1 / STEP_S)
HALF_SUPPORT = _HALF + 1  # half length of the filter support [grid steps]


def smooth(x: np.ndarray) -> np.ndarray:
    """Filter and decimate x, (n,), to (n_dec,)."""
    return _filter_decimated(_LOWPASS, x)


def slope(x: np.ndarray) -> np.ndarray:
    """Differentiate, filter and decimate x, (n,), to dx/dt, (n_dec,) [1/s]."""
    return _filter_decimated(_SLOPE, x)


def slow(x: np.ndarray) -> np.ndarray:
    """Filter decimated columns, (n, k), to `SLOW_CUTOFF_HZ`."""
    half = len(_SLOW) // 2
    padded = np.pad(x, ((half, half), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, _SLOW, mode="valid") for column in padded.T], axis=1)


def decimated(x: np.ndarray) -> np.ndarray:
    """Return every fifth value, the grid of `smooth`, without filtering."""
    return x[::DECIMATION]


def valid_decimated(ok: np.ndarray, half_support: int = HALF_SUPPORT // 2) -> np.ndarray:
    """Return which decimated values depend on valid rows only, (n_dec,) bool; ignores the tails of the filter."""
    bad = np.convolve(~ok, np.ones(2 * half_support + 1), mode="same") > 0.5
    return ~bad[::DECIMATION]


def _filter_decimated(taps: np.ndarray, x: np.ndarray) -> np.ndarray:
    half = len(taps) // 2
    lead = -2 * half % DECIMATION  # aligns the first output with the decimated grid
    padded = np.concatenate([np.full(lead + half, x[0]), x, np.full(half + DECIMATION, x[-1])])
    first = (2 * half + lead) // DECIMATION
    return upfirdn(taps, padded, 1, DECIMATION)[first : first + (len(x) + DECIMATION - 1) // DECIMATION]
