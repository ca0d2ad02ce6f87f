"""Point-mass model with effects: new lags for faulty servos, power increments from added forces."""

from dataclasses import dataclass, replace

import numpy as np

from fleet.physics import point_mass as H
from fleet.window import Window
from twin_worker.identification.fixed_wing import attitude_lag
from twin_worker.identification.fixed_wing.energy_balance import Flight, load, missed
from twin_worker.identification.fixed_wing.point_mass_model import Hybrid, flight_of
from twin_worker.numerics.ridge_regression import ridge
from twin_worker.telemetry.history import History

_LEAST_S = 10.0  # minimum flight for a correction [s]
_RIDGE = 0.05  # penalty of an increment, as a fraction of its term's norm
_DOUBT = 0.3  # relative standard deviation of an increment


@dataclass(frozen=True)
class Added:
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
    faulty: tuple[bool, bool]


def extended(known: Hybrid, since: Window, history: History, scale: float, added: Added) -> Hybrid:
    """Apply effects to a model.

    Args:
        model: model identified before the onset
        window: flight since the onset
        history: telemetry as received
        scale: present true over reported airspeed [-]
        increments: increments of the effects
    """
    body = known.body.copy()
    power = _power(body, added)
    body[H.C_0 : H.C_N + 1] += power
    if since.seconds >= _LEAST_S:
        flown = flight_of(since, history, scale)
        for column, faulty in zip((H.WN_PHI, H.WN_THETA), added.faulty, strict=True):
            if faulty:
                body[column : column + 3] = _lag(flown, column, body[column : column + 3])
        body[H.C_0] += float(missed(flown, body[H.C_0 : H.C_N + 1], body[H.T_0], body[H.V_0]).mean())
    cov = known.power.cov + np.diag((_DOUBT * power) ** 2)
    return Hybrid(body, replace(known.power, cov=cov), float(since.t[-1]))


def _lag(flown: Flight, column: int, near: np.ndarray) -> np.ndarray:
    command, angle = (flown.phi_c, flown.phi) if column == H.WN_PHI else (flown.theta_c, flown.theta)
    return attitude_lag.identify(command, angle, near)


def _power(body: np.ndarray, added: Added) -> np.ndarray:
    """Return the increments of c_0 c_t c_v c_n: force along the path, regressed on their regressors, (4,)."""
    V = np.maximum(np.linalg.norm(added.air, axis=1), 1.0)
    along = (added.force * added.air).sum(axis=1) / V
    n = load(added.phi)
    A = np.column_stack([np.ones(len(V)), added.throttle - body[H.T_0], V - body[H.V_0], n * n - 1.0])
    return ridge(A, along, _RIDGE)
