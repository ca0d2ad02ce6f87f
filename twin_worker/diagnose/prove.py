"""Proof: fitted on even blocks of 10 s, judged on odd ones; and the simulation flown with and without the effect."""

from dataclasses import dataclass

import numpy as np

from fleet.effects import Stage
from twin_worker.diagnose.guess import Guess
from twin_worker.diagnose.refine import refine
from twin_worker.diagnose.residual import Case
from twin_worker.diagnose.sight import Sight
from twin_worker.diagnose.simulate import Simulation
from twin_worker.diagnose.smooth import DT, EVERY

BLOCK_S = 10.0
_SHOWS = 1.15  # a channel's residual over its usual, from which it takes part in the proof


def blocks(t: np.ndarray, odd: bool) -> np.ndarray:
    """Tell which times lie in odd, or in even, blocks of 10 s."""
    return (np.floor(t / BLOCK_S) % 2 == 1) == odd


@dataclass(frozen=True)
class Proof:
    """Held-out evidence.

    Attributes:
        before, after: whitened rms on odd blocks without and with the effects, channels that show something
        fitted: the effects as fitted on even blocks
    """

    before: float
    after: float
    fitted: tuple[Guess, ...]

    @property
    def gain(self) -> float:
        """Give the share of the residual that went."""
        return 1.0 - self.after / self.before if self.before > 0 else 0.0


def held_out(case: Case, weather: tuple[Guess, ...], guesses: tuple[Guess, ...], shows: np.ndarray) -> Proof:
    """Fit on even blocks, judge on odd ones.

    Args:
        case: the flight; weather: granted throughout
        guesses: as fitted on the whole flight
        shows: each channel's residual over its usual, (c,)
    """
    even = Sight(case, weather, blocks(case.t, odd=False))
    fitted = list(guesses)
    for _ in range(1 + (len(guesses) > 1)):
        for i, guess in enumerate(fitted):
            even.grant((*weather, *(g for k, g in enumerate(fitted) if k != i)))
            fitted[i] = refine(even, guess, rounds=3).guess
    odd = Sight(case, weather, blocks(case.t, odd=True))
    use = shows > _SHOWS if (shows > _SHOWS).any() else np.ones_like(shows, bool)

    def rms() -> float:
        return float(np.sqrt(((odd.e + odd.Jn @ odd.xn)[odd.ok][:, use] ** 2).mean()))

    before = rms()
    odd.grant((*weather, *fitted))
    return Proof(before, rms(), tuple(fitted))


def by_instruments(case: Case, guesses: tuple[Guess, ...]) -> np.ndarray:
    """Give the specific force the simulation predicts from what the instruments say, (n, 3) on the thinned grid."""
    s, delta = case.sensed(guesses), case.inputs(guesses)
    x = np.stack([s[name] for name in ("v_n", "v_e", "v_d", "p", "q", "r", "phi", "theta", "psi", "h")])
    sim = Simulation(case.base, [guesses] * len(case.t), case.t, case.flight.ground)
    return sim.rates(x, delta, case.t, case.used)[1].T


def by_flying(case: Case, guesses: tuple[Guess, ...], seconds: float = BLOCK_S) -> np.ndarray:
    """Give the specific force of free flights of the simulation, one a block from its measured start, (n, 3)."""
    s, t = case.sensed(guesses), case.flight.t
    n = int(seconds / DT)
    first = np.ceil(t[0] / seconds) * seconds
    starts = np.rint((np.arange(first, t[-1] - 1.0, seconds) - t[0]) / DT).astype(int)
    starts = np.unique(starts // EVERY * EVERY)
    x = np.stack(
        [s[name][starts // EVERY] for name in ("v_n", "v_e", "v_d", "p", "q", "r", "phi", "theta", "psi", "h")]
    )
    acting = [g for g in guesses if g.effect.stage is not Stage.SENSOR]
    sim = Simulation(case.base, [acting] * len(starts), t[starts], case.flight.ground)
    commands = np.pad(case.flight.commands, ((0, n), (0, 0)), mode="edge")
    runs = sim.fly(x, lambda k, _: commands[starts + k].T, n)
    out = np.full((len(t) + n, 3), np.nan)
    for run, start in enumerate(starts):
        out[start : start + n] = runs.force[:, :, run]
    return out[: len(t)]
