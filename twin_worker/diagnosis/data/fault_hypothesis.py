"""Fault hypothesis: one effect with its target, parameters and onset profile."""

from dataclasses import dataclass, replace

import numpy as np

from fleet.effects import Effect, Onset


@dataclass(frozen=True)
class OnsetProfile:
    """Onset profile of an effect: always, or from t0 on [s since the start]; a ramp or bump lasts T [s]."""

    kind: Onset = Onset.ALWAYS
    t0: float = 0.0
    T: float = 0.0

    def gate(self, t: np.ndarray) -> np.ndarray:
        """Return the factor of the parameters at times t, 0..1, (n,)."""
        if self.kind is Onset.ALWAYS:
            return np.ones_like(t)
        if self.kind is Onset.STEP:
            return (t >= self.t0).astype(float)
        share = np.clip((t - self.t0) / max(self.T, 1e-6), 0.0, 1.0)
        return share if self.kind is Onset.RAMP else np.sin(np.pi * share) ** 2

    @property
    def n_parameters(self) -> int:
        """Return the number of parameters of the profile."""
        return {Onset.ALWAYS: 0, Onset.STEP: 1}.get(self.kind, 2)

    def shifted(self, dt: float) -> "OnsetProfile":
        """Shift the onset by dt [s]."""
        return replace(self, t0=self.t0 + dt)

    def stretched(self, by: float) -> "OnsetProfile":
        """Scale the duration; a bump is scaled about its middle."""
        earlier = 0.5 * (by - 1.0) * self.T if self.kind is Onset.BUMP else 0.0
        return replace(self, t0=self.t0 - earlier, T=self.T * by)


ALWAYS = OnsetProfile()


@dataclass(frozen=True)
class FaultHypothesis:
    """One active effect.

    Attributes:
        effect: the effect
        of: target, one of `effect.of`, or empty
        par: parameters, (k,)
        onset: onset profile
    """

    effect: Effect
    target: str
    par: tuple[float, ...]
    onset: OnsetProfile = ALWAYS

    @property
    def label(self) -> str:
        """Return effect and target, e.g. `actuator_lag:elevator`."""
        return f"{self.effect.name}:{self.target}" if self.target else self.effect.name

    @property
    def degrees_of_freedom(self) -> int:
        """Return the number of parameters, those of the onset profile included."""
        return self.effect.degrees_of_freedom + self.onset.n_parameters

    def with_parameters(self, par: np.ndarray, onset: OnsetProfile | None = None) -> "FaultHypothesis":
        """Return a copy with other parameters, limited to their physical bounds."""
        low, high = (np.array([getattr(p, side) for p in self.effect.parameters]) for side in ("low", "high"))
        within = np.clip(np.asarray(par, float), low, high)
        return replace(self, par=tuple(float(x) for x in within), onset=onset or self.onset)
