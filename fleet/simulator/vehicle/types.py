"""Types of simulated aircraft (JSBSim model, cruise speed, geometry, variations); initial situation of a flight."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from fleet.contract import Item
from fleet.simulator.vehicle.missions import SMALL_GEOMETRY, MissionGeometry, StartState
from fleet.simulator.vehicle.weather import FT, HELLMANN, MeanWind, wind_at_20ft

CRUISE = 23.0  # of the small aircraft [m/s]


class AircraftType(NamedTuple):
    """One type of aircraft."""

    model: str  # name in JSBSim
    from_jsbsim: bool  # part of the jsbsim package, with an engine to start
    cruise: float  # [m/s]
    throttle_property: str  # JSBSim property of the throttle, 0..1
    geometry: MissionGeometry  # mission geometry
    payload_kg: tuple[float, float]  # minimum, maximum
    spread: dict[str, float]  # standard deviation of each factor vary/* between aircraft of one type [-]
    offsets: dict[str, float]  # standard deviation of each offset vary/*: manufacturing asymmetry [-]
    thrust_property: str  # JSBSim property proportional to thrust
    payload_index: str  # index of the point mass with random payload
    sliding_index: str  # index of the point mass that can shift
    extra_index: str  # index of the point mass that `altered` adds
    xml: str | None = None  # content of the aircraft file; None: installed file
    settings: Mapping[str, float] = MappingProxyType({})  # JSBSim properties different from the file


_SPREAD = {
    "C_L_alpha": 0.04,
    "C_D_p": 0.08,
    "C_Y_beta": 0.08,
    "C_l_beta": 0.08,
    "C_l_p": 0.07,
    "C_l_delta_a": 0.07,
    "C_m_alpha": 0.08,
    "C_m_q": 0.08,
    "C_m_delta_e": 0.07,
    "C_n_beta": 0.08,
    "C_n_r": 0.10,
    "C_n_delta_r": 0.07,
    "thrust": 0.05,
}
_OFFSETS = {"C_l_0": 0.001, "C_m_0": 0.004, "C_n_0": 0.0004}

TYPES = {
    # 9.5 kg empty, span 2.9 m, electric; after Beard & McLain's Aerosonde
    "small": AircraftType(
        *("aerosonde", False, CRUISE, "fcs/motor-cmd-norm", SMALL_GEOMETRY, (0.5, 2.5), _SPREAD, _OFFSETS),
        *("vary/thrust", "", "", "[1]"),
    ),
    # Cessna 172P, a ton and a piston engine, part of JSBSim; only the payload varies
    "c172p": AircraftType(
        *("c172p", True, 48.0, "fcs/throttle-cmd-norm"),
        MissionGeometry(scale=5.0, circle=4.5, height=2.0, climb=0.045, sink=0.04),
        *((0.0, 90.0), {}, {}),
        *("propulsion/engine/volumetric-efficiency", "[1]", "", "[5]"),
    ),
}


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
