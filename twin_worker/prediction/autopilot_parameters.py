"""Controller twin: control law, parameters with their provenance, and the route override of a what-if.

One module creates it, so that published and simulated parameters are equal. A parameter that is not received is
identified from flight, or else the default of the autopilot; the provenance is published.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from fleet.autopilots import arduplane, copter, laws
from fleet.contract import Controller, Item
from fleet.frames import Origin
from fleet.mission import VA_C, Route, unroll_route

RECEIVED, IDENTIFIED, DEFAULT, OVERRIDDEN = "received", "identified", "default", "overridden"
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
_PX4_L1 = ("FW_L1_PERIOD", "FW_L1_DAMPING", *_PX4[3:])
_TEXTBOOK = ("chi_inf", "k_path", "k_orbit", "R_fillet", "R_orbit", "phi_max", "Va_c", "climb_max", "sink_max")
PUBLISHED_OF = {"arduplane": _ARDUPLANE, "px4": _PX4, "px4_l1": _PX4_L1, "textbook": _TEXTBOOK}
"""Published parameters by law: those that shape the path."""
PUBLISHED_OF_GUIDANCE = (*_ARDUPLANE[:5], "AIRSPEED_CRUISE", "TECS_CLMB_MAX", "TECS_SINK_MAX")
_CACHE_SIZE = 1024  # cached fixed-wing controllers
_Items = tuple[tuple[str, float], ...]
CRUISE_OF = {"arduplane": "AIRSPEED_CRUISE", "px4": "FW_AIRSPD_TRIM", "px4_l1": "FW_AIRSPD_TRIM", "textbook": "Va_c"}
# parameters that a speed override replaces
SPEED_PARAMETERS = (*dict.fromkeys(CRUISE_OF.values()), "WP_SPD", "MPC_XY_CRUISE", "Q_WP_SPD")


def range_error(name: str, value: float) -> str:
    """Describe why a value is outside the range of a parameter; empty for valid values and unknown parameters."""
    row = next((row for law in laws.LAWS.values() for row in law.table if row.name == name), None)
    if row is None or row.low <= value <= row.high:
        return ""
    return f"{name}: found {value:g}, expected {row.low:g}..{row.high:g}"


@dataclass(frozen=True)
class ControllerTwin:
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
    provenance: Mapping[str, str] = field(default_factory=dict)
    published_names: tuple[str, ...] = ()
    name: str = "arduplane"

    def par(self, altitude_m: float) -> np.ndarray:
        """Return the parameter vector of the law's kernels at a height above mean sea level [m]."""
        return laws.vector(self.name, self._law_values, altitude_m)

    @cached_property
    def _law_values(self) -> dict[str, float]:
        """Return the values that the law reads, cached because every rollout needs them."""
        return laws.read(self.name, self.values)[0]

    @property
    def default_names(self) -> tuple[str, ...]:
        """Return the names of parameters at their defaults."""
        return tuple(name for name, source in self.provenance.items() if source == DEFAULT)

    def to_message(self) -> Controller:
        """Return the bus message."""
        parts: dict[str, dict[str, float]] = {RECEIVED: {}, IDENTIFIED: {}, DEFAULT: {}, OVERRIDDEN: {}}
        for name in self.published_names:
            parts[self.provenance[name]][name] = round(float(self.values[name]), 4)
        return Controller(law=self.law, **parts)


def fixed_wing_controller(
    received: Mapping[str, float],
    identified: Mapping[str, float] | None = None,
    overrides: Mapping[str, float] | None = None,
    law: str = "arduplane",
    sentence: str = "",
) -> ControllerTwin:
    """Return the controller twin of a fixed wing.

    Args:
        received: parameters in autopilot names and units, current or older names
        identified: parameters identified from flight, current names; used only if not received
        overrides: parameters of a what-if query, which replace both
        law: name in `laws.LAWS`
        sentence: description as in `Prediction` if only the guidance of the law is used
    """
    item_tuples = (tuple(mapping.items()) if mapping else () for mapping in (received, identified, overrides))
    return _fixed_wing_controller(*item_tuples, law, sentence)


@lru_cache(maxsize=_CACHE_SIZE)
def _fixed_wing_controller(
    received_items: _Items, identified: _Items, override_items: _Items, law: str, sentence: str
) -> ControllerTwin:
    """Return the cached controller: reading parameters takes as long as simulating a minute."""
    received, overrides = dict(received_items), dict(override_items)
    _, missing = laws.read(law, {**received, **overrides})
    used = {name: value for name, value in identified if name in missing}
    values, absent = laws.read(law, {**received, **used, **overrides})
    provenance = dict.fromkeys(values, RECEIVED)
    provenance |= dict.fromkeys(used, IDENTIFIED) | dict.fromkeys(set(overrides) & set(values), OVERRIDDEN)
    provenance |= dict.fromkeys(absent, DEFAULT)
    published = PUBLISHED_OF_GUIDANCE if sentence else PUBLISHED_OF[law]
    return ControllerTwin(sentence or laws.LAWS[law].description, values, provenance, published, law)


def multirotor_controller(
    received: Mapping[str, float],
    prefix: str,
    limit: copter.Limits,
    overrides: Mapping[str, float] | None = None,
    *,
    px4: bool = False,
) -> ControllerTwin:
    """Return the controller twin of a hovering aircraft.

    Args:
        received: parameters in autopilot names and units
        prefix: `Q_` for the rotors of a quadplane
        limit: limits in use, SI; a limit that is neither received nor default is identified from flight
        overrides: parameters of a what-if query
        px4: the autopilot is PX4
    """
    overrides = overrides or {}
    parameters = {**received, **overrides}
    nominal, absent = copter.limits(parameters, prefix, px4=px4)
    values, provenance = {}, {}
    for name, row in copter.TABLE.items():
        names = [(prefix + alias, unit) for alias, unit in row.names]
        parameter, factor = next((pair for pair in names if pair[0] in parameters), names[-1 if px4 else 0])
        values[parameter] = getattr(limit, name) / factor
        is_identified = getattr(limit, name) != getattr(nominal, name)
        source = OVERRIDDEN if parameter in overrides else RECEIVED
        provenance[parameter] = IDENTIFIED if is_identified else DEFAULT if name in absent else source
    return ControllerTwin(copter.LAW, values, provenance, tuple(values))


_STATIONARY_SPEED = 0.5  # stationary below this speed [m/s]


@dataclass(frozen=True)
class RouteOverride:
    """Route, parameters and speed of a what-if query, from the start of the prediction on.

    Attributes:
        items: mission
        seq: first target item
        parameters: autopilot parameters
        restart_leg: start the leg to `seq` at the aircraft position, even if that item is current
        speed: airspeed at the start, ground speed for hovering aircraft [m/s]; None: unchanged
        first_item: number of the first item to fly, as for `fleet.mission.unroll_route`
        jumps_taken: jumps taken so far at each jump, as for `fleet.mission.unroll_route`
        after_s: time for which a fixed wing continues on its present route [s]
        mode_route: flown in place of the mission; None: the mission is flown
    """

    items: tuple[Item, ...]
    seq: int
    parameters: Mapping[str, float] = field(default_factory=dict)
    restart_leg: bool = False
    speed: float | None = None
    first_item: int = 1
    jumps_taken: Mapping[int, int] = field(default_factory=dict)
    after_s: float = 0.0
    mode_route: Route | None = None

    def to_route(self, origin: Origin, received: Mapping[str, float]) -> Route:
        """Return the route."""
        if self.mode_route is not None:
            return self.mode_route
        return unroll_route(
            self.items,
            seq=self.seq,
            origin=origin,
            params={**received, **self.parameters},
            first=self.first_item,
            jumps_taken=self.jumps_taken,
        )

    def scale_to_speed(self, velocity: np.ndarray, psi: float = 0.0) -> np.ndarray:
        """Scale a velocity (3,) [m/s] to the requested speed; a stationary aircraft uses the heading `psi` [rad]."""
        if self.speed is None:
            return velocity
        present_speed = float(np.linalg.norm(velocity))
        along = (
            velocity / present_speed if present_speed > _STATIONARY_SPEED else np.array([np.cos(psi), np.sin(psi), 0.0])
        )
        return self.speed * along


def transfer_controller(
    ctl: np.ndarray, old_legs: np.ndarray, par: np.ndarray, legs: np.ndarray, restart: tuple[bool, np.ndarray]
) -> np.ndarray:
    """Return the controller state on another route: filters and integrators stay, an identical leg continues.

    Args:
        ctl, old_legs: synchronised state and its legs
        par, legs: new parameters and legs
        restart: whether to restart the leg unconditionally, and the aircraft position, NED, (3,) [m]
    """
    out, (restart_leg, p) = ctl.copy(), restart
    compared = [column for column in range(legs.shape[1]) if column != VA_C]
    out[arduplane.LEG] = 0
    if restart_leg or not np.array_equal(old_legs[int(ctl[arduplane.LEG]), compared], legs[0, compared]):
        laws.begin(out, par, legs, 0, p)
        return out
    restarted = ctl.copy()
    arduplane.set_leg(restarted, par, legs, 0, ctl[arduplane.FROM])
    out[arduplane.TURN] = restarted[arduplane.TURN]
    return out
