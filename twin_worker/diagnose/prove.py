"""Proof: fitted on even blocks of 10 s, judged on odd ones."""

from dataclasses import dataclass

import numpy as np

from twin_worker.diagnose.foretell import blocks
from twin_worker.diagnose.guess import Guess
from twin_worker.diagnose.refine import refine
from twin_worker.diagnose.sight import Sight

HELD = 0.03  # share of the residual that must go on held-out data for a name
SHOWS = 1.15  # a channel's residual over its usual, from which it takes part in the proof


@dataclass(frozen=True)
class Proof:
    """Held-out evidence.

    Attributes:
        before, after: whitened rms on odd blocks without and with the effects, channels that show something
        fitted: the effects as fitted on even blocks
        kept: what each gains on odd blocks beside the others, doubled to compare with the whole flight
    """

    before: float
    after: float
    fitted: tuple[Guess, ...]
    kept: tuple[float, ...]

    @property
    def gain(self) -> float:
        """Give the share of the residual that went."""
        return 1.0 - self.after / self.before if self.before > 0 else 0.0


def held_out(sight: Sight, guesses: tuple[Guess, ...], shows: np.ndarray) -> Proof:
    """Fit on even blocks, judge on odd ones.

    Args:
        sight: the flight with nothing but its weather granted; it is left as it is
        guesses: as fitted on the whole flight
        shows: each channel's residual over its usual, (c,)
    """
    weather = sight.granted
    even, odd = (sight.part(blocks(sight.case.t, odd=side)) for side in (False, True))
    fitted = list(guesses)
    for _ in range(1 + (len(guesses) > 1)):
        for i, guess in enumerate(fitted):
            even.grant((*weather, *(g for k, g in enumerate(fitted) if k != i)))
            fitted[i] = refine(even, guess, rounds=3, move=False).guess
    use = shows > SHOWS if (shows > SHOWS).any() else np.ones_like(shows, bool)
    cost = odd.cost(fitted)
    kept = tuple(2.0 * (odd.cost([g for k, g in enumerate(fitted) if k != i]) - cost) for i in range(len(fitted)))
    before = _rms(odd, use)
    odd.grant((*weather, *fitted))
    return Proof(before, _rms(odd, use), tuple(fitted), kept)


def _rms(sight: Sight, use: np.ndarray) -> float:
    e = (sight.e + sight.Jn @ sight.xn)[sight.ok][:, use]
    return float(np.sqrt((e**2).mean())) if e.size else 0.0
