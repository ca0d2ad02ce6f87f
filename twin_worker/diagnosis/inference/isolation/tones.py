"""Detect a single tone in the residuals of a channel, as caused by flutter, surge or a limit cycle.

Noise and gusts spread over the whole band: no frequency contains more than a few percent of their power.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from twin_worker.diagnosis.inference.isolation.isolate import MIN_R2
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNEL_OF, CHANNELS

_BAND_HZ = 0.1, 1.45  # the mission is slower, the filter removes what is faster
_OVERSAMPLING = 2.0  # oversampling of the frequency resolution
_BLOCKS, _MIN_BLOCKS = 12, 4  # tested starts; least blocks after a start


class Tone(NamedTuple):
    """Peak of the periodogram over the mean power, channel, onset [s]; for a pure tone the ratio is the row count."""

    power_ratio: float
    channel: str
    t0: float


def find_tones(whitened: WhitenedResiduals) -> Iterator[Tone]:
    """Yield the strongest tone of each calibrated channel, with the nuisances profiled out."""
    t, profiled = (
        whitened.modelled.t,
        (whitened.e + np.einsum("tck,k->tc", whitened.Jn, whitened.xn)) * whitened.ok[:, None],
    )
    frequencies = np.arange(*_BAND_HZ, 1.0 / (_OVERSAMPLING * (t[-1] - t[0])))
    starts = np.linspace(0, len(t), _BLOCKS, endpoint=False).astype(int)
    waves = np.exp(-2j * np.pi * np.outer(t, frequencies))
    for equation, channel in CHANNEL_OF.items():
        if whitened.base.r2.get(equation, 1.0) > MIN_R2:
            x = profiled[:, CHANNELS.index(channel)]
            power = np.abs(_tail_sums(waves * x[:, None], starts)) ** 2 / (_tail_sums(x * x, starts)[:, None] + 1e-9)
            start, peak = np.unravel_index(int(np.argmax(power[:-_MIN_BLOCKS])), power[:-_MIN_BLOCKS].shape)
            yield Tone(2.0 * float(power[start, peak]), channel, float(t[starts[start]]))


def _tail_sums(x: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Sum x, (n, …), from each start to the end."""
    return np.cumsum(np.add.reduceat(x, starts, axis=0)[::-1], axis=0)[::-1]
