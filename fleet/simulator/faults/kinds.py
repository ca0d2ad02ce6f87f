"""Faults by name, and their syntax on the command line."""

from collections.abc import Mapping
from math import inf, isfinite
from typing import NamedTuple

from fleet.simulator.faults.physics import Fault
from fleet.simulator.faults.servos import SURFACES


class FaultKind(NamedTuple):
    """One kind of fault."""

    ranges: Mapping[str, tuple[float, float]]  # lowest and highest value of each parameter
    parts: tuple[str, ...] = ()  # surfaces or axes; one is required
    transient: bool = False  # has an end
    aircraft: tuple[str, ...] = ("small", "c172p")
    optional: bool = False  # its parameters may be absent


_SPEED, _FROM = (0.0, 20.0), (-360.0, 360.0)
_CESSNA = ("c172p",)

KINDS: dict[str, FaultKind] = {
    "actuator_lag": FaultKind({"tau_s": (0.0, 2.0)}, SURFACES),
    "actuator_delay": FaultKind({"delay_s": (0.0, 1.0)}, SURFACES),
    "actuator_rate_limit": FaultKind({"rate_per_s": (0.01, 50.0)}, SURFACES),
    "actuator_deadband": FaultKind({"half_width": (0.0, 0.5)}, SURFACES),
    "actuator_saturation": FaultKind({"limit": (0.0, 1.0)}, SURFACES),
    "actuator_offset": FaultKind({"offset": (-0.6, 0.6)}, SURFACES),
    "actuator_stuck": FaultKind({"position": (-1.0, 1.0)}, SURFACES, optional=True),
    "control_effectiveness_loss": FaultKind({"loss": (0.0, 1.0)}, SURFACES),
    "airspeed_scale": FaultKind({"scale": (0.3, 2.0)}),
    "airspeed_bias": FaultKind({"bias_mps": (-15.0, 15.0)}),
    "gps_latency": FaultKind({"latency_s": (0.0, 2.0)}),
    "imu_misalignment": FaultKind(dict.fromkeys(("roll_deg", "pitch_deg", "yaw_deg"), (-15.0, 15.0)), optional=True),
    "gyro_bias": FaultKind({"bias_dps": (-15.0, 15.0)}, ("p", "q", "r")),
    "accel_bias": FaultKind({"bias_mps2": (-5.0, 5.0)}, ("x", "y", "z")),
    "heading_bias": FaultKind({"bias_deg": (-60.0, 60.0)}),
    "baro_bias": FaultKind({"bias_m": (-100.0, 100.0)}),
    "wind_steady": FaultKind({"speed_mps": _SPEED, "from_deg": _FROM}),
    "wind_shear": FaultKind({"mps_per_100m": _SPEED, "from_deg": _FROM}),
    "gust_discrete": FaultKind({"speed_mps": _SPEED, "from_deg": _FROM}, transient=True),
    "updraft": FaultKind({"speed_mps": (-15.0, 15.0)}, transient=True),
    "turbulence": FaultKind({"w20_mps": (0.0, 25.0)}),
    "air_density": FaultKind({"density_ratio": (0.6, 1.3)}),
    "thrust_loss": FaultKind({"fraction": (0.0, 1.0)}),
    "drag_increase": FaultKind({"dCD": (-0.02, 0.2)}),
    "icing": FaultKind({"lift_loss": (0.0, 0.5), "dCD": (0.0, 0.2)}),
    "flap_deployed": FaultKind({"flap_deg": (0.0, 30.0)}, aircraft=_CESSNA),
    "mass_change": FaultKind({"dmass_kg": (-200.0, 200.0)}),
    "cg_shift": FaultKind({"dx_m": (-0.3, 0.3)}),
    "roll_damping": FaultKind({"dC_l_p": (-2.0, 2.0)}),
    "pitch_damping": FaultKind({"dC_m_q": (-60.0, 60.0)}),
    "prop_torque": FaultKind({"sense": (-1.0, 1.0)}, aircraft=_CESSNA),
    "p_factor": FaultKind({"inches_per_rad": (-300.0, 300.0)}, aircraft=_CESSNA),
    "slipstream_tail": FaultKind({"share": (0.0, 3.0)}, aircraft=_CESSNA),
}
_TIMES = {"at": (0.0, 1e6), "ramp": (0.0, 1e4), "for": (0.5, 1e4)}  # [s]


def parse_fault(text: str, aircraft: str) -> Fault:
    """Parse NAME[:part],key=value,… with at=, ramp= and, for transients, for= in seconds.

    Raises:
        ValueError: when the text is no fault of this aircraft.
    """
    head, *pairs = text.split(",")
    name, _, part = head.partition(":")
    kind = KINDS.get(name)
    if kind is None:
        raise ValueError(f"--fault: found {name!r}, expected one of {', '.join(KINDS)}; choose one")
    if aircraft not in kind.aircraft:
        raise ValueError(f"fault {name}: found aircraft {aircraft!r}, expected {' or '.join(kind.aircraft)}; use it")
    if part not in (kind.parts or ("",)):
        expected = f"one of {', '.join(kind.parts)} after a colon" if kind.parts else "nothing after its name"
        raise ValueError(f"fault {name}: found {part or 'no part'!r}, expected {expected}; correct it")
    values = dict(_parse_pair(name, pair, kind) for pair in pairs)
    missing = [] if kind.optional else [key for key in kind.ranges if key not in values]
    missing += ["for"] if kind.transient and "for" not in values else []
    if missing:
        raise ValueError(f"fault {name}: found no {missing[0]}, expected {missing[0]}=NUMBER; add it")
    times = {key: values.pop(key, 0.0) for key in _TIMES}
    t1 = times["at"] + times["for"] if kind.transient else inf
    return Fault(name, part, values, times["at"], times["ramp"], t1)


def _parse_pair(name: str, text: str, kind: FaultKind) -> tuple[str, float]:
    key, _, value = text.partition("=")
    ranges = {**kind.ranges, **{k: v for k, v in _TIMES.items() if k != "for" or kind.transient}}
    if key not in ranges:
        raise ValueError(f"fault {name}: found {key!r}, expected {', '.join(ranges)}; correct it")
    try:
        number = float(value)
    except ValueError:
        number = inf
    low, high = ranges[key]
    if not isfinite(number) or not low <= number <= high:
        raise ValueError(f"fault {name}: found {key}={value}, expected a number {low:g}..{high:g}; correct it")
    return key, number
