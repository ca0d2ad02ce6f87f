"""Ours: the product's own identification, as the bench calls it.

The bench makes one `Ours` per flight and calls `identify` for its windows in the order of time, so that it may start
warm from the window before. Nobody hands over rows that have not been flown yet: `known` ends where the window ends.
"""

from dataclasses import dataclass, replace

import numpy as np

from fleet.airframes import Airframe, load
from fleet.frames import body_to_ned, ned_to_body
from fleet.physics.simulate import TAU, lagged
from fleet.window import Window
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.derivatives_model import identify
from twin_worker.validation.forecast_shrinkage import Shrinkage, runs_and_measured
from twin_worker.validation.gust_observer import AlphaBetaFilter

from .flight import Flight
from .gusty import WEATHER

_LEAD = 250  # rows that settle lags and filter
_SETTLE = 50  # rows that settle the filter before runs are judged
_AHEAD_S, _EVERY_S = 40.0, 2.0  # runs judged: how long, how often
_IN_SAMPLE = 0.5  # worth of runs over data the model has seen
_WIND_S = 0.2  # between rows the wind filter takes [s]


@dataclass(frozen=True)
class Seen:
    """One identified aircraft, as the bench asks for it."""

    eye: AlphaBetaFilter
    earned: Shrinkage
    mean: np.ndarray  # of the states over the stretch, (9,)

    def runs(self, x: np.ndarray, u: np.ndarray, begins: np.ndarray, length: int) -> np.ndarray:
        """Run free from rows of a stretch, `length` rows each with the one begun at, (m, length, 9)."""
        delta = lagged(u, self.eye.dt, TAU)
        return self.eye.free_run(self.eye.filter(x, delta[: len(x)])[begins], begins, length, delta)

    def forecast(self, known: Flight, u: np.ndarray) -> np.ndarray:
        """Run free from the end of `known` under the inputs u (n, 4): rows (n, 9), the first right after `known`."""
        past = known.part(max(len(known) - _LEAD, 0), len(known))
        run = self.runs(past.x, np.vstack([past.u, u]), np.array([len(past) - 1]), len(u) + 1)[0, 1:]
        return self.earned.forecast(run, past.x[-1], self.mean, self.eye.dt * np.arange(1, len(u) + 1))

    def kstep(self, flight: Flight, k: int) -> np.ndarray:
        """Predict row i + k from the rows up to i, for every i: (n - k, 9)."""
        begins = np.arange(len(flight) - k)
        run = self.runs(flight.x, flight.u, begins, k + 1)[:, k:]
        return self.earned.forecast(run, flight.x[begins], self.mean, self.eye.dt * np.array([k]))[:, 0]

    def look_back(self, flight: Flight, weight: float, earned: Shrinkage | None = None) -> None:
        """Learn from a stretch what the runs are worth."""
        begins = np.arange(_SETTLE, len(flight) - round(1 / flight.dt), round(_EVERY_S / flight.dt))
        y, delta = np.where(flight.ok[:, None], flight.x, np.nan), lagged(flight.u, flight.dt, TAU)
        runs, flown = runs_and_measured(self.eye, y, delta, begins, _AHEAD_S)
        (earned or self.earned).update(runs, flown, self.mean, flight.dt, weight)


class Ours:
    """The identification of one flight."""

    def __init__(self) -> None:
        self._wind = WindFilter()
        self._heard = 0
        self._seen: Seen | None = None
        self._earned = Shrinkage()
        self._taught = 0  # rows of the flight the lessons have reached

    def identify(self, known: Flight, start: int) -> Seen:
        """Identify on the rows from `start` to the end of `known`."""
        v = body_to_ned(known.x[:, 6], known.x[:, 7], known.x[:, 8], known.x[:, :3])
        for k in range(self._heard, len(known), max(round(_WIND_S / known.dt), 1)):
            if np.isfinite(known.Va[k]):
                self._wind.update(float(known.t[k]), v[k], float(known.Va[k]), float(known.x[k, 8]))
        self._heard = len(known)
        wind = self._wind.wind
        air = known.x.copy()
        air[:, :3] = ned_to_body(known.x[:, 6], known.x[:, 7], known.x[:, 8], v - wind)
        s = slice(start, None)
        n = len(known) - start
        window = Window(known.t[s], air[s], known.u[s], np.zeros((n, 3)), v[s], known.ok[s], np.zeros(n, bool))
        model = identify(window, wind, airframe(known), self._seen.eye.model if self._seen else None)
        stretch = known.part(start, len(known))
        if self._seen:
            self._seen.look_back(known.part(self._taught, len(known)), 1.0, self._earned)
        seen = Seen(AlphaBetaFilter(model, known.dt), self._earned.copy(), stretch.x[stretch.ok].mean(axis=0))
        seen.look_back(stretch, _IN_SAMPLE)
        self._seen, self._taught = seen, len(known)
        return seen


def airframe(flight: Flight) -> Airframe:
    """Give what is known of the aircraft: the yardstick's type, else a class at this span."""
    yardstick = flight.name.split("-")[0] in WEATHER
    return load("aerosonde") if yardstick else replace(load("small_fixed_wing"), span=flight.b)
