"""PX4 fixed-wing parameters as one SI vector for the compiled controller; guidance by NPFG, before 1.13 by L1.

Source: PX4 parameter reference 1.6 to 1.16 (names, defaults, units); older names from its release notes.
"""

from collections.abc import Mapping
from math import radians

import numpy as np

from fleet.autopilots.control_law import PX4, ParameterSpec, eas2tas, lookup, padded

_DEG = radians(1.0)

TABLE = (
    ParameterSpec("NPFG_PERIOD", 10, 1, 1, 100),
    ParameterSpec("NPFG_DAMPING", 0.7071, 1, 0.1, 1),
    ParameterSpec("NPFG_ROLL_TC", 0.5, 1, 0.05, 2),
    ParameterSpec("NPFG_SW_DST_MLT", 0.32, 1, 0.1, 1),
    ParameterSpec("NPFG_PERIOD_SF", 1.5, 1, 1, 3),
    ParameterSpec("NPFG_LB_PERIOD", 1, 1, 0, 1),
    ParameterSpec("FW_R_LIM", 50, _DEG, 10, 80),
    ParameterSpec("FW_PN_R_SLEW_MAX", 90, _DEG, 0, 1000, (("FW_L1_R_SLEW_MAX", 1),)),
    ParameterSpec("NAV_ACC_RAD", 10, 1, 0.05, 1e4),
    ParameterSpec("NAV_LOITER_RAD", 80, 1, -1e4, 1e4),
    ParameterSpec("NAV_FW_ALT_RAD", 10, 1, 0.05, 1e4),
    ParameterSpec("FW_T_CLMB_MAX", 5, 1, 0.5, 100),
    ParameterSpec("FW_T_SINK_MIN", 2, 1, 0.1, 100),
    ParameterSpec("FW_T_SINK_MAX", 5, 1, 0.5, 100),
    ParameterSpec("FW_T_CLMB_R_SP", 3, 1, 0.1, 100),
    ParameterSpec("FW_T_SINK_R_SP", 2, 1, 0.1, 100),
    ParameterSpec("FW_T_ALT_TC", 5, 1, 0.5, 100),
    ParameterSpec("FW_T_TAS_TC", 5, 1, 0.5, 100),
    ParameterSpec("FW_T_HRATE_FF", 0.3, 1, 0, 1),
    ParameterSpec("FW_T_PTCH_DAMP", 0.1, 1, 0, 10),
    ParameterSpec("FW_T_THR_DAMPING", 0.05, 1, 0, 10, (("FW_T_THR_DAMP", 1),)),
    ParameterSpec("FW_T_I_GAIN_PIT", 0.1, 1, 0, 10, (("FW_T_INTEG_GAIN", 1),)),
    ParameterSpec("FW_T_THR_INTEG", 0.02, 1, 0, 10, (("FW_T_I_GAIN_THR", 1), ("FW_T_INTEG_GAIN", 1))),
    ParameterSpec("FW_T_SPDWEIGHT", 1, 1, 0, 2),
    ParameterSpec("FW_T_VERT_ACC", 7, 1, 0.1, 100),
    ParameterSpec("FW_T_RLL2THR", 15, 1, 0, 1000),
    ParameterSpec("FW_T_STE_R_TC", 0.4, 1, 0, 10),
    ParameterSpec("FW_T_SEB_R_FF", 1, 1, 0, 10),
    ParameterSpec("FW_THR_TRIM", 0.6, 1, 0, 1, (("FW_THR_CRUISE", 1),)),
    ParameterSpec("FW_THR_MIN", 0, 1, 0, 1),
    ParameterSpec("FW_THR_MAX", 1, 1, 0.01, 1),
    ParameterSpec("FW_THR_SLEW_MAX", 0, 1, 0, 100),
    ParameterSpec("FW_AIRSPD_TRIM", 15, 1, 1, 300),
    ParameterSpec("FW_AIRSPD_MIN", 10, 1, 1, 300),
    ParameterSpec("FW_AIRSPD_MAX", 20, 1, 1, 300),
    ParameterSpec("FW_P_LIM_MAX", 30, _DEG, 1, 90),
    ParameterSpec("FW_P_LIM_MIN", -30, _DEG, -90, -1),
    ParameterSpec("FW_PSP_OFF", 0, _DEG, -90, 90),
    ParameterSpec("FW_R_TC", 0.4, 1, 0.05, 10),
    ParameterSpec("FW_P_TC", 0.4, 1, 0.05, 10),
    ParameterSpec("FW_R_RMAX", 70, _DEG, 0, 1000),
    ParameterSpec("FW_P_RMAX_POS", 60, _DEG, 0, 1000),
    ParameterSpec("FW_P_RMAX_NEG", 60, _DEG, 0, 1000),
    ParameterSpec("FW_Y_RMAX", 50, _DEG, 0, 1000),
    ParameterSpec("FW_ARSP_SCALE_EN", 1, 1, 0, 1),
    ParameterSpec("FW_RR_FF", 0.5, 1, 0, 100),
    ParameterSpec("FW_RR_P", 0.05, 1, 0, 100),
    ParameterSpec("FW_RR_I", 0.1, 1, 0, 100),
    ParameterSpec("FW_RR_IMAX", 0.2, 1, 0, 1),
    ParameterSpec("FW_PR_FF", 0.5, 1, 0, 100),
    ParameterSpec("FW_PR_P", 0.08, 1, 0, 100),
    ParameterSpec("FW_PR_I", 0.1, 1, 0, 100),
    ParameterSpec("FW_PR_IMAX", 0.4, 1, 0, 1),
    ParameterSpec("FW_YR_FF", 0.3, 1, 0, 100),
    ParameterSpec("FW_YR_P", 0.05, 1, 0, 100),
    ParameterSpec("FW_YR_I", 0.1, 1, 0, 100),
    ParameterSpec("FW_YR_IMAX", 0.2, 1, 0, 1),
)

# Index of each parameter in `par`, in the order of the table.
(
    PERIOD, DAMPING, NPFG_TC, SWITCH, PERIOD_SF, LB_PERIOD, ROLL_LIMIT, ROLL_SLEW, ACC_RAD, LOITER_RAD, ALT_RAD,
    CLIMB_MAX, SINK_MIN, SINK_MAX, CLIMB, SINK, ALT_TC, TAS_TC, H_RATE_FF, PITCH_DAMP, THR_DAMP, I_PITCH, I_THROTTLE,
    SPEED_WEIGHT, VERT_ACC, ROLL_TO_THR, STE_TC, SEB_FF, THR_TRIM, THR_MIN, THR_MAX, THR_SLEW,
    VA_CRUISE, VA_MIN, VA_MAX, PITCH_HIGH, PITCH_LOW, PITCH_OFFSET,
    ROLL_TC, PITCH_TC, ROLL_RMAX, PITCH_UP, PITCH_DOWN, YAW_RMAX, SCALED,
    ROLL_FF, ROLL_P, ROLL_I, ROLL_IMAX, PITCH_FF, PITCH_P, PITCH_I, PITCH_IMAX, YAW_FF, YAW_P, YAW_I, YAW_IMAX,
) = range(len(TABLE))  # fmt: skip
EAS2TAS = len(TABLE)  # ratio of true to equivalent airspeed [-]
USES_L1 = len(TABLE) + 1  # 1: guidance by L1 instead of NPFG

_NPFG_ONLY = (NPFG_TC, SWITCH, PERIOD_SF, LB_PERIOD)
L1_TABLE = (
    ParameterSpec("FW_L1_PERIOD", 20, 1, 1, 100),
    ParameterSpec("FW_L1_DAMPING", 0.75, 1, 0.1, 1),
    *(row for i, row in enumerate(TABLE) if i not in (PERIOD, DAMPING, *_NPFG_ONLY)),
)
"""Parameters with guidance by L1: period and damping of its own, none of NPFG."""

NAMES = tuple(row.name for row in TABLE)
L1_NAMES = tuple(row.name for row in L1_TABLE)
DEFAULTS: dict[str, float] = {row.name: float(row.default) for row in TABLE}
_CONSISTENT_GROUPS = (  # lower limit, upper limit, value: all reset to defaults if inconsistent
    (VA_MIN, VA_MAX, VA_CRUISE),
    (THR_MIN, THR_MAX, THR_TRIM),
)


def parameters(values: Mapping[str, float], altitude_m: float = 0.0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert autopilot parameters to the vector for the kernels, with guidance by NPFG.

    Args:
        values: parameters in the names (current or older) and units of the autopilot
        altitude_m: height above mean sea level, for true airspeed [m]
    Returns:
        par: SI and rad, throttles 0..1, no wind, (N_PAR,)
        absent: names that are missing, not finite or out of range; `par` contains their defaults
    """
    return _vector(TABLE, values, altitude_m, uses_l1=False)


def l1_parameters(values: Mapping[str, float], altitude_m: float = 0.0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert autopilot parameters to the vector for the kernels, with guidance by L1; see `parameters`."""
    slots = [i for i in range(len(TABLE)) if i not in _NPFG_ONLY]
    rows = list(TABLE)
    for i, row in zip(slots, L1_TABLE, strict=True):
        rows[i] = row
    par, absent = _vector(tuple(rows), values, altitude_m, uses_l1=True)
    return par, tuple(name for name in absent if name in L1_NAMES)


def _vector(
    rows: tuple[ParameterSpec, ...], values: Mapping[str, float], altitude_m: float, *, uses_l1: bool
) -> tuple[np.ndarray, tuple[str, ...]]:
    inputs = {name: float(value) for name, value in values.items()}
    matches = [lookup(row, inputs) for row in rows]
    absent = [row.name for row, value in zip(rows, matches, strict=True) if value is None]
    values_si = np.array([(row.default if v is None else v) * row.factor for row, v in zip(rows, matches, strict=True)])
    for group in _CONSISTENT_GROUPS:
        if not values_si[group[0]] < values_si[group[1]]:
            values_si[list(group)] = [rows[i].default * rows[i].factor for i in group]
            absent += [rows[i].name for i in group]
    par = np.concatenate([values_si, [eas2tas(altitude_m), float(uses_l1)]])
    return padded(par, PX4), tuple(dict.fromkeys(absent))


MIN_DISTANCE = 10  # minimum distance to the waypoint so far, -1 before [m]
PHI = 12  # roll demand, slew-limited [rad]
ON_CIRCLE = 13  # L1: 1 on a circle, 0 approaching its centre
H_REF, H_DOT_REF = 25, 26  # height reference, up positive [m], and its rate [m/s]
STE_DOT = 31  # filtered total energy rate [m2/s3]
I_THETA = 33  # pitch integrator [rad]
I_R = 45  # yaw rate integrator, 1 = full throw
S_R, S_A, S_E = 46, 49, 50  # last surfaces before the limit, 1 = full throw
