"""Controller twin: control law, parameters and the provenance of each parameter.

One module creates it, so that published and simulated parameters are equal. A parameter that is not received is
identified from flight, or else the default of the autopilot; the provenance is published.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from fleet.autopilots import copter, laws
from fleet.contract import Controller

RECEIVED, IDENTIFIED, DEFAULT, ASKED = "received", "identified", "default", "asked"
_ARDUPLANE = (
    "NAVL1_PERIOD", "NAVL1_DAMPING", "WP_RADIUS", "WP_LOITER_RAD", "ROLL_LIMIT_DEG", "AIRSPEED_CRUISE", "AIRSPEED_MIN",
    "AIRSPEED_MAX", "TECS_TIME_CONST", "TECS_CLMB_MAX", "TECS_SINK_MIN", "TECS_SINK_MAX", "TECS_HDEM_TCONST",
    "TECS_SPDWEIGHT", "TECS_PITCH_MAX", "TECS_PITCH_MIN", "PTCH_LIM_MAX_DEG", "PTCH_LIM_MIN_DEG", "TRIM_THROTTLE",
)  # fmt: skip
_PX4 = (
    "NPFG_PERIOD", "NPFG_DAMPING", "NPFG_SW_DST_MLT", "FW_R_LIM", "NAV_ACC_RAD", "NAV_LOITER_RAD", "FW_AIRSPD_TRIM",
    "FW_AIRSPD_MIN", "FW_AIRSPD_MAX", "FW_T_CLMB_MAX", "FW_T_SINK_MIN", "FW_T_SINK_MAX", "FW_T_CLMB_R_SP",
    "FW_T_SINK_R_SP", "FW_T_ALT_TC", "FW_T_TAS_TC", "FW_THR_TRIM", "FW_P_LIM_MAX", "FW_P_LIM_MIN",
)  # fmt: skip
_TEXTBOOK = ("chi_inf", "k_path", "k_orbit", "R_fillet", "R_orbit", "phi_max", "Va_c", "climb_max", "sink_max")
TOLD_OF = {"arduplane": _ARDUPLANE, "px4": _PX4, "textbook": _TEXTBOOK}
"""Published parameters by law: those that shape the path."""
TOLD_OF_GUIDANCE = (*_ARDUPLANE[:5], "AIRSPEED_CRUISE", "TECS_CLMB_MAX", "TECS_SINK_MAX")
_CONTROLS = 1024  # cached fixed-wing controllers
_Given = tuple[tuple[str, float], ...]
CRUISE_OF = {"arduplane": "AIRSPEED_CRUISE", "px4": "FW_AIRSPD_TRIM", "textbook": "Va_c"}
# parameters that a speed override replaces
CRUISES = (*CRUISE_OF.values(), "WP_SPD", "MPC_XY_CRUISE", "Q_WP_SPD")


def why_unusable(name: str, value: float) -> str:
    """Describe why a value is outside the range of a parameter; empty for valid values and unknown parameters."""
    row = next((row for law in laws.LAWS.values() for row in law.table if row.name == name), None)
    if row is None or row.low <= value <= row.high:
        return ""
    return f"{name}: found {value:g}, expected {row.low:g}..{row.high:g}"


@dataclass(frozen=True)
class Control:
    """Control law and parameters of a controller twin.

    Attributes:
        law: as in `Prediction`
        values: parameters in autopilot names and units
        provenance: received, identified, default or asked, by parameter
        published_names: published parameters
        name: name of the law in `laws.LAWS`
    """

    law: str
    values: Mapping[str, float] = field(default_factory=dict)
    known: Mapping[str, str] = field(default_factory=dict)
    told: tuple[str, ...] = ()
    name: str = "arduplane"

    def par(self, altitude_m: float) -> np.ndarray:
        """Return the parameter vector of the law's kernels at a height above mean sea level [m]."""
        return laws.vector(self.name, self._found, altitude_m)

    @cached_property
    def _found(self) -> dict[str, float]:
        """Return the values that the law reads, cached because every rollout needs them."""
        return laws.read(self.name, self.values)[0]

    @property
    def absent(self) -> tuple[str, ...]:
        """Return the names of parameters at their defaults."""
        return tuple(name for name, how in self.known.items() if how == DEFAULT)

    def wire(self) -> Controller:
        """Return the bus message."""
        parts: dict[str, dict[str, float]] = {RECEIVED: {}, IDENTIFIED: {}, DEFAULT: {}, ASKED: {}}
        for name in self.told:
            parts[self.known[name]][name] = round(float(self.values[name]), 4)
        return Controller(law=self.law, **parts)


def on_wings(
    received: Mapping[str, float],
    identified: Mapping[str, float] | None = None,
    asked: Mapping[str, float] | None = None,
    law: str = "arduplane",
    sentence: str = "",
) -> Control:
    """Return the controller twin of a fixed wing.

    Args:
        received: parameters in autopilot names and units, current or older names
        identified: parameters identified from flight, current names; used only if not received
        overrides: parameters of a what-if query, which replace both
        law: name in `laws.LAWS`
        sentence: description as in `Prediction` if only the guidance of the law is used
    """
    given = (tuple(each.items()) if each else () for each in (received, identified, asked))
    return _on_wings(*given, law, sentence)


@lru_cache(maxsize=_CONTROLS)
def _on_wings(given: _Given, identified: _Given, wished: _Given, law: str, sentence: str) -> Control:
    """Return the cached controller: reading parameters takes as long as simulating a minute."""
    received, asked = dict(given), dict(wished)
    _, missing = laws.read(law, {**received, **asked})
    learnt = {name: value for name, value in identified if name in missing}
    values, absent = laws.read(law, {**received, **learnt, **asked})
    known = dict.fromkeys(values, RECEIVED)
    known |= dict.fromkeys(learnt, IDENTIFIED) | dict.fromkeys(set(asked) & set(values), ASKED)
    known |= dict.fromkeys(absent, DEFAULT)
    told = TOLD_OF_GUIDANCE if sentence else TOLD_OF[law]
    return Control(sentence or laws.LAWS[law].sentence, values, known, told, law)


def on_rotors(
    received: Mapping[str, float], prefix: str, limit: copter.Limits, asked: Mapping[str, float] | None = None
) -> Control:
    """Return the controller twin of a hovering aircraft.

    Args:
        received: parameters in autopilot names and units
        prefix: `Q_` for the rotors of a quadplane
        limit: limits in use, SI; a limit that is neither received nor default is identified from flight
        overrides: parameters of a what-if query
    """
    asked = asked or {}
    given = {**received, **asked}
    usual, absent = copter.limits(given, prefix)
    values, known = {}, {}
    for name, row in copter.TABLE.items():
        names = [(prefix + known_as, unit) for known_as, unit in row.names]
        called, factor = next((pair for pair in names if pair[0] in given), names[0])
        values[called] = getattr(limit, name) / factor
        seen = getattr(limit, name) != getattr(usual, name)
        told = ASKED if called in asked else RECEIVED
        known[called] = IDENTIFIED if seen else DEFAULT if name in absent else told
    return Control(copter.LAW, values, known, tuple(values))
