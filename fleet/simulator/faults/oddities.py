"""Uncatalogued faults, which a diagnosis must report as unknown.

They are not available on the command line; only a blind test uses them.
"""

from collections.abc import Mapping
from math import exp, pi, sin

import numpy as np

from fleet.simulator.faults.servos import Commands
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
