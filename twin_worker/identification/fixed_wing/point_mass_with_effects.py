"""Point-mass model with effects: new lags for faulty servos, power increments from added forces."""

from dataclasses import dataclass, replace

import numpy as np

from fleet.physics import point_mass as H
from fleet.window import Window
from twin_worker.identification.fixed_wing import attitude_lag
from twin_worker.identification.fixed_wing.energy_balance import PointMassData, excess_power_residual, load_factor
from twin_worker.identification.fixed_wing.point_mass_model import PointMassModel, point_mass_data
from twin_worker.numerics.ridge_regression import solve_ridge
from twin_worker.telemetry.history import TelemetryHistory

_MIN_FIT_S = 10.0  # minimum flight for a correction [s]
_RIDGE_PENALTY = 0.05  # penalty of an increment, as a fraction of its term's norm
_INCREMENT_SIGMA = 0.3  # relative standard deviation of an increment


@dataclass(frozen=True)
class EffectIncrements:
    """Increments of the effects, one row per row of the flight.

    Attributes:
        force: added X Y Z, (n, 3) [m/s2]
        air: u v w, (n, 3) [m/s]
        phi: bank, (n,) [rad]
        throttle: (n,) [-]
        servo_faulty: fault of the aileron and elevator servos
    """

    force: np.ndarray
    air: np.ndarray
    phi: np.ndarray
    throttle: np.ndarray
    servo_faulty: tuple[bool, bool]


def with_effects(
    model: PointMassModel, window: Window, history: TelemetryHistory, scale: float, increments: EffectIncrements
) -> PointMassModel:
    """Apply effects to a model.

    Args:
        model: model identified before the onset
        window: flight since the onset
        history: telemetry as received
        scale: present true over reported airspeed [-]
        increments: increments of the effects
    """
    parameters = model.parameters.copy()
    d_power = _power_increments(parameters, increments)
    parameters[H.C_0 : H.C_N + 1] += d_power
    if window.seconds >= _MIN_FIT_S:
        data = point_mass_data(window, history, scale)
        for column, faulty in zip((H.WN_PHI, H.WN_THETA), increments.servo_faulty, strict=True):
            if faulty:
                parameters[column : column + 3] = _lag(data, column, parameters[column : column + 3])
        parameters[H.C_0] += float(
            excess_power_residual(data, parameters[H.C_0 : H.C_N + 1], parameters[H.T_0], parameters[H.V_0]).mean()
        )
    cov = model.excess_power.cov + np.diag((_INCREMENT_SIGMA * d_power) ** 2)
    return PointMassModel(parameters, replace(model.excess_power, cov=cov), float(window.t[-1]))


def _lag(data: PointMassData, column: int, warm_start: np.ndarray) -> np.ndarray:
    command, angle = (data.phi_c, data.phi) if column == H.WN_PHI else (data.theta_c, data.theta)
    return attitude_lag.identify(command, angle, warm_start)


def _power_increments(parameters: np.ndarray, increments: EffectIncrements) -> np.ndarray:
    """Return the increments of c_0 c_t c_v c_n: force along the path, regressed on their regressors, (4,)."""
    V = np.maximum(np.linalg.norm(increments.air, axis=1), 1.0)
    along = (increments.force * increments.air).sum(axis=1) / V
    n = load_factor(increments.phi)
    A = np.column_stack([np.ones(len(V)), increments.throttle - parameters[H.T_0], V - parameters[H.V_0], n * n - 1.0])
    return solve_ridge(A, along, _RIDGE_PENALTY)
