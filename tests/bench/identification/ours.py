"""Ours: the product's own identification, as the bench calls it. For now the two linear axes of the twin.

The bench makes one `Ours` per flight and calls `identify` for its windows in the order of time, so that it may start
warm from the window before. Nobody hands over rows that have not been flown yet: `known` ends where the window ends.
"""

from dataclasses import dataclass

import numpy as np

from fleet.frames import body_to_ned
from fleet.window import STATES, Window
from twin_worker.identify import AXES, Axis, identify_axis
from twin_worker.refine import free_run

from .flight import Flight

_FREE_RUN_S = 8.0  # of the prediction-error step [s]


@dataclass(frozen=True)
class Linear:
    """Both linear axes, as one model."""

    axes: tuple[Axis, ...]

    def forecast(self, known: Flight, u: np.ndarray) -> np.ndarray:
        """Run free from the last known row under the inputs u (n, 4): rows (n, 9), the first right after `known`."""
        x = np.vstack([known.x[-1], np.tile(known.x[-1], (len(u), 1))])
        window = _window(x, np.vstack([known.u[-1], u]), known.dt)
        for axis in reversed(self.axes):  # the longitudinal axis asks for the bank angle that the lateral one foretells
            y, inputs = axis.scaled(window)
            out = np.empty_like(y)
            free_run(axis.D, y[0], np.ascontiguousarray(inputs), out)
            window.x[:, _columns(axis)] = out * axis.y_scale + axis.y_mean
        return window.x[1:]

    def kstep(self, flight: Flight, k: int) -> np.ndarray:
        """Predict row i + k from row i, for every i: (n - k, 9)."""
        window = _window(flight.x, flight.u, flight.dt)
        out = np.empty((len(flight) - k, len(STATES)))
        for axis in self.axes:
            y, inputs = axis.scaled(window)
            n, x = y.shape[1], y[:-k]
            for j in range(k):
                rows = inputs[j : len(y) - k + j]
                x = np.clip(x @ axis.D[:, :n].T + rows @ axis.D[:, n:-1].T + axis.D[:, -1], -1e6, 1e6)
            out[:, _columns(axis)] = x * axis.y_scale + axis.y_mean
        return out


class Ours:
    """The identification of one flight."""

    def __init__(self) -> None:
        self._last: tuple[Axis | None, ...] = (None, None)

    def identify(self, known: Flight, start: int) -> Linear:
        """Identify on the rows from `start` to the end of `known`."""
        now = known.part(start, len(known))
        window = _window(now.x, now.u, now.dt, now.ok)
        self._last = tuple(
            identify_axis(axis, window, _FREE_RUN_S, last)[1] for axis, last in zip(AXES, self._last, strict=True)
        )
        return Linear(self._last)


def _columns(axis: Axis) -> list[int]:
    return [STATES.index(name) for name in axis.states]


def _window(x: np.ndarray, u: np.ndarray, dt: float, ok: np.ndarray | None = None) -> Window:
    """Lay a flight in the twin's own form; the wind is taken for none."""
    n = len(x)
    v = body_to_ned(x[:, 6], x[:, 7], x[:, 8], x[:, :3])
    good = np.ones(n, bool) if ok is None else ok
    return Window(dt * np.arange(n), x.copy(), u, np.cumsum(v * dt, axis=0), v, good, np.zeros(n, bool))
