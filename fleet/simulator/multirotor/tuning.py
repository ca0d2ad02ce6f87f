"""Autopilot parameters of simulated multirotors, with variations as from manual tuning.

Source: parameter names, units and defaults of ArduCopter 4.6 and PX4 1.16; gains tuned for the airframes.
"""

from collections.abc import Mapping

import numpy as np

from fleet.simulator.multirotor.airframes import TYPES, hover_thrust

_ARDUCOPTER: dict[str, float] = {
    "FRAME_CLASS": 1.0,
    "FRAME_TYPE": 1.0,
    "WP_YAW_BEHAVIOR": 2.0,
    "WP_NAVALT_MIN": 0.0,
    "WPNAV_SPEED": 800.0,
    "WPNAV_SPEED_UP": 250.0,
    "WPNAV_SPEED_DN": 150.0,
    "WPNAV_ACCEL": 250.0,
    "WPNAV_ACCEL_Z": 100.0,
    "WPNAV_ACCEL_C": 0.0,
    "WPNAV_JERK": 1.0,
    "WPNAV_RADIUS": 200.0,
    "PSC_POSXY_P": 1.0,
    "PSC_VELXY_P": 2.0,
    "PSC_VELXY_I": 1.0,
    "PSC_VELXY_D": 0.25,
    "PSC_JERK_XY": 5.0,
    "PSC_POSZ_P": 1.0,
    "PSC_VELZ_P": 5.0,
    "PSC_ACCZ_P": 0.5,
    "PSC_ACCZ_I": 1.0,
    "PSC_JERK_Z": 5.0,
    "ANGLE_MAX": 3000.0,
    "ATC_INPUT_TC": 0.15,
    "ATC_SLEW_YAW": 6000.0,
    "ATC_THR_MIX_MAX": 0.9,
    "ATC_ANG_RLL_P": 4.5,
    "ATC_ANG_PIT_P": 4.5,
    "ATC_ANG_YAW_P": 3.0,
    "ATC_RAT_RLL_P": 0.12,
    "ATC_RAT_RLL_I": 0.12,
    "ATC_RAT_RLL_D": 0.003,
    "ATC_RAT_PIT_P": 0.12,
    "ATC_RAT_PIT_I": 0.12,
    "ATC_RAT_PIT_D": 0.003,
    "ATC_RAT_YAW_P": 0.9,
    "ATC_RAT_YAW_I": 0.09,
    "RTL_ALT": 3000.0,
    "RTL_ALT_FINAL": 0.0,
    "RTL_LOIT_TIME": 5000.0,
    "RTL_SPEED": 0.0,
    "RTL_CLIMB_MIN": 0.0,
    "RTL_CONE_SLOPE": 3.0,
    "LAND_SPEED": 50.0,
    "LAND_SPEED_HIGH": 0.0,
    "LAND_ALT_LOW": 1000.0,
    "LOIT_SPEED": 1250.0,
    "CIRCLE_RADIUS": 1000.0,
    "CIRCLE_RATE": 20.0,
    "MOT_THST_EXPO": 0.65,
    "MOT_SPIN_MIN": 0.15,
    "MOT_SPIN_MAX": 0.95,
    "MOT_SPIN_ARM": 0.1,
    "MOT_PWM_MIN": 1000.0,
    "MOT_PWM_MAX": 2000.0,
    "FS_GCS_ENABLE": 0.0,
    "FENCE_ENABLE": 0.0,
}
_PX4: dict[str, float] = {
    "CA_AIRFRAME": 0.0,
    "CA_ROTOR_COUNT": 4.0,
    "MPC_POS_MODE": 4.0,
    "MPC_YAW_MODE": 0.0,
    "MPC_XY_CRUISE": 6.0,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_HOR_MAX": 5.0,
    "MPC_JERK_AUTO": 4.0,
    "MPC_XY_TRAJ_P": 0.5,
    "MPC_XY_ERR_MAX": 2.0,
    "MPC_Z_V_AUTO_UP": 3.0,
    "MPC_Z_V_AUTO_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_ACC_UP_MAX": 4.0,
    "MPC_ACC_DOWN_MAX": 3.0,
    "MPC_XY_P": 0.95,
    "MPC_XY_VEL_P_ACC": 1.8,
    "MPC_XY_VEL_I_ACC": 0.4,
    "MPC_XY_VEL_D_ACC": 0.2,
    "MPC_Z_P": 1.0,
    "MPC_Z_VEL_P_ACC": 4.0,
    "MPC_Z_VEL_I_ACC": 2.0,
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_YAWRAUTO_MAX": 60.0,
    "MPC_TKO_SPEED": 1.5,
    "MPC_TKO_RAMP_T": 3.0,
    "MPC_LAND_SPEED": 0.7,
    "MPC_LAND_ALT1": 10.0,
    "MPC_LAND_ALT2": 5.0,
    "MPC_THR_MIN": 0.12,
    "NAV_ACC_RAD": 10.0,
    "NAV_MC_ALT_RAD": 0.8,
    "MIS_TAKEOFF_ALT": 2.5,
    "RTL_RETURN_ALT": 30.0,
    "RTL_LAND_DELAY": 0.0,
    "RTL_DESCEND_ALT": 30.0,
    "MC_ROLL_P": 5.5,
    "MC_PITCH_P": 5.5,
    "MC_YAW_P": 2.8,
    "THR_MDL_FAC": 0.6,
    "MC_ROLLRATE_P": 0.12,
    "MC_ROLLRATE_I": 0.12,
    "MC_ROLLRATE_D": 0.003,
    "MC_ROLLRATE_MAX": 220.0,
    "MC_PITCHRATE_P": 0.12,
    "MC_PITCHRATE_I": 0.12,
    "MC_PITCHRATE_D": 0.003,
    "MC_PITCHRATE_MAX": 220.0,
    "MC_YAWRATE_P": 0.9,
    "MC_YAWRATE_I": 0.09,
}
_LARGE = {  # slower motors
    "ardupilot": {"ATC_RAT_RLL_P": 0.09, "ATC_RAT_RLL_I": 0.09, "ATC_RAT_PIT_P": 0.09, "ATC_RAT_PIT_I": 0.09},
    "px4": {"MC_ROLL_P": 4.5, "MC_ROLLRATE_P": 0.09, "MC_ROLLRATE_I": 0.09, "MC_PITCHRATE_P": 0.09},
}
_CHOICES: Mapping[str, Mapping[str, tuple[float, ...]]] = {
    "ardupilot": {
        "WPNAV_SPEED": (500.0, 700.0, 800.0, 1000.0),
        "WPNAV_ACCEL": (150.0, 200.0, 250.0, 300.0),
        "WPNAV_JERK": (1.0, 1.0, 2.0),
        "WPNAV_RADIUS": (200.0, 200.0, 300.0),
        "PSC_POSXY_P": (0.9, 1.0, 1.2),
        "ATC_ANG_RLL_P": (4.0, 4.5, 5.0),
        "RTL_ALT": (2000.0, 3000.0, 4000.0),
        "CIRCLE_RATE": (10.0, 15.0, 20.0),
    },
    "px4": {
        "MPC_XY_CRUISE": (5.0, 6.0, 8.0),
        "MPC_ACC_HOR": (2.0, 3.0, 4.0),
        "MPC_JERK_AUTO": (4.0, 4.0, 6.0),
        "NAV_ACC_RAD": (2.0, 5.0, 10.0),
        "MPC_XY_P": (0.85, 0.95),
        "RTL_RETURN_ALT": (20.0, 30.0, 40.0),
    },
}
PULSE_MIN, PULSE_MAX = 1000, 2000  # of a motor output [us]


def tuned_parameters(seed: int, autopilot: str, aircraft: str) -> dict[str, float]:
    """Return the parameters of one aircraft in the names and units of its autopilot.

    Args:
        seed: seed of the variations between aircraft
        autopilot: ardupilot or px4
        aircraft: name in `airframes.TYPES`
    """
    rng = np.random.default_rng((seed, 3))
    values = dict(_PX4 if autopilot == "px4" else _ARDUCOPTER) | (_LARGE[autopilot] if aircraft == "quad_large" else {})
    for name, choices in _CHOICES[autopilot].items():
        values[name] = float(rng.choice(choices))
    hover = round(hover_thrust(TYPES[aircraft]), 3)
    if autopilot == "px4":
        outputs = {f"PWM_MAIN_FUNC{k}": 100.0 + k for k in range(1, 5)}
        limits = {f"PWM_MAIN_{end}{k}": v for k in range(1, 5) for end, v in (("MIN", 1000.0), ("MAX", 2000.0))}
        return values | outputs | limits | {"MPC_THR_HOVER": hover, "MC_PITCH_P": values["MC_ROLL_P"]}
    outputs = {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 5)}
    limits = {f"SERVO{k}_{end}": v for k in range(1, 5) for end, v in (("MIN", 1000.0), ("MAX", 2000.0))}
    return values | outputs | limits | {"MOT_THST_HOVER": hover, "ATC_ANG_PIT_P": values["ATC_ANG_RLL_P"]}


def motor_pulses(inputs: np.ndarray | None, armed: bool, params: Mapping[str, float]) -> tuple[int, int, int, int]:
    """Convert motor inputs 0..1 to pulse widths [us]; None: motors off, or idle when armed."""
    low, high = params.get("MOT_SPIN_MIN", 0.1), params.get("MOT_SPIN_MAX", 1.0)
    if inputs is None:
        rest = PULSE_MIN + round(1000 * params.get("MOT_SPIN_ARM", 0.1)) if armed else PULSE_MIN
        return rest, rest, rest, rest
    a, b, c, d = (PULSE_MIN + round((PULSE_MAX - PULSE_MIN) * (low + (high - low) * float(u))) for u in inputs)
    return a, b, c, d


def motor_inputs(pulses: tuple[int, int, int, int], params: Mapping[str, float]) -> np.ndarray:
    """Convert pulse widths [us] to motor inputs, (4,) [-]."""
    low, high = params.get("MOT_SPIN_MIN", 0.1), params.get("MOT_SPIN_MAX", 1.0)
    share = (np.array(pulses, float) - PULSE_MIN) / (PULSE_MAX - PULSE_MIN)
    return (share - low) / (high - low)
