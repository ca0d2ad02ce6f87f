"""Inputs and readings of a faulty aircraft that flies the recorded motion; see the package for the principle.

Control errors are kept: the autopilot drives them to zero with the faulty aircraft too. Its own law is not repeated,
so a diagnosis that compares outputs with control errors sees a gain that no healthy autopilot has.
A surface that is mechanically stuck, an effect on lift, mass or balance, and weather change the motion or the attitude
itself; they are not concealed here.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fleet.airframes.airframe import ServoMap
from fleet.blind_test.inject.recorded import MIN_ROWS, FlightRecording, Series
from fleet.blind_test.inject.thrust import MIN_R2, ThrustCurve, airspeed, density

SURFACES = ("aileron", "elevator", "rudder")
MAX_CLIPPED = 0.05  # share of the faulty part in which an output may be at its limit [-]
VANE_HZ = 18.0  # accelerometer rate from which forces come from the accelerometer [Hz]
_THROTTLE = 3
_PULSE_LIMITS_US = 1000.0, 2000.0
_SEA_LEVEL_PA, _LAPSE, _POWER = 101325.0, 2.25577e-5, 5.2559  # ISA: p = p0 (1 - lapse h)^power


class InjectedFault(NamedTuple):
    """One fault: name and part, its values in reporting units, and its onset since the first attitude [s]."""

    name: str
    part: str
    values: dict[str, float]
    t0: float


@dataclass(frozen=True)
class InjectedAircraft:
    """What the concealed faults need of an aircraft: its servo map, its thrust curve, and S / m of its card.

    Attributes:
        area_per_mass: 1 without a card, as coefficients are then relative [m2/kg]
    """

    used_map: ServoMap
    thrust: ThrustCurve
    area_per_mass: float = 1.0


def is_vane(flight: FlightRecording) -> bool:
    """Return whether the accelerometer is fast enough to measure flow angles."""
    t = np.sort(flight.t.get("imu", np.zeros(0)))
    return len(t) > MIN_ROWS and float(np.median(np.diff(t))) <= 1.0 / VANE_HZ


class Injectable(NamedTuple):
    """One fault that can be injected.

    Attributes:
        key: name of its magnitude in a report
        low, high: magnitudes; of a scale its distance from 1; of a drag increase shares of the aircraft's own drag
        signed: it has either sign
        parts: surfaces or axes
        kinds: telemetry that it needs
    """

    key: str
    low: float
    high: float
    signed: bool = False
    parts: tuple[str, ...] = ("",)
    kinds: tuple[str, ...] = ()


FAULTS: Mapping[str, Injectable] = {
    "airspeed_scale": Injectable("scale", 0.02, 0.3, True, kinds=("air",)),
    "airspeed_bias": Injectable("bias_mps", 0.3, 4.0, True, kinds=("air",)),
    "baro_bias": Injectable("bias_m", 1.0, 25.0, True, kinds=("pressure", "gnss")),
    "gps_latency": Injectable("latency_s", 0.05, 0.6),
    "gyro_bias": Injectable("bias_dps", 0.2, 4.0, True, ("p", "q", "r")),
    "accel_bias": Injectable("bias_mps2", 0.1, 1.5, True, ("x", "y", "z"), ("imu",)),
    "heading_bias": Injectable("bias_deg", 2.0, 25.0, True),
    "actuator_stuck": Injectable("position", 0.0, 0.5, True, SURFACES),
    "actuator_offset": Injectable("offset", 0.02, 0.3, True, SURFACES),
    "actuator_delay": Injectable("delay_s", 0.05, 0.5, parts=SURFACES),
    "control_effectiveness_loss": Injectable("loss", 0.08, 0.6, parts=SURFACES),
    "thrust_loss": Injectable("loss", 0.04, 0.4),
    "drag_increase": Injectable("dCD", 0.05, 0.8),
}
_NEEDS_THRUST = ("thrust_loss", "drag_increase")


def possible_faults(flight: FlightRecording, aircraft: InjectedAircraft) -> list[tuple[str, str]]:
    """Return name and part of the faults that this flight can carry."""
    used = np.abs(aircraft.used_map.gain_up) > 0
    out = []
    for name, fault in FAULTS.items():
        if any(len(flight.t.get(kind, ())) < MIN_ROWS for kind in fault.kinds):
            continue
        if name in _NEEDS_THRUST and (aircraft.thrust.r2 < MIN_R2 or not used[:, _THROTTLE].any()):
            continue
        for part in fault.parts:
            if part in SURFACES:
                outputs = used[:, SURFACES.index(part)]
                moves = np.ptp(_padded(flight.x["servo"].astype(float), aircraft.used_map), axis=0) > 10.0
                if not (outputs & moves).any() or (name == "actuator_stuck" and used[outputs].sum() > outputs.sum()):
                    continue  # a stuck output of a mixed surface blocks two axes
            out.append((name, part))
    return out


def inject(flight: FlightRecording, aircraft: InjectedAircraft, fault: InjectedFault) -> Series | None:
    """Return the altered rows by kind; None where the faulty aircraft could not have flown this motion."""
    if fault.name in _SENSORS:
        return _SENSORS[fault.name](flight, fault)
    t = flight.t["servo"]
    after = t >= flight.t_start + fault.t0
    pulses = flight.x["servo"].astype(float)
    if fault.name == "actuator_stuck":
        return {"servo": _stuck(pulses, after, aircraft.used_map, fault)}
    inputs = aircraft.used_map.inputs(pulses)
    column = _THROTTLE if fault.name in _NEEDS_THRUST else SURFACES.index(fault.part)
    required = _required_inputs(flight, aircraft, fault, inputs)
    change = np.where(after, required - inputs[:, column], 0.0)
    altered, clipped = _with_input_change(pulses, aircraft.used_map, column, change)
    if after.any() and clipped[after].mean() > MAX_CLIPPED:
        return None
    out = {"servo": altered}
    if column == _THROTTLE and "air" in flight.x:
        out["air"] = flight.x["air"].astype(float)
        order = np.argsort(t, kind="stable")
        out["air"][:, 1] += np.interp(flight.t["air"], t[order], change[order])
        out["air"][:, 1] = np.clip(out["air"][:, 1], 0.0, 1.0)
    return out


def _padded(pulses: np.ndarray, used_map: ServoMap) -> np.ndarray:
    """Return the pulses of all outputs of the map; those that are not in telemetry stand at their trim."""
    width = pulses.shape[1]
    return np.hstack([pulses, np.tile(used_map.trim[width:], (len(pulses), 1))])


def _required_inputs(
    flight: FlightRecording, aircraft: InjectedAircraft, fault: InjectedFault, u: np.ndarray
) -> np.ndarray:
    """Return the input of the faulty aircraft that gives the recorded forces and moments, (n,) [-]."""
    t, values = flight.t["servo"], fault.values
    if fault.name in _NEEDS_THRUST:
        curve, Va = aircraft.thrust, airspeed(flight, t)
        rho = density(flight.at("position", t)[:, 2] * 1e-3)
        thrust = curve.thrust(u[:, _THROTTLE], Va, rho)
        if fault.name == "thrust_loss":
            return curve.throttle(thrust / (1.0 - values["loss"]), Va, rho)
        return curve.throttle(thrust + 0.5 * rho * Va**2 * values["dCD"] * aircraft.area_per_mass, Va, rho)
    own = u[:, SURFACES.index(fault.part)]
    if fault.name == "actuator_offset":
        return own - values["offset"]
    if fault.name == "control_effectiveness_loss":
        return np.asarray(own / (1.0 - values["loss"]))
    order = np.argsort(t, kind="stable")  # actuator_delay
    return np.interp(t + values["delay_s"], t[order], own[order])


def _with_input_change(
    pulses: np.ndarray, used_map: ServoMap, column: int, change: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Change one input (n,) by the smallest change of pulses that leaves the other inputs; return pulses and clipped.

    d_pulse = pinv(G) d_u with the gain G of each output on the side of its trim.
    """
    own, wanted = _padded(pulses, used_map), np.zeros((len(pulses), 4))
    wanted[:, column] = change
    new = own.copy()
    for _ in range(2):  # the side of the trim follows from the result
        upward = (new > used_map.trim)[:, :, None]
        gain = np.where(upward, used_map.gain_up, used_map.gain_down).transpose(0, 2, 1)
        new = own + np.einsum("nij,nj->ni", np.linalg.pinv(gain), wanted)
    moved = np.abs(new - own) > 0.5
    low, high = np.minimum(own.min(axis=0), _PULSE_LIMITS_US[0]), np.maximum(own.max(axis=0), _PULSE_LIMITS_US[1])
    if column == _THROTTLE:
        high = np.where(np.abs(used_map.gain_up[:, column]) > 0, _full_throttle(used_map, own), high)
    clipped = (moved & ((new < low) | (new > high))).any(axis=1)
    return np.where(moved, np.rint(np.clip(new, low, high)), own)[:, : pulses.shape[1]], clipped


def _full_throttle(used_map: ServoMap, own: np.ndarray) -> np.ndarray:
    """Return the pulse of full throttle of every output, (16,) [us]."""
    gain = used_map.gain_up[:, _THROTTLE] * np.maximum((np.abs(used_map.gain_up[:, _THROTTLE]) > 0).sum(), 1)
    full = used_map.trim + 1.0 / np.where(np.abs(gain) > 0, gain, np.inf)
    return np.asarray(np.maximum(full, own.max(axis=0)))


def _stuck(pulses: np.ndarray, after: np.ndarray, used_map: ServoMap, fault: InjectedFault) -> np.ndarray:
    """Freeze the logged outputs of a surface, at their last pulse (position 0) or away from their trim."""
    out = pulses.copy()
    first = int(np.argmax(after))
    column = SURFACES.index(fault.part)
    for k in np.flatnonzero(np.abs(used_map.gain_up[: pulses.shape[1], column]) > 0):
        gain = used_map.gain_up[k, column] * (np.abs(used_map.gain_up[:, column]) > 0).sum()
        frozen = (
            pulses[first, k] if not fault.values["position"] else used_map.trim[k] + fault.values["position"] / gain
        )
        out[after, k] = np.rint(np.clip(frozen, *_PULSE_LIMITS_US))
    return out


def _changed(
    flight: FlightRecording, fault: InjectedFault, columns: Mapping[str, tuple[int, ...]], by: float
) -> Series:
    """Add a constant to columns of some kinds after the onset."""
    out: Series = {}
    for kind, numbers in columns.items():
        if kind in flight.x:
            x = flight.x[kind].astype(float)
            after = flight.t[kind] >= flight.t_start + fault.t0
            for number in numbers:
                x[after, number] += by
            out[kind] = x
    return out


def _airspeed_scale(flight: FlightRecording, fault: InjectedFault) -> Series:
    x = flight.x["air"].astype(float)
    x[flight.t["air"] >= flight.t_start + fault.t0, 0] *= fault.values["scale"]
    return {"air": x}


def _baro_bias(flight: FlightRecording, fault: InjectedFault) -> Series:
    x = flight.x["pressure"].astype(float)
    after = flight.t["pressure"] >= flight.t_start + fault.t0
    h = (1.0 - (x[after, 0] / _SEA_LEVEL_PA) ** (1.0 / _POWER)) / _LAPSE
    x[after, 0] = _SEA_LEVEL_PA * (1.0 - _LAPSE * (h + fault.values["bias_m"])) ** _POWER
    return {"pressure": x}


def _gps_latency(flight: FlightRecording, fault: InjectedFault) -> Series:
    out: Series = {}
    for kind in ("velocity", "position", "height", "gnss"):
        if kind in flight.x:
            x, after = flight.x[kind].astype(float), flight.t[kind] >= flight.t_start + fault.t0
            x[after] = flight.at(kind, flight.t[kind][after] - fault.values["latency_s"])
            out[kind] = x
    return out


def _gyro_bias(flight: FlightRecording, fault: InjectedFault) -> Series:
    column = 3 + "pqr".index(fault.part)
    by = float(np.radians(fault.values["bias_dps"]))
    return _changed(flight, fault, {"attitude": (column,), "imu": (column,)}, by)


def _heading_bias(flight: FlightRecording, fault: InjectedFault) -> Series:
    out = _changed(flight, fault, {"attitude": (2,)}, float(np.radians(fault.values["bias_deg"])))
    psi = out["attitude"][:, 2]
    out["attitude"][:, 2] = np.arctan2(np.sin(psi), np.cos(psi))
    return out


_SENSORS: Mapping[str, Callable[[FlightRecording, InjectedFault], Series]] = {
    "airspeed_scale": _airspeed_scale,
    "airspeed_bias": lambda flight, fault: _changed(flight, fault, {"air": (0,)}, fault.values["bias_mps"]),
    "baro_bias": _baro_bias,
    "gps_latency": _gps_latency,
    "gyro_bias": _gyro_bias,
    "accel_bias": lambda flight, fault: _changed(
        flight, fault, {"imu": ("xyz".index(fault.part),)}, fault.values["bias_mps2"]
    ),
    "heading_bias": _heading_bias,
}
