"""A fault in time, and faults of the physics: increments of JSBSim properties and of the wind.

`vehicle.altered` defines the properties conceal/*.
"""

from collections.abc import Callable, Mapping
from math import cbrt, cos, inf, pi, radians, sin
from typing import NamedTuple

import numpy as np

from fleet.simulator.vehicle.jsbsim import KG_TO_LB, Aircraft
from fleet.simulator.vehicle.weather import FT, REFERENCE_M


class Fault(NamedTuple):
    """One fault of one aircraft."""

    name: str  # in `kinds.KINDS`
    part: str  # surface or axis; empty if there is only one
    values: Mapping[str, float]  # parameters, units in their names; faults compare by identity
    t0: float = 0.0  # onset [s since simulation start]
    ramp_s: float = 0.0  # ramp duration; edge duration of a transient [s]
    t1: float = inf  # end [s]

    def __hash__(self) -> int:
        """Hash by identity."""
        return id(self)

    def intensity(self, t: float) -> float:
        """Return the intensity at `t` [s], 0..1.

        A step or a linear ramp; a transient rises and falls as (1 - cos) / 2.
        """
        if not self.t0 <= t < self.t1:
            return 0.0
        if self.t1 < inf:
            edge = self.ramp_s or (self.t1 - self.t0) / 2
            edge_fraction = min(t - self.t0, self.t1 - t) / edge
            return (1 - cos(pi * min(edge_fraction, 1.0))) / 2
        return min((t - self.t0) / self.ramp_s, 1.0) if self.ramp_s > 0 else 1.0


_INCH = 0.0254  # [m]
_W20 = "atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"
_FLAP_DEG = 30.0  # full

Increments = dict[str, float]
PhysicsFault = Callable[[Aircraft, Mapping[str, float]], Increments]
"""Increments of JSBSim properties at full intensity."""


def _air_density(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    """Change density one third by pressure and two thirds by temperature."""
    cube_root = cbrt(values["density_ratio"])
    return {
        "atmosphere/P-sl-psf": aircraft["atmosphere/P-sl-psf"] * (cube_root - 1),
        "atmosphere/delta-T": aircraft["atmosphere/T-R"] * (1 / cube_root**2 - 1),
    }


def _turbulence(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    return {_W20: values["w20_mps"] / FT - aircraft[_W20], "atmosphere/turb-type": 3 - aircraft["atmosphere/turb-type"]}


def _thrust_loss(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    """Reduce propeller thrust (small) or volumetric efficiency (Cessna) by a fraction."""
    name = aircraft.kind.thrust_property
    return {name: -values["fraction"] * aircraft[name]}


def _mass_change(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    """Add mass at the centre of gravity."""
    mass_index = aircraft.kind.extra_index
    cg_properties = {
        f"inertia/pointmass-location-{axis}-inches{mass_index}": f"inertia/cg-{axis.lower()}-in" for axis in "XYZ"
    }
    offsets = {name: aircraft[centre] - aircraft[name] for name, centre in cg_properties.items()}
    return offsets | {f"inertia/pointmass-weight-lbs{mass_index}": values["dmass_kg"] * KG_TO_LB}


def _cg_shift(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    """Shift the payload; x points aft in JSBSim."""
    load = aircraft.kind.sliding_index
    mass_fraction = aircraft[f"inertia/pointmass-weight-lbs{load}"] / aircraft["inertia/weight-lbs"]
    return {f"inertia/pointmass-location-X-inches{load}": -values["dx_m"] / mass_fraction / _INCH}


PHYSICS_FAULTS: dict[str, PhysicsFault] = {
    "air_density": _air_density,
    "turbulence": _turbulence,
    "thrust_loss": _thrust_loss,
    "drag_increase": lambda aircraft, values: {"conceal/C_D": values["dCD"]},
    "icing": lambda aircraft, values: {"conceal/lift": -values["lift_loss"], "conceal/C_D": values["dCD"]},
    "flap_deployed": lambda aircraft, values: {"fcs/flap-cmd-norm": values["flap_deg"] / _FLAP_DEG},
    "mass_change": _mass_change,
    "cg_shift": _cg_shift,
    "prop_torque": lambda aircraft, values: {
        "propulsion/engine/propeller-sense": values["sense"] - aircraft["propulsion/engine/propeller-sense"]
    },
    "p_factor": lambda aircraft, values: {"conceal/p_factor": values["inches_per_rad"]},
    "slipstream_tail": lambda aircraft, values: {
        "conceal/slipstream": values["share"] - aircraft["conceal/slipstream"]
    },
}


def _horizontal_wind(values: Mapping[str, float], speed: float) -> np.ndarray:
    blows_from = radians(values["from_deg"])
    return -speed * np.array([cos(blows_from), sin(blows_from), 0.0])


WIND_FAULTS: dict[str, Callable[[Mapping[str, float], float], np.ndarray]] = {
    "wind_steady": lambda values, height: _horizontal_wind(values, values["speed_mps"]),
    "wind_shear": lambda values, height: _horizontal_wind(
        values, values["mps_per_100m"] * (height - REFERENCE_M) / 100.0
    ),
    "gust_discrete": lambda values, height: _horizontal_wind(values, values["speed_mps"]),
    "updraft": lambda values, height: np.array([0.0, 0.0, -values["speed_mps"]]),
}
"""(values, height above home [m]) to wind added, NED, (3,) [m/s]."""


class FaultyPhysics:
    """Physics faults of one aircraft."""

    def __init__(self, faults: list[Fault], aircraft: Aircraft):
        """Store the nominal properties; the aircraft is started already."""
        self._aircraft = aircraft
        self._winds = [fault for fault in faults if fault.name in WIND_FAULTS]
        physics_faults = [fault for fault in faults if fault.name in PHYSICS_FAULTS]
        self._changes = [(fault, PHYSICS_FAULTS[fault.name](aircraft, fault.values)) for fault in physics_faults]
        self._nominal = {name: aircraft[name] for _, change in self._changes for name in change}

    def apply(self, t: float, excluding: Fault | None = None) -> None:
        """Set the JSBSim properties for `t` [s], optionally excluding one fault."""
        values = dict(self._nominal)
        for fault, change in self._changes:
            intensity = 0.0 if fault is excluding else fault.intensity(t)
            for name, full_change in change.items():
                values[name] += intensity * full_change
        for name, value in values.items():
            if self._aircraft[name] != value:
                self._aircraft[name] = value

    def wind(self, t: float, height: float) -> np.ndarray:
        """Return the wind added at `t` [s] and `height` above home [m], NED, (3,) [m/s]."""
        winds = [fault.intensity(t) * WIND_FAULTS[fault.name](fault.values, height) for fault in self._winds]
        return np.sum([np.zeros(3), *winds], axis=0)
