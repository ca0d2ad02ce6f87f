"""Table of faults: parts, parameters and ranges; and the syntax of a fault on the command line."""

from collections.abc import Mapping
from math import inf, isfinite
from typing import NamedTuple

from fleet.simulator.faults.fault import Fault
from fleet.simulator.faults.servos import SURFACES


class Range(NamedTuple):
    """Range of a parameter."""

    low: float
    high: float
    needed: bool = True


class Kind(NamedTuple):
    """One kind of fault."""

    values: Mapping[str, Range]
    of: tuple[str, ...] = ()  # surfaces or axes; one is required
    passes: bool = False  # has an end
    aircraft: tuple[str, ...] = ("small", "c172p")


_ANGLE = Range(-15.0, 15.0, needed=False)
_SPEED, _FROM = Range(0.0, 20.0), Range(-360.0, 360.0)
_CESSNA = ("c172p",)

KINDS: dict[str, Kind] = {
    "actuator_lag": Kind({"tau_s": Range(0.0, 2.0)}, SURFACES),
    "actuator_delay": Kind({"delay_s": Range(0.0, 1.0)}, SURFACES),
    "actuator_rate_limit": Kind({"rate_per_s": Range(0.01, 50.0)}, SURFACES),
    "actuator_deadband": Kind({"half_width": Range(0.0, 0.5)}, SURFACES),
    "actuator_saturation": Kind({"limit": Range(0.0, 1.0)}, SURFACES),
    "actuator_offset": Kind({"offset": Range(-0.6, 0.6)}, SURFACES),
    "actuator_stuck": Kind({"position": Range(-1.0, 1.0, needed=False)}, SURFACES),
    "control_effectiveness_loss": Kind({"loss": Range(0.0, 1.0)}, SURFACES),
    "airspeed_scale": Kind({"scale": Range(0.3, 2.0)}),
    "airspeed_bias": Kind({"bias_mps": Range(-15.0, 15.0)}),
    "gps_latency": Kind({"latency_s": Range(0.0, 2.0)}),
    "imu_misalignment": Kind({"roll_deg": _ANGLE, "pitch_deg": _ANGLE, "yaw_deg": _ANGLE}),
    "gyro_bias": Kind({"bias_dps": Range(-15.0, 15.0)}, ("p", "q", "r")),
    "accel_bias": Kind({"bias_mps2": Range(-5.0, 5.0)}, ("x", "y", "z")),
    "heading_bias": Kind({"bias_deg": Range(-60.0, 60.0)}),
    "baro_bias": Kind({"bias_m": Range(-100.0, 100.0)}),
    "wind_steady": Kind({"speed_mps": _SPEED, "from_deg": _FROM}),
    "wind_shear": Kind({"mps_per_100m": _SPEED, "from_deg": _FROM}),
    "gust_discrete": Kind({"speed_mps": _SPEED, "from_deg": _FROM}, passes=True),
    "updraft": Kind({"speed_mps": Range(-15.0, 15.0)}, passes=True),
    "turbulence": Kind({"w20_mps": Range(0.0, 25.0)}),
    "air_density": Kind({"density_ratio": Range(0.6, 1.3)}),
    "thrust_loss": Kind({"fraction": Range(0.0, 1.0)}),
    "drag_increase": Kind({"dCD": Range(-0.02, 0.2)}),
    "icing": Kind({"lift_loss": Range(0.0, 0.5), "dCD": Range(0.0, 0.2)}),
    "flap_deployed": Kind({"flap_deg": Range(0.0, 30.0)}, aircraft=_CESSNA),
    "mass_change": Kind({"dmass_kg": Range(-200.0, 200.0)}),
    "cg_shift": Kind({"dx_m": Range(-0.3, 0.3)}),
    "prop_torque": Kind({"sense": Range(-1.0, 1.0)}, aircraft=_CESSNA),
    "p_factor": Kind({"inches_per_rad": Range(-300.0, 300.0)}, aircraft=_CESSNA),
    "slipstream_tail": Kind({"share": Range(0.0, 3.0)}, aircraft=_CESSNA),
}
_TIMES = {"at": Range(0.0, 1e6), "ramp": Range(0.0, 1e4), "for": Range(0.5, 1e4)}  # [s]


def read(text: str, aircraft: str) -> Fault:
    """Parse NAME[:part],key=value,… with at=, ramp= and, for transients, for= in seconds.

    Raises:
        ValueError: when the text is no fault of this aircraft.
    """
    head, *pairs = text.split(",")
    name, _, of = head.partition(":")
    kind = KINDS.get(name)
    if kind is None:
        raise ValueError(f"fault: found {name!r}, expected one of {', '.join(KINDS)}; choose one")
    if aircraft not in kind.aircraft:
        raise ValueError(f"fault {name}: found aircraft {aircraft!r}, expected {' or '.join(kind.aircraft)}; use it")
    if of not in (kind.of or ("",)):
        wanted = f"one of {', '.join(kind.of)} after a colon" if kind.of else "nothing after its name"
        raise ValueError(f"fault {name}: found {of or 'no part'!r}, expected {wanted}; correct it")
    given = dict(_pair(name, pair, kind) for pair in pairs)
    missing = [key for key, wanted in kind.values.items() if wanted.needed and key not in given]
    missing += ["for"] if kind.passes and "for" not in given else []
    if missing:
        raise ValueError(f"fault {name}: found no {missing[0]}, expected {missing[0]}=NUMBER; add it")
    times = {key: given.pop(key, 0.0) for key in _TIMES}
    t1 = times["at"] + times["for"] if kind.passes else inf
    return Fault(name, of, given, times["at"], times["ramp"], t1)


def _pair(name: str, text: str, kind: Kind) -> tuple[str, float]:
    key, _, value = text.partition("=")
    known = {**kind.values, **{k: v for k, v in _TIMES.items() if k != "for" or kind.passes}}
    if key not in known:
        raise ValueError(f"fault {name}: found {key!r}, expected {', '.join(known)}; correct it")
    try:
        number = float(value)
    except ValueError:
        number = inf
    low, high, _ = known[key]
    if not isfinite(number) or not low <= number <= high:
        raise ValueError(f"fault {name}: found {key}={value}, expected a number {low:g}..{high:g}; correct it")
    return key, number
