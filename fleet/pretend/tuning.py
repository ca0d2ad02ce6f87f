"""Autopilot parameters of a pretend aircraft, as somebody who tuned each one by hand would have left them."""

import numpy as np

from fleet.autopilots.arduplane import DEFAULTS
from fleet.pretend.jsbsim import CRUISE
from fleet.pretend.sensors import Servos

AIRFRAME = {  # what this type of aircraft needs; the rest stays at ArduPlane's defaults
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
}
CHOICES: dict[str, tuple[float, ...]] = {  # what differs from one aircraft to the next
    "NAVL1_PERIOD": (14.0, 15.0, 17.0, 18.0),
    "NAVL1_DAMPING": (0.75, 0.8),
    "WP_RADIUS": (50.0, 60.0, 75.0, 90.0),
    "ROLL_LIMIT_DEG": (40.0, 45.0, 50.0),
    "TECS_TIME_CONST": (4.5, 5.0, 6.0),
    "TECS_SPDWEIGHT": (1.0, 1.0, 0.8),
    "RLL2SRV_TCONST": (0.4, 0.45, 0.5),
    "PTCH2SRV_TCONST": (0.45, 0.5),
}
_FUNCTIONS = {1: 4, 2: 19, 3: 70, 4: 21}  # SERVOn_FUNCTION: aileron, elevator, throttle, rudder


def tuned(seed: int) -> dict[str, float]:
    """Give the parameters of one aircraft in ArduPilot's names and units."""
    rng = np.random.default_rng((seed, 3))
    values = dict(DEFAULTS) | AIRFRAME
    for name, choices in CHOICES.items():
        values[name] = float(rng.choice(choices))
    for output, function in _FUNCTIONS.items():
        motor = function == 70
        values[f"SERVO{output}_FUNCTION"] = float(function)
        values[f"SERVO{output}_MIN"] = float(Servos.IDLE if motor else Servos.LOW)
        values[f"SERVO{output}_MAX"] = float(Servos.FULL if motor else Servos.HIGH)
        values[f"SERVO{output}_TRIM"] = float(Servos.IDLE if motor else Servos.TRIM)
        values[f"SERVO{output}_REVERSED"] = 0.0
    return values
