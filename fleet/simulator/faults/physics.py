"""Faults of the physics: increments of JSBSim properties and of the wind.

`vehicle.altered` defines the properties conceal/*.
"""

from collections.abc import Callable, Mapping
from math import cbrt, cos, radians, sin

import numpy as np

from fleet.simulator.faults.fault import Fault
from fleet.simulator.vehicle.jsbsim import KG_TO_LB, Aircraft
from fleet.simulator.vehicle.weather import FT, REFERENCE_M

_INCH = 0.0254  # [m]
_W20 = "atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"
_FLAP_DEG = 30.0  # full

Increments = dict[str, float]
Change = Callable[[Aircraft, Mapping[str, float]], Increments]
"""Increments of JSBSim properties at full intensity."""


def _air_density(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    """Change density one third by pressure and two thirds by temperature."""
    third = cbrt(values["density_ratio"])
    return {
        "atmosphere/P-sl-psf": aircraft["atmosphere/P-sl-psf"] * (third - 1),
        "atmosphere/delta-T": aircraft["atmosphere/T-R"] * (1 / third**2 - 1),
    }


def _turbulence(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    return {_W20: values["w20_mps"] / FT - aircraft[_W20], "atmosphere/turb-type": 3 - aircraft["atmosphere/turb-type"]}


def _thrust_loss(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    """Reduce propeller thrust (small) or volumetric efficiency (Cessna) by a fraction."""
    name = aircraft.kind.strength
    return {name: -values["fraction"] * aircraft[name]}


def _mass_change(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    """Add mass at the centre of gravity."""
    last = aircraft.kind.extra
    here = {f"inertia/pointmass-location-{axis}-inches{last}": f"inertia/cg-{axis.lower()}-in" for axis in "XYZ"}
    moved = {name: aircraft[centre] - aircraft[name] for name, centre in here.items()}
    return moved | {f"inertia/pointmass-weight-lbs{last}": values["dmass_kg"] * KG_TO_LB}


def _cg_shift(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    """Shift the payload; x points aft in JSBSim."""
    load = aircraft.kind.load
    share = aircraft[f"inertia/pointmass-weight-lbs{load}"] / aircraft["inertia/weight-lbs"]
    return {f"inertia/pointmass-location-X-inches{load}": -values["dx_m"] / share / _INCH}


CHANGES: dict[str, Change] = {
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


def _level(values: Mapping[str, float], speed: float) -> np.ndarray:
    blows_from = radians(values["from_deg"])
    return -speed * np.array([cos(blows_from), sin(blows_from), 0.0])


WINDS: dict[str, Callable[[Mapping[str, float], float], np.ndarray]] = {
    "wind_steady": lambda values, height: _level(values, values["speed_mps"]),
    "wind_shear": lambda values, height: _level(values, values["mps_per_100m"] * (height - REFERENCE_M) / 100.0),
    "gust_discrete": lambda values, height: _level(values, values["speed_mps"]),
    "updraft": lambda values, height: np.array([0.0, 0.0, -values["speed_mps"]]),
}
"""(values, height above home [m]) to wind added, NED, (3,) [m/s]."""


class World:
    """Physics faults of one aircraft."""

    def __init__(self, faults: list[Fault], aircraft: Aircraft):
        """Store the nominal properties; the aircraft is started already."""
        self._aircraft = aircraft
        self._winds = [fault for fault in faults if fault.name in WINDS]
        others = [fault for fault in faults if fault.name in CHANGES]
        self._changes = [(fault, CHANGES[fault.name](aircraft, fault.values)) for fault in others]
        self._usual = {name: aircraft[name] for _, change in self._changes for name in change}

    def press(self, t: float, without: Fault | None = None) -> None:
        """Set the JSBSim properties for `t` [s], optionally excluding one fault."""
        now = dict(self._usual)
        for fault, change in self._changes:
            share = 0.0 if fault is without else fault.share(t)
            for name, most in change.items():
                now[name] += share * most
        for name, value in now.items():
            if self._aircraft[name] != value:
                self._aircraft[name] = value

    def wind(self, t: float, height: float) -> np.ndarray:
        """Return the wind added at `t` [s] and `height` above home [m], NED, (3,) [m/s]."""
        blowing = [fault.share(t) * WINDS[fault.name](fault.values, height) for fault in self._winds]
        return np.sum([np.zeros(3), *blowing], axis=0)
