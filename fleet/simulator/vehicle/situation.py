"""Conditions of one flight: type, mission, weather and test pilot."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fleet.contract import Item
from fleet.simulator.vehicle.missions import StartState
from fleet.simulator.vehicle.types import AircraftType
from fleet.simulator.vehicle.weather import FT, HELLMANN, MeanWind, wind_at_20ft

Pilot = Callable[[float], tuple[float, float, float, float]]
"""Time [s] to the test pilot increments of delta_a, delta_e, delta_r, delta_t."""


class Weather(NamedTuple):
    """The weather of one flight."""

    mean: float  # wind at 100 m [m/s]
    towards: float  # direction it blows to, clockwise from north [rad]
    severity: int = 1  # of turbulence above 1000 ft, MIL-F-8785C
    exponent: float = HELLMANN  # of the wind profile over height; 0: uniform
    drift: float = 1.0  # factor of the drift of `weather.MeanWind`
    w20_mps: float | None = None  # wind at 20 ft for turbulence; None: that of the severity

    def wind(self, rng: np.random.Generator, dt: float) -> MeanWind:
        """Create the wind model; `rng` draws its drift."""
        return MeanWind(self.mean, rng, dt, self.towards, exponent=self.exponent, drift=self.drift)

    @property
    def w20_fps(self) -> float:
        """Wind at 20 ft for JSBSim [ft/s]."""
        return wind_at_20ft(self.severity) if self.w20_mps is None else self.w20_mps / FT


class FlightSetup(NamedTuple):
    """Conditions of one flight."""

    flight_seed: int  # seed of sensor errors, drift and turbulence
    kind: AircraftType  # aircraft type
    mission: tuple[tuple[Item, ...], StartState]
    weather: Weather
    pilot: Pilot | None = None  # inputs that excite more than the autopilot does
    is_exam: bool = False  # onboard recording for a blind test; the pitot scale is then fixed per aircraft
