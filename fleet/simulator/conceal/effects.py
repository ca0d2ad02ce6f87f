"""Table of hidden effects: airframe, channel, time profile and magnitude.

Magnitudes are those of realistic defects. `reported` lists the values that a report should contain, in its units, where
they are known beforehand. Names that begin with _ are not in the catalogue.
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


class Hidden(NamedTuple):
    """One effect that can be hidden."""

    channel: str  # effects of one channel are not separable
    draw: Draw
    comes: tuple[str, ...] = ("always", "step")  # time profiles, equally probable
    airframes: tuple[str, ...] = BOTH
    of: tuple[str, ...] = ("",)
    told: tuple[str, ...] | None = ()  # values that a report should contain; None: all


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1, 1]) * rng.uniform(low, high))


def _between(key: str, cessna: tuple[float, float], small: tuple[float, float]) -> Draw:
    return lambda rng, is_small: {key: float(rng.uniform(*(small if is_small else cessna)))}


def _either(key: str, cessna: tuple[float, float], small: tuple[float, float]) -> Draw:
    return lambda rng, is_small: {key: _signed(rng, *(small if is_small else cessna))}


def _fixed(**values: float) -> Draw:
    return lambda rng, is_small: dict(values)


def _blown(key: str, cessna: tuple[float, float], small: tuple[float, float]) -> Draw:
    speed = _between(key, cessna, small)
    return lambda rng, is_small: speed(rng, is_small) | {"from_deg": float(rng.uniform(0.0, 360.0))}


def _icing(rng: np.random.Generator, is_small: bool) -> Values:
    return {
        "lift_loss": float(rng.uniform(0.09, 0.18)),
        "dCD": float(rng.uniform(0.014, 0.03) * (1.3 if is_small else 1)),
    }


def _misaligned(rng: np.random.Generator, is_small: bool) -> Values:
    return {name: _signed(rng, 1.5, 4.5) for name in ("roll_deg", "pitch_deg", "yaw_deg")}


def _scaled(rng: np.random.Generator, is_small: bool) -> Values:
    return {"scale": float(rng.choice([rng.uniform(0.84, 0.93), rng.uniform(1.07, 1.14)]))}


def _dense(rng: np.random.Generator, is_small: bool) -> Values:
    return {"density_ratio": float(rng.choice([rng.uniform(0.84, 0.93), rng.uniform(1.06, 1.1)], p=[0.75, 0.25]))}


def _same(low: float, high: float) -> tuple[tuple[float, float], tuple[float, float]]:
    return (low, high), (low, high)


_ALWAYS, _STEPS = ("always",), ("step",)
HIDDEN: dict[str, Hidden] = {
    "wind_steady": Hidden("air", _blown("speed_mps", (4.0, 9.0), (2.5, 5.0)), told=None),
    "wind_shear": Hidden("air", _blown("mps_per_100m", *_same(2.5, 5.0)), _ALWAYS, CESSNA, told=None),
    "gust_discrete": Hidden("air", _blown("speed_mps", (5.0, 9.0), (3.0, 6.0)), ("pass",), told=None),
    "updraft": Hidden("air", _either("speed_mps", (2.5, 5.0), (1.5, 3.0)), ("pass",), told=None),
    "turbulence": Hidden("air", _between("w20_mps", *_same(6.0, 11.0))),
    "air_density": Hidden("air", _dense, _ALWAYS),
    "actuator_lag": Hidden("servo", _between("tau_s", (0.15, 0.4), (0.12, 0.3)), of=SURFACES, told=None),
    "actuator_delay": Hidden("servo", _between("delay_s", (0.12, 0.3), (0.08, 0.2)), of=SURFACES, told=None),
    "actuator_rate_limit": Hidden("servo", _between("rate_per_s", (0.08, 0.25), (0.2, 0.6)), of=SURFACES, told=None),
    "actuator_deadband": Hidden("servo", _between("half_width", (0.04, 0.1), (0.04, 0.1)), of=SURFACES, told=None),
    "actuator_offset": Hidden("servo", _either("offset", (0.08, 0.2), (0.08, 0.2)), of=SURFACES, told=None),
    "actuator_stuck": Hidden("servo", _either("position", (0.05, 0.25), (0.04, 0.15)), of=("rudder",)),
    "control_effectiveness_loss": Hidden("servo", _between("loss", *_same(0.3, 0.6)), of=SURFACES, told=None),
    "prop_torque": Hidden("roll", _fixed(sense=1.0), _ALWAYS, CESSNA),
    "p_factor": Hidden("yaw", _between("inches_per_rad", *_same(60.0, 140.0)), _ALWAYS, CESSNA),
    "slipstream_tail": Hidden("pitch", _fixed(share=1.0), _ALWAYS, CESSNA),
    "thrust_loss": Hidden("force", _between("fraction", (0.15, 0.3), (0.15, 0.35))),
    "drag_increase": Hidden("force", _between("dCD", (0.015, 0.04), (0.02, 0.05)), told=None),
    "icing": Hidden("force", _icing, ("ramp",), told=None),
    "flap_deployed": Hidden("force", lambda rng, _: {"flap_deg": float(rng.choice([10, 20]))}, airframes=CESSNA),
    "mass_change": Hidden("force", _either("dmass_kg", (55.0, 110.0), (0.9, 1.8)), told=None),
    "cg_shift": Hidden("pitch", _either("dx_m", (0.04, 0.1), (0.008, 0.02)), told=None),
    "airspeed_scale": Hidden("airspeed", _scaled, told=None),
    "airspeed_bias": Hidden("airspeed", _either("bias_mps", (2.5, 5.0), (1.5, 3.0)), told=None),
    "gps_latency": Hidden("gps", _between("latency_s", *_same(0.2, 0.5)), told=None),
    "imu_misalignment": Hidden("imu", _misaligned, told=None),
    "gyro_bias": Hidden("imu", _either("bias_dps", *_same(0.7, 2.0)), of=("p", "q", "r"), told=None),
    "accel_bias": Hidden("imu", _either("bias_mps2", *_same(0.3, 0.8)), of=("x", "y", "z"), told=None),
    "heading_bias": Hidden("heading", _either("bias_deg", *_same(6.0, 15.0)), told=None),
    # a constant bias is equivalent to a different sea level pressure
    "baro_bias": Hidden("baro", _either("bias_m", (10.0, 25.0), (8.0, 20.0)), _STEPS, told=None),
}
UNKNOWN: dict[str, Hidden] = {
    "_crossed_linkage": Hidden("", _either("gain", *_same(0.7, 1.2)), _STEPS),
    "_torn_fin": Hidden("", _fixed(C_n_beta=0.3, C_Y_beta=0.5), _STEPS),
    "_roll_damping": Hidden("", lambda rng, _: {"C_l_p": float(rng.choice([0.35, 1.9]))}, _STEPS),
    "_pitch_damping": Hidden("", lambda rng, _: {"C_m_q": float(rng.choice([0.2, 2.2]))}, _STEPS),
    "_loose_hinge": Hidden("", lambda rng, _: {"half_width": rng.uniform(0.03, 0.05), "hertz": rng.uniform(0.6, 1.2)}),
    "_surging_engine": Hidden("", lambda rng, _: {"fraction": rng.uniform(0.25, 0.4), "hertz": rng.uniform(0.15, 0.4)}),
    "_sloshing_tank": Hidden("", _fixed(m_per_mps2=0.35, most_m=0.7, tau_s=1.5), airframes=CESSNA),
    "_gyro_scale": Hidden("", _either("scale", *_same(0.15, 0.3)), _STEPS),
    "_pitot_lag": Hidden("", _between("tau_s", *_same(3.0, 6.0)), _STEPS),
}


def told(name: str, airframe: str, values: Mapping[str, float]) -> Values:
    """Return the expected report values known from the draw; a servo lag includes that of the healthy servo."""
    if name == "thrust_loss" and airframe == "small":
        return dict(values)
    if name == "actuator_lag":
        return {"tau_s": values["tau_s"] + SERVO_LAG_S[airframe]}
    wanted = (HIDDEN | UNKNOWN)[name].told
    return dict(values) if wanted is None else {key: values[key] for key in wanted}
