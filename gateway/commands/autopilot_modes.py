"""Modes that a proposal may command, and former speeds, by autopilot and vehicle.

ArduPlane has no mode that lands anywhere: it lands in a mission. ArduCopter holds in BRAKE, because LOITER takes the
throttle of a remote control that may be absent as a command to descend.
Source: ArduPilot flight modes (`Mode::Number`); PX4 `px4_custom_mode.h`.
"""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import NamedTuple

from fleet.contract import Item
from fleet.vehicles import FIXED_WING, HELICOPTER, MULTIROTOR, QUADPLANE

_PX4_AUTO = 4 << 16  # main mode AUTO of PX4
_DO_CHANGE_SPEED = 178  # MAV_CMD


class AutopilotMode(NamedTuple):
    """A flight mode."""

    name: str  # as in `Status.mode`
    custom_mode: int  # as in HEARTBEAT


_PLANE = {"hold": AutopilotMode("LOITER", 12), "return": AutopilotMode("RTL", 11)}
_COPTER = {"hold": AutopilotMode("BRAKE", 17), "return": AutopilotMode("RTL", 6), "land": AutopilotMode("LAND", 9)}
_PX4 = {
    "hold": AutopilotMode("LOITER", 3 << 24 | _PX4_AUTO),
    "return": AutopilotMode("RTL", 5 << 24 | _PX4_AUTO),
    "land": AutopilotMode("LAND", 6 << 24 | _PX4_AUTO),
}
_MODES = {
    ("ardupilot", FIXED_WING): _PLANE,
    ("ardupilot", QUADPLANE): _PLANE,
    ("ardupilot", MULTIROTOR): _COPTER,
    ("ardupilot", HELICOPTER): _COPTER,
    **{("px4", vehicle): _PX4 for vehicle in (FIXED_WING, QUADPLANE, MULTIROTOR, HELICOPTER)},
}
AUTOMATIC = {
    "ardupilot": frozenset(("AUTO", "GUIDED", "LOITER", "CIRCLE", "BRAKE", "RTL", "LAND")),
    "px4": frozenset(("MISSION", "LOITER", "RTL", "LAND", "TAKEOFF")),
}
"""Modes in which nobody flies by hand, by autopilot; in any other mode nothing is sent."""
_SPEEDS = {  # parameters of the default speed, with their units in m/s, by vehicle
    FIXED_WING: (("AIRSPEED_CRUISE", 1.0), ("TRIM_ARSPD_CM", 0.01), ("FW_AIRSPD_TRIM", 1.0)),
    MULTIROTOR: (("WP_SPD", 1.0), ("WPNAV_SPEED", 0.01), ("MPC_XY_CRUISE", 1.0)),
}


def commanded_modes(autopilot: str, vehicle: str) -> dict[str, AutopilotMode]:
    """Return the modes of `Change.mode` (hold, return, land) of an aircraft; empty: it takes no commands from here."""
    return _MODES.get((autopilot, vehicle), {})


def default_speed(vehicle: str, params: Mapping[str, float]) -> float | None:
    """Return the speed that the autopilot flies without a command [m/s]; None: not known."""
    names = _SPEEDS[MULTIROTOR if vehicle in (MULTIROTOR, HELICOPTER) else FIXED_WING]
    speeds = (params.get(name, float("nan")) * unit for name, unit in names)
    return next((speed for speed in speeds if isfinite(speed) and speed > 0), None)


def mission_speed(items: Sequence[Item], seq: int) -> float | None:
    """Return the speed that the mission commanded last before item `seq` [m/s]; None: none.

    Jumps are not followed: the speed is that of the items in their order.
    """
    passed = (item for item in reversed(items) if item.seq < seq)
    speeds = (item.param2 for item in passed if item.command == _DO_CHANGE_SPEED and item.param2 > 0)
    return next(speeds, None)
