"""One flight of an aircraft: what the aircraft itself does not decide."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fleet.contract import Item
from fleet.simulator.vehicle.missions import Start
from fleet.simulator.vehicle.types import Type
from fleet.simulator.vehicle.weather import FT, HELLMANN, Wind, wind_at_20ft

Pilot = Callable[[float], tuple[float, float, float, float]]
"""Time [s] to what a test pilot adds to delta_a, delta_e, delta_r, delta_t."""


class Weather(NamedTuple):
    """The weather of one flight."""

    mean: float  # wind at 100 m [m/s]
    towards: float  # where it blows to, from north clockwise [rad]
    severity: int = 1  # of turbulence above 1000 ft, MIL-F-8785C
    exponent: float = HELLMANN  # of the wind over height; 0: the same everywhere
    drift: float = 1.0  # share of what `weather.Wind` has
    w20_mps: float | None = None  # wind at 20 ft the turbulence goes with, where the severity's own is not wanted

    def wind(self, rng: np.random.Generator, dt: float) -> Wind:
        """Make the wind, whose drift `rng` draws."""
        return Wind(self.mean, rng, dt, self.towards, exponent=self.exponent, drift=self.drift)

    @property
    def w20_fps(self) -> float:
        """The wind at 20 ft as JSBSim wants it."""
        return wind_at_20ft(self.severity) if self.w20_mps is None else self.w20_mps / FT


class Situation(NamedTuple):
    """One flight."""

    flight: int  # draws sensor errors, drift and turbulence
    kind: Type  # what flies
    plan: tuple[tuple[Item, ...], Start]
    weather: Weather
    pilot: Pilot | None = None  # a test pilot who excites what an autopilot leaves in peace
    examined: bool = False  # recorded on board, for an examination; the pitot tube is the aircraft's, not the flight's
