"""The same zero-phase filter for everything: series on the 0.04 s grid to smooth values, or slopes, every 0.2 s."""

import numpy as np
from scipy.signal import firwin, upfirdn

DT = 0.04  # grid of a flight [s]
EVERY = 5  # grid steps between two residuals
STEP_S = DT * EVERY
CUT_HZ = 1.5  # band of the residuals
SLOW_HZ = 0.6  # band of those that compare two sensors
_HALF = 31  # half length of the filter [grid steps]

_LOW = firwin(2 * _HALF + 1, CUT_HZ, fs=1 / DT)
_SLOPE = np.convolve(_LOW, [0.5 / DT, 0.0, -0.5 / DT])
_SLOW = firwin(21, SLOW_HZ, fs=1 / STEP_S)
REACH = _HALF + 1  # grid steps on both sides that a value depends on


def smooth(x: np.ndarray) -> np.ndarray:
    """Return x, (n,), filtered and thinned, (n_thin,)."""
    return _thin(_LOW, x)


def slope(x: np.ndarray) -> np.ndarray:
    """Return dx/dt of x, (n,), filtered and thinned, (n_thin,) [1/s]."""
    return _thin(_SLOPE, x)


def slow(x: np.ndarray) -> np.ndarray:
    """Filter thinned columns, (n, k), further, to `SLOW_HZ`."""
    half = len(_SLOW) // 2
    padded = np.pad(x, ((half, half), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, _SLOW, mode="valid") for column in padded.T], axis=1)


def thinned(x: np.ndarray) -> np.ndarray:
    """Return every fifth value, as `smooth` does without filtering."""
    return x[::EVERY]


def whole(ok: np.ndarray, reach: int = REACH // 2) -> np.ndarray:
    """Tell which thinned values stand on good rows only, (n_thin,) bool; the filter's tails are let pass."""
    bad = np.convolve(~ok, np.ones(2 * reach + 1), mode="same") > 0.5
    return ~bad[::EVERY]


def _thin(taps: np.ndarray, x: np.ndarray) -> np.ndarray:
    half = len(taps) // 2
    lead = -2 * half % EVERY  # so that the first output falls on a multiple of the thinning
    padded = np.concatenate([np.full(lead + half, x[0]), x, np.full(half + EVERY, x[-1])])
    first = (2 * half + lead) // EVERY
    return upfirdn(taps, padded, 1, EVERY)[first : first + (len(x) + EVERY - 1) // EVERY]
