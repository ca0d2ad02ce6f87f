"""Strength of a hidden effect on its flight, relative to sensor noise.

Two comparisons. The first is decisive: within one flight, at 10 Hz, commands, readings, forces and moments of the same
state with and without the effect. The second compares two flights of the same seed, with and without the effect.
"""

import numpy as np

from fleet.simulator.conceal.paths import PlannedFlight
from fleet.simulator.conceal.record import ExamFlightLog, fly
from fleet.simulator.faults.carried import FaultSet
from fleet.simulator.faults.physics import PHYSICS_FAULTS, WIND_FAULTS, Fault
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.jsbsim import DT

_NOISE: dict[str, float] = {  # noise per channel and sample, as in `sensors`
    **dict.fromkeys(("aileron", "elevator", "rudder", "throttle"), 0.01),  # fraction of full travel
    **dict.fromkeys(("p", "q", "r"), 0.003),  # [rad/s]
    **dict.fromkeys(("a_x", "a_y", "a_z"), 0.07),  # [m/s2]
    **dict.fromkeys(("phi", "theta", "psi"), 0.0044),  # [rad]
    **dict.fromkeys(("v_n", "v_e", "v_d"), 0.075),  # [m/s]
    "Va": 0.25,
    "baro": 0.4,  # [m/s], [m]
    **dict.fromkeys(("p_dot", "q_dot", "r_dot"), 0.006),  # derivative of the gyros up to 1.5 Hz [rad/s2]
    **dict.fromkeys(("f_x", "f_y", "f_z"), 0.07),  # [m/s2]
    **dict.fromkeys(("w_n", "w_e", "w_d"), 0.25),  # [m/s]
}
_FLIGHT_NOISE: dict[str, float] = {  # columns of `ExamFlightLog.channels`
    **{name: _NOISE[name] for name in ("p", "q", "r", "a_x", "a_y", "a_z", "phi", "theta", "psi")},
    **{name: _NOISE[name] for name in ("v_n", "v_e", "v_d")},
    **dict.fromkeys(("p_n", "p_e", "p_d"), 0.5),  # [m]
    "Va": 0.25,
    "baro": 0.4,
    "satellites": 1.5,  # [m/s], [m], [m]
    **{name: _NOISE[name] for name in ("aileron", "elevator", "throttle", "rudder")},
}
_SLOW_EFFECTS = ("turbulence", "flap_deployed", "thrust_loss", "_surging_engine")  # not observable in a single sample
_EVIDENCE_CHANNELS = [x for x in _FLIGHT_NOISE if x not in ("p_n", "p_e", "v_n", "v_e", "satellites")]
_SCATTER_CHANNELS = ("p", "q", "r", "a_y", "a_z", "Va")
MIN_OVER_NOISE = 2.0  # rms over the noise


def effect_strength(planned: PlannedFlight, fault: Fault, log: ExamFlightLog) -> dict[str, object]:
    """Compute the strength of one hidden effect while it is active.

    Args:
        planned: the flight
        fault: one of its hidden faults
        log: the flight with all hidden faults
    Returns:
        name; over_noise, channel: largest rms over noise and its channel; flown_over_noise, flown_channel: the same for
        the difference of two flights
    """
    reference, _ = fly(planned, tuple(x for x in planned.hidden_faults if x is not fault))
    active = np.array([fault.intensity(t) > 0 for t in log.t])
    between_flights = _compare_flights(
        log.channels[active], reference.channels[active], scatter_only=fault.name == "turbulence"
    )
    is_slow = fault.name in _SLOW_EFFECTS and not (fault.name == "thrust_loss" and planned.job.airframe == "small")
    strongest = between_flights if is_slow else _compare_instants(planned, fault, active)
    return {
        "name": fault.name,
        "over_noise": round(strongest[0], 1),
        "channel": strongest[1],
        "flown_over_noise": round(between_flights[0], 1),
        "flown_channel": between_flights[1],
    }


def _compare_flights(affected: np.ndarray, reference: np.ndarray, scatter_only: bool) -> tuple[float, str]:
    """Compare two flights; turbulence by its variance. Horizontal position and velocity are no evidence."""
    names = list(_FLIGHT_NOISE)
    difference = affected - reference
    angles = [names.index(name) for name in ("phi", "psi")]
    difference[:, angles] = np.angle(np.exp(1j * difference[:, angles]))
    magnitude = np.sqrt(np.mean(difference**2, axis=0))
    if scatter_only:
        magnitude = np.sqrt(np.maximum(affected.var(axis=0) - reference.var(axis=0), 0.0))
    rms = dict(zip(names, magnitude / np.array(list(_FLIGHT_NOISE.values())), strict=True))
    strongest = max(_SCATTER_CHANNELS if scatter_only else _EVIDENCE_CHANNELS, key=rms.__getitem__)
    return float(rms[strongest]), strongest


def _compare_instants(planned: PlannedFlight, fault: Fault, active: np.ndarray) -> tuple[float, str]:
    """Repeat the flight and compare with and without the fault at each sample."""
    rows: list[np.ndarray] = []
    fly(planned, planned.hidden_faults, observe=lambda uav: rows.append(_instant_changes(uav, fault)))
    magnitude = np.sqrt(np.mean(np.array(rows)[active] ** 2, axis=0)) / np.array(list(_NOISE.values()))
    i = int(np.argmax(magnitude))
    return float(magnitude[i]), list(_NOISE)[i]


def _instant_changes(uav: SimulatedUav, fault: Fault) -> np.ndarray:
    """Return the changes by one fault at this instant, columns as in `_NOISE`."""
    t, fault_set = uav.tick * DT, uav.fault_set
    assert fault_set is not None
    reactions, wind = np.zeros(6), np.zeros(3)
    if fault.name in PHYSICS_FAULTS or fault.name.startswith("_"):
        reactions = _reaction_changes(uav, fault_set, fault, t)
    if fault.name in WIND_FAULTS:
        wind = fault.intensity(t) * WIND_FAULTS[fault.name](fault.values, -float(uav.estimate.p[2]))
    return np.concatenate([fault_set.command_changes[fault], fault_set.estimate_changes[fault], reactions, wind])


def _reaction_changes(uav: SimulatedUav, fault_set: FaultSet, fault: Fault, t: float) -> np.ndarray:
    """Return the change of moments and forces by a fault; evaluate twice with it, since servos advance each time."""
    with_fault = uav.aircraft.evaluate_accelerations()
    fault_set.apply_to_physics(t, excluding=fault)
    without_fault = uav.aircraft.evaluate_accelerations()
    fault_set.apply_to_physics(t)
    return np.asarray((with_fault + uav.aircraft.evaluate_accelerations()) / 2 - without_fault)
