"""Faults by name; and uncatalogued faults, which a diagnosis must report as unknown.

They are not available on the command line; only a blind test uses them.
"""

from collections.abc import Mapping
from math import exp, inf, isfinite, pi, sin
from typing import NamedTuple

import numpy as np

from fleet.simulator.faults.physics import Fault
from fleet.simulator.faults.servos import SURFACES, Commands
from fleet.simulator.vehicle.jsbsim import DT, Aircraft
from fleet.simulator.vehicle.sensors import Estimate
from fleet.simulator.vehicle.weather import FT

_ESTIMATE_S = 2 * DT  # between two calls of `apply_to_estimate` [s]
_INCH = 0.0254  # [m]


class UncataloguedFault:
    """Base class without effect."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        """Store the values; the aircraft is started already."""
        self._values, self._aircraft = values, aircraft

    def apply_to_physics(self, t: float, intensity: float) -> None:
        """Change the physics at `t` [s]."""

    def apply_to_estimate(self, e: Estimate, intensity: float) -> Estimate:
        """Return the estimate with this fault."""
        return e

    def apply_to_commands(self, t: float, intensity: float, commands: Commands) -> Commands:
        """Return surface and motor positions with this fault."""
        return commands


class _CrossedLinkage(UncataloguedFault):
    """Couple the rudder to the aileron."""

    def apply_to_commands(self, t: float, intensity: float, commands: Commands) -> Commands:
        a, e, r, thrust = commands
        return a, e, min(max(r + intensity * self._values["gain"] * a, -1.0), 1.0), thrust


class _LooseHinge(UncataloguedFault):
    """Add an elevator oscillation independent of the command."""

    def apply_to_commands(self, t: float, intensity: float, commands: Commands) -> Commands:
        a, e, r, thrust = commands
        return a, e + intensity * self._values["half_width"] * sin(2 * pi * self._values["hertz"] * t), r, thrust


class _SurgingEngine(UncataloguedFault):
    """Modulate the thrust with a sine."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        super().__init__(values, aircraft)
        self._nominal = aircraft[aircraft.kind.thrust_property]

    def apply_to_physics(self, t: float, intensity: float) -> None:
        modulation = intensity * self._values["fraction"] * sin(2 * pi * self._values["hertz"] * t)
        self._aircraft[self._aircraft.kind.thrust_property] = self._nominal * (1 + modulation)


class _ScaledDerivatives(UncataloguedFault):
    """Scale derivatives of the airframe."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        super().__init__(values, aircraft)
        prefix = "conceal" if aircraft.kind.from_jsbsim else "vary"
        self._nominal = {f"{prefix}/{name}": (aircraft[f"{prefix}/{name}"], values[name]) for name in values}

    def apply_to_physics(self, t: float, intensity: float) -> None:
        for name, (nominal, factor) in self._nominal.items():
            self._aircraft[name] = nominal * (1 + intensity * (factor - 1))


class _SloshingTank(UncataloguedFault):
    """Loose payload: it moves aft when the aircraft pitches up or accelerates, with a first-order lag."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        super().__init__(values, aircraft)
        self._location = f"inertia/pointmass-location-X-inches{aircraft.kind.sliding_index}"
        self._x = 0.0  # displacement aft [m]
        self._nominal_x = aircraft[self._location]

    def apply_to_physics(self, t: float, intensity: float) -> None:
        acceleration = self._aircraft["accelerations/a-pilot-x-ft_sec2"] * FT
        limit, gain = self._values["most_m"], self._values["m_per_mps2"]
        equilibrium = min(max(gain * acceleration, -limit), limit)
        self._x = equilibrium + (self._x - equilibrium) * exp(-DT / self._values["tau_s"])
        self._aircraft[self._location] = self._nominal_x + intensity * self._x / _INCH


class _GyroScale(UncataloguedFault):
    """Apply a scale error to all gyros."""

    def apply_to_estimate(self, e: Estimate, intensity: float) -> Estimate:
        return e._replace(rates=e.rates * (1 + intensity * self._values["scale"]))


class _PitotLag(UncataloguedFault):
    """Apply a first-order lag to the airspeed, as from water in the pitot line."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        super().__init__(values, aircraft)
        self._Va = np.nan

    def apply_to_estimate(self, e: Estimate, intensity: float) -> Estimate:
        previous = self._Va if np.isfinite(self._Va) else e.Va
        tau = intensity * self._values["tau_s"]
        self._Va = e.Va + (previous - e.Va) * exp(-_ESTIMATE_S / tau) if tau > 0 else e.Va
        return e._replace(Va=self._Va)


UNCATALOGUED: dict[str, type[UncataloguedFault]] = {
    "_crossed_linkage": _CrossedLinkage,
    "_torn_fin": _ScaledDerivatives,
    "_roll_damping": _ScaledDerivatives,
    "_pitch_damping": _ScaledDerivatives,
    "_loose_hinge": _LooseHinge,
    "_surging_engine": _SurgingEngine,
    "_sloshing_tank": _SloshingTank,
    "_gyro_scale": _GyroScale,
    "_pitot_lag": _PitotLag,
}


class ParameterRange(NamedTuple):
    """Range of a parameter."""

    low: float
    high: float
    required: bool = True


class FaultKind(NamedTuple):
    """One kind of fault."""

    values: Mapping[str, ParameterRange]
    parts: tuple[str, ...] = ()  # surfaces or axes; one is required
    transient: bool = False  # has an end
    aircraft: tuple[str, ...] = ("small", "c172p")


_ANGLE = ParameterRange(-15.0, 15.0, required=False)
_SPEED, _FROM = ParameterRange(0.0, 20.0), ParameterRange(-360.0, 360.0)
_CESSNA = ("c172p",)

KINDS: dict[str, FaultKind] = {
    "actuator_lag": FaultKind({"tau_s": ParameterRange(0.0, 2.0)}, SURFACES),
    "actuator_delay": FaultKind({"delay_s": ParameterRange(0.0, 1.0)}, SURFACES),
    "actuator_rate_limit": FaultKind({"rate_per_s": ParameterRange(0.01, 50.0)}, SURFACES),
    "actuator_deadband": FaultKind({"half_width": ParameterRange(0.0, 0.5)}, SURFACES),
    "actuator_saturation": FaultKind({"limit": ParameterRange(0.0, 1.0)}, SURFACES),
    "actuator_offset": FaultKind({"offset": ParameterRange(-0.6, 0.6)}, SURFACES),
    "actuator_stuck": FaultKind({"position": ParameterRange(-1.0, 1.0, required=False)}, SURFACES),
    "control_effectiveness_loss": FaultKind({"loss": ParameterRange(0.0, 1.0)}, SURFACES),
    "airspeed_scale": FaultKind({"scale": ParameterRange(0.3, 2.0)}),
    "airspeed_bias": FaultKind({"bias_mps": ParameterRange(-15.0, 15.0)}),
    "gps_latency": FaultKind({"latency_s": ParameterRange(0.0, 2.0)}),
    "imu_misalignment": FaultKind({"roll_deg": _ANGLE, "pitch_deg": _ANGLE, "yaw_deg": _ANGLE}),
    "gyro_bias": FaultKind({"bias_dps": ParameterRange(-15.0, 15.0)}, ("p", "q", "r")),
    "accel_bias": FaultKind({"bias_mps2": ParameterRange(-5.0, 5.0)}, ("x", "y", "z")),
    "heading_bias": FaultKind({"bias_deg": ParameterRange(-60.0, 60.0)}),
    "baro_bias": FaultKind({"bias_m": ParameterRange(-100.0, 100.0)}),
    "wind_steady": FaultKind({"speed_mps": _SPEED, "from_deg": _FROM}),
    "wind_shear": FaultKind({"mps_per_100m": _SPEED, "from_deg": _FROM}),
    "gust_discrete": FaultKind({"speed_mps": _SPEED, "from_deg": _FROM}, transient=True),
    "updraft": FaultKind({"speed_mps": ParameterRange(-15.0, 15.0)}, transient=True),
    "turbulence": FaultKind({"w20_mps": ParameterRange(0.0, 25.0)}),
    "air_density": FaultKind({"density_ratio": ParameterRange(0.6, 1.3)}),
    "thrust_loss": FaultKind({"fraction": ParameterRange(0.0, 1.0)}),
    "drag_increase": FaultKind({"dCD": ParameterRange(-0.02, 0.2)}),
    "icing": FaultKind({"lift_loss": ParameterRange(0.0, 0.5), "dCD": ParameterRange(0.0, 0.2)}),
    "flap_deployed": FaultKind({"flap_deg": ParameterRange(0.0, 30.0)}, aircraft=_CESSNA),
    "mass_change": FaultKind({"dmass_kg": ParameterRange(-200.0, 200.0)}),
    "cg_shift": FaultKind({"dx_m": ParameterRange(-0.3, 0.3)}),
    "prop_torque": FaultKind({"sense": ParameterRange(-1.0, 1.0)}, aircraft=_CESSNA),
    "p_factor": FaultKind({"inches_per_rad": ParameterRange(-300.0, 300.0)}, aircraft=_CESSNA),
    "slipstream_tail": FaultKind({"share": ParameterRange(0.0, 3.0)}, aircraft=_CESSNA),
}
_TIMES = {"at": ParameterRange(0.0, 1e6), "ramp": ParameterRange(0.0, 1e4), "for": ParameterRange(0.5, 1e4)}  # [s]


def parse_fault(text: str, aircraft: str) -> Fault:
    """Parse NAME[:part],key=value,… with at=, ramp= and, for transients, for= in seconds.

    Raises:
        ValueError: when the text is no fault of this aircraft.
    """
    head, *pairs = text.split(",")
    name, _, part = head.partition(":")
    kind = KINDS.get(name)
    if kind is None:
        raise ValueError(f"fault: found {name!r}, expected one of {', '.join(KINDS)}; choose one")
    if aircraft not in kind.aircraft:
        raise ValueError(f"fault {name}: found aircraft {aircraft!r}, expected {' or '.join(kind.aircraft)}; use it")
    if part not in (kind.parts or ("",)):
        expected = f"one of {', '.join(kind.parts)} after a colon" if kind.parts else "nothing after its name"
        raise ValueError(f"fault {name}: found {part or 'no part'!r}, expected {expected}; correct it")
    values = dict(_parse_pair(name, pair, kind) for pair in pairs)
    missing = [key for key, wanted in kind.values.items() if wanted.required and key not in values]
    missing += ["for"] if kind.transient and "for" not in values else []
    if missing:
        raise ValueError(f"fault {name}: found no {missing[0]}, expected {missing[0]}=NUMBER; add it")
    times = {key: values.pop(key, 0.0) for key in _TIMES}
    t1 = times["at"] + times["for"] if kind.transient else inf
    return Fault(name, part, values, times["at"], times["ramp"], t1)


def _parse_pair(name: str, text: str, kind: FaultKind) -> tuple[str, float]:
    key, _, value = text.partition("=")
    ranges = {**kind.values, **{k: v for k, v in _TIMES.items() if k != "for" or kind.transient}}
    if key not in ranges:
        raise ValueError(f"fault {name}: found {key!r}, expected {', '.join(ranges)}; correct it")
    try:
        number = float(value)
    except ValueError:
        number = inf
    low, high, _ = ranges[key]
    if not isfinite(number) or not low <= number <= high:
        raise ValueError(f"fault {name}: found {key}={value}, expected a number {low:g}..{high:g}; correct it")
    return key, number
