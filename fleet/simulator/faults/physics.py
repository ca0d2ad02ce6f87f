"""A fault in time, and faults of the physics: increments of JSBSim properties and of the wind.

`vehicle.altered` defines the properties conceal/*. Faults whose name begins with _ are not in the catalogue: only a
blind test uses them, and a diagnosis must report them as unknown.
"""

from collections.abc import Callable, Mapping
from math import cbrt, cos, exp, inf, pi, radians, sin
from typing import NamedTuple

import numpy as np

from fleet.simulator.vehicle.jsbsim import DT, KG_TO_LB, Aircraft
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


_DERIVATIVES = {  # of the aircraft files: model -> derivative [1/rad]
    "c172p": {"C_l_p": -0.484, "C_m_q": -12.4},
    "aerosonde": {"C_l_p": -0.51, "C_m_q": -38.21},
}


def _damping_change(aircraft: Aircraft, values: Mapping[str, float]) -> Increments:
    """Add to a damping derivative, by its factor conceal/* or vary/*."""
    prefix, derivatives = "conceal" if aircraft.kind.from_jsbsim else "vary", _DERIVATIVES[aircraft.kind.model]
    return {f"{prefix}/{key[1:]}": x / derivatives[key[1:]] for key, x in values.items()}


PHYSICS_FAULTS: dict[str, PhysicsFault] = {
    "air_density": _air_density,
    "turbulence": _turbulence,
    "thrust_loss": _thrust_loss,
    "drag_increase": lambda aircraft, values: {"conceal/C_D": values["dCD"]},
    "icing": lambda aircraft, values: {"conceal/lift": -values["lift_loss"], "conceal/C_D": values["dCD"]},
    "flap_deployed": lambda aircraft, values: {"fcs/flap-cmd-norm": values["flap_deg"] / _FLAP_DEG},
    "mass_change": _mass_change,
    "cg_shift": _cg_shift,
    "roll_damping": _damping_change,
    "pitch_damping": _damping_change,
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

TimedFault = Callable[[float, float], None]
"""Change the aircraft at a time [s] with an intensity of the fault; may have state."""


def _surging_engine(aircraft: Aircraft, values: Mapping[str, float]) -> TimedFault:
    """Modulate the thrust with a sine."""
    name = aircraft.kind.thrust_property
    nominal = aircraft[name]

    def apply(t: float, intensity: float) -> None:
        modulation = intensity * values["fraction"] * sin(2 * pi * values["hertz"] * t)
        aircraft[name] = nominal * (1 + modulation)

    return apply


def _scaled_derivatives(aircraft: Aircraft, values: Mapping[str, float]) -> TimedFault:
    """Scale derivatives of the airframe."""
    prefix = "conceal" if aircraft.kind.from_jsbsim else "vary"
    nominal = {f"{prefix}/{name}": (aircraft[f"{prefix}/{name}"], factor) for name, factor in values.items()}

    def apply(t: float, intensity: float) -> None:
        for name, (value, factor) in nominal.items():
            aircraft[name] = value * (1 + intensity * (factor - 1))

    return apply


def _sloshing_tank(aircraft: Aircraft, values: Mapping[str, float]) -> TimedFault:
    """Move a loose payload aft when the aircraft pitches up or accelerates, with a first-order lag."""
    location = f"inertia/pointmass-location-X-inches{aircraft.kind.sliding_index}"
    nominal, x = aircraft[location], 0.0  # [in]; displacement aft [m]

    def apply(t: float, intensity: float) -> None:
        nonlocal x
        acceleration = aircraft["accelerations/a-pilot-x-ft_sec2"] * FT
        limit, gain = values["most_m"], values["m_per_mps2"]
        equilibrium = min(max(gain * acceleration, -limit), limit)
        x = equilibrium + (x - equilibrium) * exp(-DT / values["tau_s"])
        aircraft[location] = nominal + intensity * x / _INCH

    return apply


TIMED_FAULTS: dict[str, Callable[[Aircraft, Mapping[str, float]], TimedFault]] = {
    "_torn_fin": _scaled_derivatives,
    "_surging_engine": _surging_engine,
    "_sloshing_tank": _sloshing_tank,
}
