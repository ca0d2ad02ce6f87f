"""True parameters of hidden effects in the units of a report, from the draw or else from JSBSim."""

import numpy as np

from fleet.simulator.conceal.effects import reported_values
from fleet.simulator.conceal.paths import EXAM_HOME
from fleet.simulator.conceal.plan import PlannedFlight, baseline_type
from fleet.simulator.conceal.record import ExamFlightLog
from fleet.simulator.faults.fault import Fault
from fleet.simulator.faults.physics import FaultyPhysics
from fleet.simulator.vehicle.jsbsim import DT, Aircraft
from fleet.simulator.vehicle.sensors import pressure_at

_R = 287.05  # of dry air [J/(kg K)]
_SEA_LEVEL_K, _LAPSE_K = 288.15, 0.0065  # standard atmosphere [K, K/m]
_SPEEDS, _THROTTLES = (44.0, 48.0, 52.0), (0.6, 0.75, 0.9)  # operating range of the Cessna [m/s, -]
_SPOOL_S = 6.0  # time for the propeller to reach steady speed


def describe_effect(
    planned: PlannedFlight, fault: Fault, log: ExamFlightLog, first_attitude_s: float
) -> dict[str, object]:
    """Describe one hidden effect.

    Args:
        planned: the flight
        fault: one of its hidden faults
        log: the flight with all hidden faults
        first_attitude_s: time of the first recorded ATTITUDE since simulation start [s]
    Returns:
        name, of, surface, params in the units of a report, times since that ATTITUDE [s]
    """
    params = reported_values(fault.name, planned.job.airframe, fault.values) | _measured(planned, fault, log)
    label: dict[str, object] = {"name": fault.name, "params": {key: round(x, 6) for key, x in params.items()}}
    if fault.part:
        label["surface" if fault.name.startswith(("actuator", "control")) else "of"] = fault.part
    if fault.t0 > 0:
        label["t0"] = round(fault.t0 - first_attitude_s, 3)
    if np.isfinite(fault.t1):
        label["t1"] = round(fault.t1 - first_attitude_s, 3)
    elif fault.ramp_s > 0:
        label["ramp_s"] = round(fault.ramp_s, 3)
    return label


def _measured(planned: PlannedFlight, fault: Fault, log: ExamFlightLog) -> dict[str, float]:
    if fault.name == "air_density":
        return {"density_ratio": density_ratio(log)}
    if fault.name == "thrust_loss" and planned.job.airframe == "c172p":
        return {"fraction": thrust_lost(planned, fault)}
    return {}


def density_ratio(log: ExamFlightLog) -> float:
    """Return the ratio of air density to the standard atmosphere, mean over a flight."""
    height = log.height + EXAM_HOME.alt_mm * 1e-3
    standard = [pressure_at(h) / (_R * (_SEA_LEVEL_K - _LAPSE_K * h)) for h in height]
    return float(np.mean(log.rho / np.array(standard)))


def thrust_lost(planned: PlannedFlight, fault: Fault) -> float:
    """Return the fraction of thrust lost at equal throttle and speed, mean over several of each."""
    aircraft = Aircraft(EXAM_HOME, planned.seed, kind=baseline_type(planned.job.airframe))
    losses = [1 - _thrust(aircraft, v, u, fault) / _thrust(aircraft, v, u, None) for v in _SPEEDS for u in _THROTTLES]
    return float(np.mean(losses))


def _thrust(aircraft: Aircraft, Va: float, delta_t: float, fault: Fault | None) -> float:
    """Run the engine at constant throttle and speed to steady state; return its thrust [lbf]."""
    thrust_property = aircraft.kind.thrust_property
    nominal = aircraft[thrust_property]
    aircraft.start(np.array([0.0, 0.0, -200.0]), 0.0, Va, (0.0, 0.0))
    if fault is not None:
        FaultyPhysics([fault._replace(t0=0.0)], aircraft).apply(0.0)
    for _ in range(round(_SPOOL_S / DT)):
        aircraft.set_controls(0.0, 0.0, 0.0, delta_t)
        aircraft.step()
    thrust = aircraft["propulsion/engine/thrust-lbs"]
    aircraft[thrust_property] = nominal
    return thrust
