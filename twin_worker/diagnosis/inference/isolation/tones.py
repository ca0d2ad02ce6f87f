"""Detect a single tone in the residuals of a channel, as caused by flutter, surge or a limit cycle.

Noise and gusts spread over the whole band: no frequency contains more than a few percent of their power.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from twin_worker.diagnosis.inference.isolation.isolate import WELL
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.model.baseline import CHANNELS, SHOWN_BY

_BAND_HZ = 0.1, 1.45  # the mission is slower, the filter removes what is faster
_FINE = 2.0  # oversampling of the frequency resolution
_BLOCKS, _AFTER = 12, 4  # tested starts; least blocks after a start


class Tone(NamedTuple):
    """Peak of the periodogram over the mean power, channel, onset [s]; for a pure tone the ratio is the row count."""

    worth: float
    channel: str
    t0: float


def tones(sight: Sight) -> Iterator[Tone]:
    """Yield the strongest tone of each calibrated channel, with the nuisances profiled out."""
    t, left = sight.case.t, (sight.e + np.einsum("tck,k->tc", sight.Jn, sight.xn)) * sight.ok[:, None]
    hertz = np.arange(*_BAND_HZ, 1.0 / (_FINE * (t[-1] - t[0])))
    starts = np.linspace(0, len(t), _BLOCKS, endpoint=False).astype(int)
    waves = np.exp(-2j * np.pi * np.outer(t, hertz))
    for equation, channel in SHOWN_BY.items():
        if sight.base.r2.get(equation, 1.0) > WELL:
            x = left[:, CHANNELS.index(channel)]
            power = np.abs(_onwards(waves * x[:, None], starts)) ** 2 / (_onwards(x * x, starts)[:, None] + 1e-9)
            start, at = np.unravel_index(int(np.argmax(power[:-_AFTER])), power[:-_AFTER].shape)
            yield Tone(2.0 * float(power[start, at]), channel, float(t[starts[start]]))


def _onwards(x: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Sum x, (n, …), from each start to the end."""
    return np.cumsum(np.add.reduceat(x, starts, axis=0)[::-1], axis=0)[::-1]
