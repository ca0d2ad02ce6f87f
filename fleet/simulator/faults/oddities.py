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

_SENSE_S = 2 * DT  # between two calls of `apply_to_estimate` [s]
_INCH = 0.0254  # [m]


class Oddity:
    """Base class without effect."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        """Store the values; the aircraft is started already."""
        self._values, self._aircraft = values, aircraft

    def press(self, t: float, share: float) -> None:
        """Change the physics at `t` [s]."""

    def sense(self, e: Estimate, share: float) -> Estimate:
        """Return the estimate with this fault."""
        return e

    def move(self, t: float, share: float, commands: Commands) -> Commands:
        """Return surface and motor positions with this fault."""
        return commands


class _CrossedLinkage(Oddity):
    """Couple the rudder to the aileron."""

    def move(self, t: float, share: float, commands: Commands) -> Commands:
        a, e, r, thrust = commands
        return a, e, min(max(r + share * self._values["gain"] * a, -1.0), 1.0), thrust


class _LooseHinge(Oddity):
    """Add an elevator oscillation independent of the command."""

    def move(self, t: float, share: float, commands: Commands) -> Commands:
        a, e, r, thrust = commands
        return a, e + share * self._values["half_width"] * sin(2 * pi * self._values["hertz"] * t), r, thrust


class _SurgingEngine(Oddity):
    """Modulate the thrust with a sine."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        super().__init__(values, aircraft)
        self._usual = aircraft[aircraft.kind.strength]

    def press(self, t: float, share: float) -> None:
        swing = share * self._values["fraction"] * sin(2 * pi * self._values["hertz"] * t)
        self._aircraft[self._aircraft.kind.strength] = self._usual * (1 + swing)


class _Factors(Oddity):
    """Scale derivatives of the airframe."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        super().__init__(values, aircraft)
        home = "conceal" if aircraft.kind.shipped else "vary"
        self._usual = {f"{home}/{name}": (aircraft[f"{home}/{name}"], values[name]) for name in values}

    def press(self, t: float, share: float) -> None:
        for name, (usual, factor) in self._usual.items():
            self._aircraft[name] = usual * (1 + share * (factor - 1))


class _SloshingTank(Oddity):
    """Loose payload: it moves aft when the aircraft pitches up or accelerates, with a first-order lag."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        super().__init__(values, aircraft)
        self._place = f"inertia/pointmass-location-X-inches{aircraft.kind.load}"
        self._x = 0.0  # displacement aft [m]
        self._stowed = aircraft[self._place]

    def press(self, t: float, share: float) -> None:
        felt = self._aircraft["accelerations/a-pilot-x-ft_sec2"] * FT
        most, per = self._values["most_m"], self._values["m_per_mps2"]
        rest = min(max(per * felt, -most), most)
        self._x = rest + (self._x - rest) * exp(-DT / self._values["tau_s"])
        self._aircraft[self._place] = self._stowed + share * self._x / _INCH


class _GyroScale(Oddity):
    """Apply a scale error to all gyros."""

    def sense(self, e: Estimate, share: float) -> Estimate:
        return e._replace(rates=e.rates * (1 + share * self._values["scale"]))


class _PitotLag(Oddity):
    """Apply a first-order lag to the airspeed, as from water in the pitot line."""

    def __init__(self, values: Mapping[str, float], aircraft: Aircraft):
        super().__init__(values, aircraft)
        self._Va = np.nan

    def sense(self, e: Estimate, share: float) -> Estimate:
        past = self._Va if np.isfinite(self._Va) else e.Va
        tau = share * self._values["tau_s"]
        self._Va = e.Va + (past - e.Va) * exp(-_SENSE_S / tau) if tau > 0 else e.Va
        return e._replace(Va=self._Va)


ODD: dict[str, type[Oddity]] = {
    "_crossed_linkage": _CrossedLinkage,
    "_torn_fin": _Factors,
    "_roll_damping": _Factors,
    "_pitch_damping": _Factors,
    "_loose_hinge": _LooseHinge,
    "_surging_engine": _SurgingEngine,
    "_sloshing_tank": _SloshingTank,
    "_gyro_scale": _GyroScale,
    "_pitot_lag": _PitotLag,
}
