"""ArduPlane parameters as one SI vector for the compiled controller.

Source: ArduPlane 4.x parameter list (names, defaults, units); older names from its release notes.
"""

from collections.abc import Mapping
from functools import lru_cache
from math import radians

import numpy as np

from fleet.autopilots.control_law import ParameterSpec, eas2tas, lookup

_DEG = radians(1.0)
_PERCENT = 0.01


TABLE = (
    ParameterSpec("NAVL1_PERIOD", 17, 1, 1, 100),
    ParameterSpec("NAVL1_DAMPING", 0.75, 1, 0.1, 3),
    ParameterSpec("NAVL1_XTRACK_I", 0.02, 1, 0, 1),
    ParameterSpec("NAVL1_LIM_BANK", 0, _DEG, 0, 89),
    ParameterSpec("WP_RADIUS", 90, 1, 0, 1e5),
    ParameterSpec("WP_MAX_RADIUS", 0, 1, 0, 1e5),
    ParameterSpec("WP_LOITER_RAD", 60, 1, -1e5, 1e5),
    ParameterSpec("ALT_SLOPE_MIN", 15, 1, 0, 1e4, (("GLIDE_SLOPE_MIN", 1),)),
    ParameterSpec("FLIGHT_OPTIONS", 0, 1, 0, 2**31),
    ParameterSpec("ROLL_LIMIT_DEG", 45, _DEG, 1, 90, (("LIM_ROLL_CD", 0.01),)),
    ParameterSpec("PTCH_LIM_MAX_DEG", 20, _DEG, 1, 90, (("LIM_PITCH_MAX", 0.01),)),
    ParameterSpec("PTCH_LIM_MIN_DEG", -25, _DEG, -90, -1, (("LIM_PITCH_MIN", 0.01),)),
    ParameterSpec("PTCH_TRIM_DEG", 0, _DEG, -45, 45, (("TRIM_PITCH_CD", 0.01),)),
    ParameterSpec("TECS_CLMB_MAX", 5, 1, 0.1, 100),
    ParameterSpec("TECS_SINK_MIN", 2, 1, 0.1, 100),
    ParameterSpec("TECS_SINK_MAX", 5, 1, 0.1, 100),
    ParameterSpec("TECS_TIME_CONST", 5, 1, 0.5, 100),
    ParameterSpec("TECS_THR_DAMP", 0.5, 1, 0, 10),
    ParameterSpec("TECS_PTCH_DAMP", 0.3, 1, 0, 10),
    ParameterSpec("TECS_INTEG_GAIN", 0.3, 1, 0, 10),
    ParameterSpec("TECS_VERT_ACC", 7, 1, 0.1, 100),
    ParameterSpec("TECS_RLL2THR", 10, 1, 0, 1000),
    ParameterSpec("TECS_SPDWEIGHT", 1, 1, -1, 2),
    ParameterSpec("TECS_HDEM_TCONST", 3, 1, 0, 100),
    ParameterSpec("TECS_PITCH_MAX", 15, _DEG, 0, 90),
    ParameterSpec("TECS_PITCH_MIN", 0, _DEG, -90, 0),
    ParameterSpec("TRIM_THROTTLE", 45, _PERCENT, 0, 100),
    ParameterSpec("THR_MIN", 0, _PERCENT, -100, 100),
    ParameterSpec("THR_MAX", 100, _PERCENT, 1, 100),
    ParameterSpec("THR_SLEWRATE", 100, _PERCENT, 0, 1e4),
    ParameterSpec("AIRSPEED_CRUISE", 12, 1, 1, 300, (("TRIM_ARSPD_CM", 0.01),)),
    ParameterSpec("AIRSPEED_MIN", 9, 1, 1, 300, (("ARSPD_FBW_MIN", 1),)),
    ParameterSpec("AIRSPEED_MAX", 22, 1, 1, 300, (("ARSPD_FBW_MAX", 1),)),
    ParameterSpec("SCALING_SPEED", 15, 1, 1, 300),
    ParameterSpec("RLL2SRV_TCONST", 0.5, 1, 0.1, 10),
    ParameterSpec("RLL2SRV_RMAX", 0, _DEG, 0, 1000),
    ParameterSpec("RLL_RATE_FF", 0.345, 1, 0, 100),
    ParameterSpec("RLL_RATE_P", 0.08, 1, 0, 100),
    ParameterSpec("RLL_RATE_I", 0.15, 1, 0, 100),
    ParameterSpec("RLL_RATE_D", 0, 1, 0, 10),
    ParameterSpec("RLL_RATE_IMAX", 0.666, 1, 0, 10),
    ParameterSpec("RLL_RATE_FLTT", 3, 1, 0, 1000),
    ParameterSpec("RLL_RATE_FLTD", 12, 1, 0, 1000),
    ParameterSpec("PTCH2SRV_TCONST", 0.5, 1, 0.1, 10),
    ParameterSpec("PTCH2SRV_RMAX_UP", 0, _DEG, 0, 1000),
    ParameterSpec("PTCH2SRV_RMAX_DN", 0, _DEG, 0, 1000),
    ParameterSpec("PTCH2SRV_RLL", 1, 1, 0, 10),
    ParameterSpec("PTCH_RATE_FF", 0.345, 1, 0, 100),
    ParameterSpec("PTCH_RATE_P", 0.04, 1, 0, 100),
    ParameterSpec("PTCH_RATE_I", 0.15, 1, 0, 100),
    ParameterSpec("PTCH_RATE_D", 0, 1, 0, 10),
    ParameterSpec("PTCH_RATE_IMAX", 0.666, 1, 0, 10),
    ParameterSpec("PTCH_RATE_FLTT", 3, 1, 0, 1000),
    ParameterSpec("PTCH_RATE_FLTD", 12, 1, 0, 1000),
    ParameterSpec("KFF_RDDRMIX", 0.5, 1, 0, 2),
)

# Index of each parameter in `par`, in the order of the table.
(
    PERIOD, DAMPING, XTRACK_I, LIM_BANK, WP_RADIUS, WP_MAX_RADIUS, LOITER_RAD, SLOPE_MIN, OPTIONS, ROLL_LIMIT,
    PITCH_HIGH, PITCH_LOW, PITCH_TRIM, CLIMB_MAX, SINK_MIN, SINK_MAX, TIME_CONST, THR_DAMP, PITCH_DAMP, INTEG,
    VERT_ACC, ROLL_TO_THR, SPEED_WEIGHT, H_TIME, TECS_HIGH, TECS_LOW, THR_TRIM, THR_MIN, THR_MAX, THR_SLEW,
    VA_CRUISE, VA_MIN, VA_MAX, VA_SCALING,
    ROLL_TC, ROLL_RMAX, ROLL_FF, ROLL_P, ROLL_I, ROLL_D, ROLL_IMAX, ROLL_FLTT, ROLL_FLTD,
    PITCH_TC, PITCH_UP, PITCH_DOWN, PITCH_ROLL, PITCH_FF, PITCH_P, PITCH_I, PITCH_D, PITCH_IMAX, PITCH_FLTT, PITCH_FLTD,
    RUDDER_MIX,
) = range(len(TABLE))  # fmt: skip
EAS2TAS = len(TABLE)  # ratio of true to equivalent airspeed [-]
N_PAR = EAS2TAS + 1

NAMES = tuple(row.name for row in TABLE)
DEFAULTS: dict[str, float] = {row.name: float(row.default) for row in TABLE}
# before 4.1, see `_old_gains`
_OLD_PREFIXES = (("RLL2SRV_", "RLL_RATE_"), ("PTCH2SRV_", "PTCH_RATE_"))
_OLD_GAINS = (("P", 1.0), ("I", 0.3), ("D", 0.08), ("FF", 0.0), ("IMAX", 3000.0), ("TCONST", 0.5))
_READ_NAMES = tuple(
    dict.fromkeys(
        (
            *NAMES,
            *(older for row in TABLE for older, _ in row.old_names),
            *(prefix + gain for prefix, _ in _OLD_PREFIXES for gain, _ in _OLD_GAINS),
        )
    )
)


def parameters(values: Mapping[str, float], altitude_m: float = 0.0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert autopilot parameters to the vector for the kernels.

    Args:
        values: parameters in the names (current or older) and units of the autopilot
        altitude_m: height above mean sea level, for true airspeed [m]
    Returns:
        par: SI and rad, throttles 0..1, (N_PAR,)
        absent: names that are missing, not finite or out of range; `par` contains their defaults
    """
    resolved, absent = read(values)
    return vector(resolved, altitude_m), absent


def read(values: Mapping[str, float]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return all parameters by current name, in the units of the autopilot, and the names at defaults."""
    resolved, absent = _read(tuple([values.get(name) for name in _READ_NAMES]))
    return dict(zip(NAMES, resolved, strict=True)), absent


@lru_cache(maxsize=1024)
def _read(values: tuple[float | None, ...]) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return the values in the order of the table, and the names at defaults, from the values of `_READ_NAMES`."""
    received = {name: value for name, value in zip(_READ_NAMES, values, strict=True) if value is not None}
    inputs = {**_old_gains(received), **received}
    resolved, absent = {}, []
    for row in TABLE:
        value = lookup(row, inputs)
        if value is None:
            absent.append(row.name)
        resolved[row.name] = float(row.default if value is None else value)
    absent += [name for name in _reset_inconsistent(resolved) if name not in absent]
    return tuple(resolved.values()), tuple(absent)


def vector(resolved: Mapping[str, float], altitude_m: float = 0.0) -> np.ndarray:
    """Convert the result of `read` to SI and append the airspeed ratio at a height [m], (N_PAR,)."""
    par = np.empty(N_PAR)
    par[:EAS2TAS] = [resolved[row.name] * row.factor for row in TABLE]
    par[THR_MIN] = max(par[THR_MIN], 0.0)  # reverse thrust is not modelled
    par[EAS2TAS] = eas2tas(altitude_m)
    return par


def _reset_inconsistent(resolved: dict[str, float]) -> list[str]:
    """Reset inconsistent limits to defaults: a lower limit at or above the upper one."""
    inconsistent: list[str] = []
    if not resolved["AIRSPEED_MIN"] < resolved["AIRSPEED_MAX"]:
        inconsistent += ["AIRSPEED_CRUISE", "AIRSPEED_MIN", "AIRSPEED_MAX"]
    if not resolved["THR_MIN"] < resolved["THR_MAX"]:
        inconsistent += ["TRIM_THROTTLE", "THR_MIN", "THR_MAX"]
    resolved.update({name: DEFAULTS[name] for name in inconsistent})
    return inconsistent


def _old_gains(values: Mapping[str, float]) -> dict[str, float]:
    """Convert the angle gains of ArduPlane before 4.1 to rate gains: P -> FF, D -> P, I tau -> I, IMAX/4500.

    Source: ArduPlane 4.1 release notes; FF' = FF + max((P - I tau) tau - D, 0) with tau the time constant.
    """
    rate_gains: dict[str, float] = {}
    for old, new in _OLD_PREFIXES:
        if not any(old + gain in values for gain in ("P", "I", "D", "FF", "IMAX")):
            continue
        p, i, d, ff, imax, tau = (float(values.get(old + gain, default)) for gain, default in _OLD_GAINS)
        rate_gains |= {new + "FF": ff + max((p - i * tau) * tau - d, 0.0), new + "P": d, new + "I": i * tau}
        rate_gains[new + "IMAX"] = imax / 4500.0
    return rate_gains
