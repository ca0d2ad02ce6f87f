"""Table of hidden effects: airframe, channel, time profile and magnitude.

Magnitudes are those of realistic defects. Names that begin with _ are not in the catalogue.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from fleet.simulator.faults.servos import SURFACES

Values = dict[str, float]
Draw = Callable[[np.random.Generator, bool], Values]
"""(random generator, is the small aircraft) to the values of the fault."""

BOTH, CESSNA, SMALL = ("c172p", "small"), ("c172p",), ("small",)
SERVO_LAG_S = {"c172p": 0.0, "small": 1 / 22}  # of the healthy servo, from the aircraft file


class HiddenEffect(NamedTuple):
    """One effect that can be hidden."""

    channel: str  # effects of one channel are not separable
    draw: Draw
    profiles: tuple[str, ...] = ("always", "step")  # time profiles, equally probable
    airframes: tuple[str, ...] = BOTH
    parts: tuple[str, ...] = ("",)


def _random_sign(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1, 1]) * rng.uniform(low, high))


def _uniform(key: str, cessna: tuple[float, float], small: tuple[float, float]) -> Draw:
    return lambda rng, is_small: {key: float(rng.uniform(*(small if is_small else cessna)))}


def _uniform_signed(key: str, cessna: tuple[float, float], small: tuple[float, float]) -> Draw:
    return lambda rng, is_small: {key: _random_sign(rng, *(small if is_small else cessna))}


def _fixed(**values: float) -> Draw:
    return lambda rng, is_small: dict(values)


def _wind(key: str, cessna: tuple[float, float], small: tuple[float, float]) -> Draw:
    speed = _uniform(key, cessna, small)
    return lambda rng, is_small: speed(rng, is_small) | {"from_deg": float(rng.uniform(0.0, 360.0))}


def _icing(rng: np.random.Generator, is_small: bool) -> Values:
    return {
        "lift_loss": float(rng.uniform(0.09, 0.18)),
        "dCD": float(rng.uniform(0.014, 0.03) * (1.3 if is_small else 1)),
    }


def _misalignment(rng: np.random.Generator, is_small: bool) -> Values:
    return {name: _random_sign(rng, 1.5, 4.5) for name in ("roll_deg", "pitch_deg", "yaw_deg")}


def _airspeed_scale(rng: np.random.Generator, is_small: bool) -> Values:
    return {"scale": float(rng.choice([rng.uniform(0.84, 0.93), rng.uniform(1.07, 1.14)]))}


def _density(rng: np.random.Generator, is_small: bool) -> Values:
    return {"density_ratio": float(rng.choice([rng.uniform(0.84, 0.93), rng.uniform(1.06, 1.1)], p=[0.75, 0.25]))}


def _damping(key: str, derivative: Mapping[str, float]) -> Draw:
    """Draw a change of a damping derivative: 40 to 70 % less, or 50 to 110 % more."""

    def draw(rng: np.random.Generator, is_small: bool) -> Values:
        share = rng.choice([rng.uniform(-0.7, -0.4), rng.uniform(0.5, 1.1)])
        return {key: float(share) * derivative["small" if is_small else "c172p"]}

    return draw


def _both(low: float, high: float) -> tuple[tuple[float, float], tuple[float, float]]:
    return (low, high), (low, high)


_ALWAYS, _STEPS = ("always",), ("step",)
HIDDEN: dict[str, HiddenEffect] = {
    "wind_steady": HiddenEffect("air", _wind("speed_mps", (4.0, 9.0), (2.5, 5.0))),
    "wind_shear": HiddenEffect("air", _wind("mps_per_100m", *_both(2.5, 5.0)), _ALWAYS, CESSNA),
    "gust_discrete": HiddenEffect("air", _wind("speed_mps", (5.0, 9.0), (3.0, 6.0)), ("pass",)),
    "updraft": HiddenEffect("air", _uniform_signed("speed_mps", (2.5, 5.0), (1.5, 3.0)), ("pass",)),
    "turbulence": HiddenEffect("air", _uniform("w20_mps", *_both(6.0, 11.0))),
    "air_density": HiddenEffect("air", _density, _ALWAYS),
    "actuator_lag": HiddenEffect("servo", _uniform("tau_s", (0.15, 0.4), (0.12, 0.3)), parts=SURFACES),
    "actuator_delay": HiddenEffect("servo", _uniform("delay_s", (0.12, 0.3), (0.08, 0.2)), parts=SURFACES),
    "actuator_rate_limit": HiddenEffect("servo", _uniform("rate_per_s", (0.08, 0.25), (0.2, 0.6)), parts=SURFACES),
    "actuator_deadband": HiddenEffect("servo", _uniform("half_width", (0.04, 0.1), (0.04, 0.1)), parts=SURFACES),
    "actuator_offset": HiddenEffect("servo", _uniform_signed("offset", (0.08, 0.2), (0.08, 0.2)), parts=SURFACES),
    "actuator_stuck": HiddenEffect("servo", _uniform_signed("position", (0.05, 0.25), (0.04, 0.15)), parts=("rudder",)),
    "control_effectiveness_loss": HiddenEffect("servo", _uniform("loss", *_both(0.3, 0.6)), parts=SURFACES),
    "prop_torque": HiddenEffect("roll", _fixed(sense=1.0), _ALWAYS, CESSNA),
    "p_factor": HiddenEffect("yaw", _uniform("inches_per_rad", *_both(60.0, 140.0)), _ALWAYS, CESSNA),
    "slipstream_tail": HiddenEffect("pitch", _fixed(share=1.0), _ALWAYS, CESSNA),
    "thrust_loss": HiddenEffect("force", _uniform("fraction", (0.15, 0.3), (0.15, 0.35))),
    "drag_increase": HiddenEffect("force", _uniform("dCD", (0.015, 0.04), (0.02, 0.05))),
    "icing": HiddenEffect("force", _icing, ("ramp",)),
    "flap_deployed": HiddenEffect("force", lambda rng, _: {"flap_deg": float(rng.choice([10, 20]))}, airframes=CESSNA),
    "mass_change": HiddenEffect("force", _uniform_signed("dmass_kg", (55.0, 110.0), (0.9, 1.8))),
    "cg_shift": HiddenEffect("pitch", _uniform_signed("dx_m", (0.04, 0.1), (0.008, 0.02))),
    "airspeed_scale": HiddenEffect("airspeed", _airspeed_scale),
    "airspeed_bias": HiddenEffect("airspeed", _uniform_signed("bias_mps", (2.5, 5.0), (1.5, 3.0))),
    "gps_latency": HiddenEffect("gps", _uniform("latency_s", *_both(0.2, 0.5))),
    "imu_misalignment": HiddenEffect("imu", _misalignment),
    "gyro_bias": HiddenEffect("imu", _uniform_signed("bias_dps", *_both(0.7, 2.0)), parts=("p", "q", "r")),
    "accel_bias": HiddenEffect("imu", _uniform_signed("bias_mps2", *_both(0.3, 0.8)), parts=("x", "y", "z")),
    "heading_bias": HiddenEffect("heading", _uniform_signed("bias_deg", *_both(6.0, 15.0))),
    # a constant bias is equivalent to a different sea level pressure
    "roll_damping": HiddenEffect("roll", _damping("dC_l_p", {"c172p": -0.484, "small": -0.51})),
    "pitch_damping": HiddenEffect("pitch", _damping("dC_m_q", {"c172p": -12.4, "small": -38.21})),
    "baro_bias": HiddenEffect("baro", _uniform_signed("bias_m", (10.0, 25.0), (8.0, 20.0)), _STEPS),
}
UNKNOWN: dict[str, HiddenEffect] = {
    "_crossed_linkage": HiddenEffect("", _uniform_signed("gain", *_both(0.7, 1.2)), _STEPS),
    "_torn_fin": HiddenEffect("", _fixed(C_n_beta=0.3, C_Y_beta=0.5), _STEPS),
    "_loose_hinge": HiddenEffect(
        "", lambda rng, _: {"half_width": rng.uniform(0.03, 0.05), "hertz": rng.uniform(0.6, 1.2)}
    ),
    "_surging_engine": HiddenEffect(
        "", lambda rng, _: {"fraction": rng.uniform(0.25, 0.4), "hertz": rng.uniform(0.15, 0.4)}
    ),
    "_sloshing_tank": HiddenEffect("", _fixed(m_per_mps2=0.35, most_m=0.7, tau_s=1.5), airframes=CESSNA),
    "_gyro_scale": HiddenEffect("", _uniform_signed("scale", *_both(0.15, 0.3)), _STEPS),
    "_accelerometer_scale": HiddenEffect("", _uniform_signed("scale", *_both(0.06, 0.12)), _STEPS),
    "_static_line_lag": HiddenEffect("", _uniform("tau_s", *_both(5.0, 10.0)), _STEPS),
    "_pitot_lag": HiddenEffect("", _uniform("tau_s", *_both(3.0, 6.0)), _STEPS),
}
_UNREPORTED = (  # values that a report contains in other terms
    *("turbulence", "air_density", "actuator_stuck", "thrust_loss", "flap_deployed"),
    *("prop_torque", "p_factor", "slipstream_tail"),
)


_UNSCALED = ("from_deg", "position", "sense")
_RATIOS = ("scale", "density_ratio")


def scaled_values(name: str, values: Mapping[str, float], share: float) -> Values:
    """Return the values of an effect of `share` times the magnitude; unknown effects, directions and positions stay."""
    if name not in HIDDEN:
        return dict(values)
    out = {}
    for key, value in values.items():
        if key in _UNSCALED:
            out[key] = value
        elif key in _RATIOS:
            out[key] = 1.0 + share * (value - 1.0)
        else:
            out[key] = value / share if key == "rate_per_s" else value * share
    return out


def reported_values(name: str, airframe: str, values: Mapping[str, float]) -> Values:
    """Return the expected report values known from the draw; a servo lag includes that of the healthy servo."""
    if name == "thrust_loss" and airframe == "small":
        return {"loss": values["fraction"]}
    if name == "actuator_lag":
        return {"tau_s": values["tau_s"] + SERVO_LAG_S[airframe]}
    return dict(values) if name in HIDDEN and name not in _UNREPORTED else {}
