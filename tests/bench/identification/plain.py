"""The least any model must beat: the mean of the window, and holding the last value."""

from dataclasses import dataclass

import numpy as np

from fleet.window import STATES

from .flight import Flight

_LAST = 3  # samples averaged for the last value
_PSI = STATES.index("psi")


@dataclass(frozen=True)
class Constant:
    """A model that says nothing ever changes from `x` (9,); in `held` it starts from the newest value."""

    x: np.ndarray
    held: np.ndarray

    def forecast(self, known: Flight, u: np.ndarray) -> np.ndarray:
        x = np.where(self.held, known.x[-_LAST:].mean(axis=0), self.x)
        return np.tile(x, (len(u), 1))

    def kstep(self, flight: Flight, k: int) -> np.ndarray:
        return np.where(self.held, flight.x[:-k], self.x)


class WindowMean:
    """Predict the mean of the window; of the heading, which has none, the last value."""

    def identify(self, known: Flight, start: int) -> Constant:
        x, ok = known.x[start:], known.ok[start:]
        return Constant(x[ok].mean(axis=0), np.arange(len(STATES)) == _PSI)


class Hold:
    """Predict the last value."""

    def identify(self, known: Flight, start: int) -> Constant:
        return Constant(np.zeros(len(STATES)), np.ones(len(STATES), bool))
