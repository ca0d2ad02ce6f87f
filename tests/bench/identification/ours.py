"""Ours: the product's own identification, as the bench calls it.

The bench makes one `Ours` per flight and calls `identify` for its windows in the order of time, so that it may start
warm from the window before. Nobody hands over rows that have not been flown yet: `known` ends where the window ends.
"""

from dataclasses import dataclass, replace

import numpy as np

from fleet.airframes import Airframe, load
from fleet.frames import body_to_ned, ned_to_body
from fleet.physics.actuators import TAU, lagged
from fleet.window import Window
from twin_worker.coupled import Coupled, identify
from twin_worker.observer import Observer
from twin_worker.wind import WindFilter

from .flight import Flight
from .gusty import WEATHER

_LEAD = 250  # rows that settle lags and filter
_WIND_S = 0.2  # between rows the wind filter takes [s]


@dataclass(frozen=True)
class Seen:
    """One identified aircraft, as the bench asks for it."""

    eye: Observer

    def forecast(self, known: Flight, u: np.ndarray) -> np.ndarray:
        """Run free from the end of `known` under the inputs u (n, 4): rows (n, 9), the first right after `known`."""
        past = known.part(max(len(known) - _LEAD, 0), len(known))
        delta = lagged(np.vstack([past.u, u]), known.dt, TAU)
        now = self.eye.track(past.x, delta[: len(past)])[-1:]
        return self.eye.fly(now, np.array([len(past) - 1]), len(u) + 1, delta)[0, 1:]

    def kstep(self, flight: Flight, k: int) -> np.ndarray:
        """Predict row i + k from the rows up to i, for every i: (n - k, 9)."""
        delta = lagged(flight.u, flight.dt, TAU)
        begins = np.arange(len(flight) - k)
        return self.eye.fly(self.eye.track(flight.x, delta)[begins], begins, k + 1, delta)[:, k]


class Ours:
    """The identification of one flight."""

    def __init__(self) -> None:
        self._wind = WindFilter()
        self._heard = 0
        self._found: list[Coupled] = []

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
        last = next((one for one in reversed(self._found) if one.t1 <= window.t[0]), None)
        model = identify(window, wind, airframe(known), last)
        self._found.append(model)
        return Seen(Observer(model, known.dt))


def airframe(flight: Flight) -> Airframe:
    """Give what is known of the aircraft: the yardstick's type, else a class at this span."""
    yardstick = flight.name.split("-")[0] in WEATHER
    return load("aerosonde") if yardstick else replace(load("small_fixed_wing"), span=flight.b)
