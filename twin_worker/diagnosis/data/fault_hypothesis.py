"""A guess: one effect, on what, how large, since when."""

from dataclasses import dataclass, replace

import numpy as np

from fleet.effects import Effect, Onset


@dataclass(frozen=True)
class When:
    """The course of an effect: from the start, or from t0 on [s since the flight's zero], growing or passing over T."""

    kind: Onset = Onset.ALWAYS
    t0: float = 0.0
    T: float = 0.0

    def gate(self, t: np.ndarray) -> np.ndarray:
        """Return what the parameters are multiplied by, 0..1, (n,)."""
        if self.kind is Onset.ALWAYS:
            return np.ones_like(t)
        if self.kind is Onset.STEP:
            return (t >= self.t0).astype(float)
        share = np.clip((t - self.t0) / max(self.T, 1e-6), 0.0, 1.0)
        return share if self.kind is Onset.RAMP else np.sin(np.pi * share) ** 2

    @property
    def size(self) -> int:
        """Return how many numbers it takes."""
        return {Onset.ALWAYS: 0, Onset.STEP: 1}.get(self.kind, 2)

    def moved(self, dt: float) -> "When":
        """Shift the onset by dt [s]."""
        return replace(self, t0=self.t0 + dt)

    def stretched(self, by: float) -> "When":
        """Stretch the duration; what passes by is stretched about its middle."""
        earlier = 0.5 * (by - 1.0) * self.T if self.kind is Onset.BUMP else 0.0
        return replace(self, t0=self.t0 - earlier, T=self.T * by)


ALWAYS = When()


@dataclass(frozen=True)
class Guess:
    """One effect at work.

    Attributes:
        effect: which
        of: on what, one of `effect.of`, or empty
        par: its parameters, (k,)
        when: its course
    """

    effect: Effect
    of: str
    par: tuple[float, ...]
    when: When = ALWAYS

    @property
    def label(self) -> str:
        """Return effect and what it befalls, e.g. `actuator_lag:elevator`."""
        return f"{self.effect.name}:{self.of}" if self.of else self.effect.name

    @property
    def size(self) -> int:
        """Return how many numbers it is charged for, those of its course included."""
        return self.effect.price + self.when.size

    def at(self, par: np.ndarray, when: When | None = None) -> "Guess":
        """Return the same with other parameters, kept within what is physically possible."""
        low, high = (np.array([getattr(p, side) for p in self.effect.parameters]) for side in ("low", "high"))
        within = np.clip(np.asarray(par, float), low, high)
        return replace(self, par=tuple(float(x) for x in within), when=when or self.when)
