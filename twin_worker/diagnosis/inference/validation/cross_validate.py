"""Cross-validation: fit effects on even blocks of 10 s, evaluate them on odd blocks."""

from dataclasses import dataclass

import numpy as np

from fleet.effects import Onset, Stage
from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.inference.validation.force_prediction import blocks

HELD = 0.03  # least relative drop of the held-out rms residual for a named effect
_JUMP_S = 2.0  # a sensor jump is visible within this time of its onset
_SHORT_S, _PASSES = 2.0, 0.01  # block length for transient effects; least gate value at which they act
SHOWS = 1.15  # least ratio of mean square to usual of a channel that takes part
_TAKEN = 0.95  # or largest share of the mean square that remains on the blocks of the fit


@dataclass(frozen=True)
class Proof:
    """Held-out evidence.

    Attributes:
        before, after: whitened rms on odd blocks without and with the effects, in the affected channels
        fitted: the effects as fitted on even blocks
        held_out_gains: gain of each effect on odd blocks given the others, doubled to compare with the whole flight
    """

    before: float
    after: float
    fitted: tuple[Guess, ...]
    kept: tuple[float, ...]

    @property
    def gain(self) -> float:
        """Return the relative drop of the rms residual."""
        return 1.0 - self.after / self.before if self.before > 0 else 0.0


def held_out(sight: Sight, guesses: tuple[Guess, ...], shows: np.ndarray) -> Proof:
    """Fit the effects on even blocks and evaluate them on odd blocks.

    Args:
        whitened: residuals conditioned on the weather alone; not modified
        hypotheses: as fitted on the whole flight
        channel_ratio: mean square of each channel over its usual, (c,)
    """
    weather = sight.granted
    even, odd = (sight.part(_half(sight, guesses, odd=side)) for side in (False, True))
    fitted = list(guesses)
    for _ in range(1 + (len(guesses) > 1)):
        for i, guess in enumerate(fitted):
            even.grant((*weather, *(g for k, g in enumerate(fitted) if k != i)))
            fitted[i] = refine(even, guess, rounds=3, move=False).guess
    even.grant(weather)
    unexplained = _powers(even)
    even.grant((*weather, *fitted))
    use = (shows > SHOWS) | (_powers(even) < _TAKEN * unexplained)
    use = use if use.any() else np.ones_like(use)
    cost = odd.cost(fitted)
    kept = tuple(2.0 * (odd.cost([g for k, g in enumerate(fitted) if k != i]) - cost) for i in range(len(fitted)))
    before = _rms(odd, use)
    odd.grant((*weather, *fitted))
    return Proof(before, _rms(odd, use), tuple(fitted), kept)


def _half(sight: Sight, guesses: tuple[Guess, ...], odd: bool) -> np.ndarray:
    """Return the rows of one half, (n,) bool.

    Transient effects use shorter blocks while they act. Sensor jumps use every second row around the onset, because
    slow noise hides them elsewhere.
    """
    t = sight.case.t
    if all(guess.when.kind is Onset.BUMP for guess in guesses):
        passing = np.any([guess.when.gate(t) > _PASSES for guess in guesses], axis=0)
        return passing & ((np.floor(t / _SHORT_S) % 2 == 1) == odd)
    jumps = [g.when.t0 for g in guesses if g.effect.stage is Stage.SENSOR and g.when.kind is Onset.STEP]
    near = np.any([np.abs(t - t0) < _JUMP_S for t0 in jumps], axis=0) if jumps else np.zeros(len(t), bool)
    return np.where(near, (np.arange(len(t)) % 2 == 1) == odd, blocks(t, odd=odd))


def _powers(sight: Sight) -> np.ndarray:
    """Return the mean square of each channel, the nuisances profiled out, (c,)."""
    e = (sight.e + sight.Jn @ sight.xn)[sight.ok]
    return (e**2).mean(axis=0) if e.size else np.zeros(e.shape[1])


def _rms(sight: Sight, use: np.ndarray) -> float:
    return float(np.sqrt(_powers(sight)[use].mean()))
