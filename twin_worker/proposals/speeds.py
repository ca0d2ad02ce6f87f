"""Speeds of an aircraft: present, admissible, and those that are tried."""

import numpy as np

from fleet.autopilots import copter
from twin_worker.prediction.autopilot_parameters import fixed_wing_controller
from twin_worker.prediction.replay_window import AutopilotConfig
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.kinematic_prediction import is_hovering

_SPEEDS = 5  # airspeeds tried, evenly spaced between the lowest and the highest
_ROTOR_SPEEDS = (0.4, 0.6, 0.8)  # speeds of a multirotor that are tried, of its present limit [-]
_MIN_SPEED_STEP = 1.0  # a smaller change of speed is none [m/s]


def tried_speeds(twin: Twin) -> list[float]:
    """Return the speeds to try within the limits of the autopilot [m/s]."""
    if is_hovering(twin):
        return [fraction * present_speed(twin) for fraction in _ROTOR_SPEEDS]
    low, high = speed_limits(twin)
    if not 0 < low < high:
        return []
    present = present_speed(twin)
    return [float(V) for V in np.linspace(low, high, _SPEEDS + 2)[1:-1] if abs(V - present) >= _MIN_SPEED_STEP]


def speed_limits(twin: Twin) -> tuple[float, float]:
    """Return the lowest and highest airspeed that a fixed-wing autopilot accepts; nan: unknown [m/s]."""
    law = _config(twin).law
    names = {"arduplane": ("AIRSPEED_MIN", "AIRSPEED_MAX")}.get(law, ("FW_AIRSPD_MIN", "FW_AIRSPD_MAX"))
    values = fixed_wing_controller(twin.received_params, law=law).values if law else {}
    return float(values.get(names[0], np.nan)), float(values.get(names[1], np.nan))


def present_speed(twin: Twin) -> float:
    """Return the present speed: through the air, of a multirotor its limit over ground [m/s]."""
    if is_hovering(twin):
        return float(copter.limits(twin.received_params, twin.vehicle_class.rotor_prefix)[0].speed)
    _, velocity = twin.telemetry.history.rows_since("velocity", twin.telemetry.history.newest - 3.0)
    return float(np.linalg.norm(velocity.mean(axis=0) - twin.environment.wind.wind)) if len(velocity) else np.nan


def _config(twin: Twin) -> AutopilotConfig:
    window = twin.window(10.0)
    assert window is not None
    return twin.situation(window).onboard
