"""Autopilot parameters of a simulated aircraft, with variations as from manual tuning."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fleet.autopilots import arduplane, px4_fixedwing
from fleet.simulator.vehicle.sensors import MOTOR_FULL, MOTOR_IDLE, SERVO_HIGH, SERVO_LOW, SERVO_TRIM
from fleet.simulator.vehicle.types import CRUISE


class Tuning(NamedTuple):
    """Parameters of one autopilot for one aircraft type."""

    defaults: Mapping[str, float]
    airframe: Mapping[str, float]  # values for this type; others stay at the defaults
    choices: Mapping[str, tuple[float, ...]]  # values that vary between aircraft


_SMALL_ARDUPLANE = Tuning(
    arduplane.DEFAULTS,
    {
        "AIRSPEED_CRUISE": CRUISE,
        "AIRSPEED_MIN": 17.0,
        "AIRSPEED_MAX": 31.0,
        "SCALING_SPEED": CRUISE,
        "TRIM_THROTTLE": 38.0,
        "TECS_CLMB_MAX": 4.0,
        "TECS_SINK_MIN": 2.4,
        "TECS_SINK_MAX": 4.0,
        "TECS_PITCH_MAX": 15.0,
        "TECS_PITCH_MIN": -15.0,
        "RLL_RATE_FF": 0.33,
        "RLL_RATE_P": 0.15,
        "RLL_RATE_I": 0.12,
        "RLL2SRV_RMAX": 75.0,
        "PTCH_RATE_FF": 0.65,
        "PTCH_RATE_P": 0.25,
        "PTCH_RATE_I": 0.30,
        "WP_LOITER_RAD": 90.0,
        "KFF_RDDRMIX": 0.3,
    },
    {
        "NAVL1_PERIOD": (14.0, 15.0, 17.0, 18.0),
        "NAVL1_DAMPING": (0.75, 0.8),
        "WP_RADIUS": (50.0, 60.0, 75.0, 90.0),
        "ROLL_LIMIT_DEG": (40.0, 45.0, 50.0),
        "TECS_TIME_CONST": (4.5, 5.0, 6.0),
        "TECS_SPDWEIGHT": (1.0, 1.0, 0.8),
        "RLL2SRV_TCONST": (0.4, 0.45, 0.5),
        "PTCH2SRV_TCONST": (0.45, 0.5),
    },
)
_C172P_ARDUPLANE = Tuning(
    arduplane.DEFAULTS,
    {
        "AIRSPEED_CRUISE": 48.0,
        "AIRSPEED_MIN": 36.0,
        "AIRSPEED_MAX": 60.0,
        "SCALING_SPEED": 48.0,
        "TRIM_THROTTLE": 66.0,
        "THR_SLEWRATE": 30.0,
        "TECS_CLMB_MAX": 3.5,
        "TECS_SINK_MIN": 2.0,
        "TECS_SINK_MAX": 4.0,
        "TECS_PITCH_MAX": 12.0,
        "TECS_PITCH_MIN": -10.0,
        "TECS_INTEG_GAIN": 0.1,
        "TECS_PTCH_DAMP": 0.6,
        "TECS_THR_DAMP": 0.7,
        "TECS_HDEM_TCONST": 5.0,
        "RLL_RATE_FF": 0.35,
        "RLL_RATE_P": 0.9,
        "RLL_RATE_I": 0.4,
        "RLL2SRV_RMAX": 45.0,
        "PTCH_RATE_FF": 0.4,
        "PTCH_RATE_P": 0.8,
        "PTCH_RATE_I": 0.6,
        "PTCH2SRV_RMAX_UP": 14.0,
        "PTCH2SRV_RMAX_DN": 11.0,
        "WP_LOITER_RAD": 450.0,
        "KFF_RDDRMIX": 0.05,
    },
    {
        "NAVL1_PERIOD": (17.0, 19.0, 21.0),
        "NAVL1_DAMPING": (0.75, 0.8),
        "WP_RADIUS": (200.0, 250.0, 300.0),
        "ROLL_LIMIT_DEG": (35.0, 40.0),
        "TECS_TIME_CONST": (7.0, 8.0),
        "RLL2SRV_TCONST": (0.7, 0.8),
        "PTCH2SRV_TCONST": (0.7, 0.8),
    },
)
_SMALL_PX4 = Tuning(
    px4_fixedwing.DEFAULTS,
    {
        "FW_AIRSPD_TRIM": CRUISE,
        "FW_AIRSPD_MIN": 17.0,
        "FW_AIRSPD_MAX": 31.0,
        "FW_THR_TRIM": 0.38,
        "FW_T_CLMB_MAX": 4.0,
        "FW_T_SINK_MIN": 2.4,
        "FW_T_SINK_MAX": 4.0,
        "FW_T_CLMB_R_SP": 2.5,
        "FW_P_LIM_MAX": 20.0,
        "FW_P_LIM_MIN": -20.0,
        "FW_RR_FF": 0.5,
        "FW_RR_P": 0.15,
        "FW_RR_I": 0.15,
        "FW_PR_FF": 0.8,
        "FW_PR_P": 0.3,
        "FW_PR_I": 0.35,
        "FW_YR_FF": 0.1,
        "FW_YR_P": 0.2,
        "NAV_LOITER_RAD": 90.0,
    },
    {
        "NPFG_PERIOD": (11.0, 12.0, 13.0, 14.0),
        "NPFG_DAMPING": (0.7, 0.75),
        "NPFG_SW_DST_MLT": (0.28, 0.32),
        "FW_R_LIM": (40.0, 45.0, 50.0),
        "FW_T_ALT_TC": (4.0, 5.0, 6.0),
        "FW_T_TAS_TC": (4.0, 5.0),
        "FW_T_SPDWEIGHT": (1.0, 1.0, 0.8),
        "FW_R_TC": (0.35, 0.4),
        "FW_P_TC": (0.4, 0.45),
    },
)
_C172P_PX4 = Tuning(
    px4_fixedwing.DEFAULTS,
    {
        "FW_AIRSPD_TRIM": 48.0,
        "FW_AIRSPD_MIN": 36.0,
        "FW_AIRSPD_MAX": 60.0,
        "FW_THR_TRIM": 0.66,
        "FW_THR_SLEW_MAX": 0.3,
        "FW_T_CLMB_MAX": 3.5,
        "FW_T_SINK_MIN": 2.0,
        "FW_T_SINK_MAX": 4.0,
        "FW_T_CLMB_R_SP": 2.5,
        "FW_T_PTCH_DAMP": 0.3,
        "FW_P_LIM_MAX": 12.0,
        "FW_P_LIM_MIN": -10.0,
        "FW_RR_FF": 0.45,
        "FW_RR_P": 1.1,
        "FW_RR_I": 0.5,
        "FW_R_RMAX": 45.0,
        "FW_P_RMAX_POS": 14.0,
        "FW_P_RMAX_NEG": 11.0,
        "FW_PR_FF": 0.5,
        "FW_PR_P": 1.0,
        "FW_PR_I": 0.8,
        "FW_YR_FF": 0.0,
        "FW_YR_P": 0.0,
        "FW_YR_I": 0.0,
        "NAV_LOITER_RAD": 450.0,
        "NAV_FW_ALT_RAD": 20.0,
    },
    {
        "NPFG_PERIOD": (15.0, 18.0, 20.0),
        "NPFG_DAMPING": (0.7, 0.75),
        "FW_R_LIM": (35.0, 40.0),
        "FW_T_ALT_TC": (6.0, 7.0),
        "FW_T_TAS_TC": (7.0, 8.0),
        "FW_R_TC": (0.7, 0.8),
        "FW_P_TC": (0.7, 0.8),
    },
)
TUNINGS = {
    ("ardupilot", "small"): _SMALL_ARDUPLANE,
    ("ardupilot", "c172p"): _C172P_ARDUPLANE,
    ("px4", "small"): _SMALL_PX4,
    ("px4", "c172p"): _C172P_PX4,
}
_PX4_OUTPUTS = {1: (201, 2), 2: (202, 3), 3: (101, 0), 4: (203, 4)}  # PWM_MAIN_FUNCn; CA_SV_CSn_TYPE: aileron, ...
_FUNCTIONS = {1: 4, 2: 19, 3: 70, 4: 21}  # SERVOn_FUNCTION: aileron, elevator, throttle, rudder


def tuned_parameters(seed: int, autopilot: str = "ardupilot", aircraft: str = "small") -> dict[str, float]:
    """Return the parameters of one aircraft in the names and units of its autopilot.

    Args:
        seed: seed of the variations between aircraft
        autopilot, aircraft: one pair of `TUNINGS`
    """
    rng = np.random.default_rng((seed, 3))
    tuning = TUNINGS[autopilot, aircraft]
    values = dict(tuning.defaults) | dict(tuning.airframe)
    for name, choices in tuning.choices.items():
        values[name] = float(rng.choice(choices))
    return values | (_outputs_px4() if autopilot == "px4" else _outputs_arduplane())


def _outputs_arduplane() -> dict[str, float]:
    values = {}
    for output, function in _FUNCTIONS.items():
        motor = function == 70
        values[f"SERVO{output}_FUNCTION"] = float(function)
        values[f"SERVO{output}_MIN"] = float(MOTOR_IDLE if motor else SERVO_LOW)
        values[f"SERVO{output}_MAX"] = float(MOTOR_FULL if motor else SERVO_HIGH)
        values[f"SERVO{output}_TRIM"] = float(MOTOR_IDLE if motor else SERVO_TRIM)
        values[f"SERVO{output}_REVERSED"] = 0.0
    return values


def _outputs_px4() -> dict[str, float]:
    values = {"PWM_MAIN_REV": 0.0}
    for output, (function, _) in _PX4_OUTPUTS.items():
        motor = function == 101
        values[f"PWM_MAIN_FUNC{output}"] = float(function)
        values[f"PWM_MAIN_MIN{output}"] = float(MOTOR_IDLE if motor else SERVO_LOW)
        values[f"PWM_MAIN_MAX{output}"] = float(MOTOR_FULL if motor else SERVO_HIGH)
    return values | {f"CA_SV_CS{function - 201}_TYPE": float(kind) for function, kind in _PX4_OUTPUTS.values() if kind}
