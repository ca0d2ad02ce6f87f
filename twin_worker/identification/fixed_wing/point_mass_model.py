"""Identify the point-mass model, with or without effects: two lags, turn, lift and power, from the last two minutes."""

from dataclasses import dataclass, replace

import numpy as np

from fleet.physics import point_mass as H
from fleet.window import Window
from twin_worker.identification.fixed_wing.energy_balance import (
    STEP,
    PointMassData,
    RegressionResult,
    excess_power_residual,
    fit_angle_of_attack,
    fit_attitude_lag,
    fit_excess_power,
    fit_turn_rate,
    load_factor,
)
from twin_worker.numerics.interpolation import zero_order_hold
from twin_worker.numerics.ridge_regression import solve_ridge
from twin_worker.telemetry.history import TelemetryHistory

FIT_WINDOW_S = 120.0  # identification window [s]
MIN_FIT_S = 20.0  # minimum window [s]
_MAX_COMMAND_AGE_S = 1.0  # longest hold of a reported command [s]
_SMOOTH_ROWS = 51  # smoothing of the commanded height [rows]


@dataclass(frozen=True)
class PointMassModel:
    """Identified point-mass model.

    Attributes:
        parameters: parameters of `fleet.physics.point_mass`, (N_BODY,)
        excess_power: regression of the excess power, with covariance
        t: end of the data [s since 1970]
    """

    parameters: np.ndarray
    excess_power: RegressionResult
    t: float


def point_mass_data(window: Window, history: TelemetryHistory, scale: float) -> PointMassData:
    """Resample the flight in rows of `STEP`, newest last.

    Args:
        window: telemetry; rows in gaps are marked
        history: telemetry as received, with airspeed and commands
        scale: true over reported airspeed [-]
    """
    times, V = airspeed_of(window, history, scale)

    def resampled(x: np.ndarray) -> np.ndarray:
        return np.interp(times, window.t, x)

    commands = zero_order_hold(*history.rows_since("command", times[0] - 2.0), times, _MAX_COMMAND_AGE_S)
    valid = window.ok[np.minimum(np.searchsorted(window.t, times), len(window) - 1)]
    h = -resampled(window.p[:, 2])
    V_c = commands[:, 4] + V / scale
    return PointMassData(
        V=V,
        h=h,
        h_dot=-resampled(window.v[:, 2]),
        phi=resampled(window.x[:, 6]),
        theta=resampled(window.x[:, 7]),
        psi=resampled(window.x[:, 8]),
        delta_t=resampled(window.u[:, 3]),
        climb_c=_climb_command(commands[:, 3] + h),
        V_c=V_c * scale,
        phi_c=np.where(valid, commands[:, 0], np.nan),
        theta_c=np.where(valid, commands[:, 1], np.nan),
        valid=valid,
    )


def airspeed_of(window: Window, history: TelemetryHistory, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times at `STEP`, newest last, (n,) [s], and true airspeed, (n,) [m/s]."""
    times = window.t[-1] - STEP * np.arange(int(window.seconds / STEP) + 1)[::-1]
    t_air, air = history.rows_since("air", times[0] - 2.0)
    if len(t_air) > 1 and float(air[:, 0].max()) > 3.0:
        return times, np.interp(times, t_air, air[:, 0]) * scale
    return times, np.interp(times, window.t, np.linalg.norm(window.x[:, :3], axis=1))


def _climb_command(h_c: np.ndarray) -> np.ndarray:
    """Return the smoothed slope of the commanded height, (n,) [m/s]; a step counts as a climb."""
    padded = np.pad(h_c, _SMOOTH_ROWS // 2, mode="edge")
    smoothed = np.convolve(padded, np.ones(_SMOOTH_ROWS) / _SMOOTH_ROWS, "valid")[: len(h_c)]
    return np.clip(np.gradient(smoothed, STEP), -5.0, 5.0)


def identify(
    window: Window, history: TelemetryHistory, scale: float, warm_start: PointMassModel | None = None
) -> PointMassModel:
    """Identify from the newest `FIT_WINDOW_S` of telemetry, without its gaps.

    Args:
        window, history, scale: as for `point_mass_data`
        warm_start: earlier model, start of the search
    Raises:
        ValueError: with less than `MIN_FIT_S` of telemetry; wait for more.
    """
    window = window.part(max(len(window) - int(FIT_WINDOW_S / window.dt), 0), len(window))
    seconds = min(window.seconds, float(window.ok.sum() * window.dt))
    if seconds < MIN_FIT_S:
        raise ValueError(f"hybrid: found {seconds:.0f} s of flight, expected {MIN_FIT_S:.0f} s; wait")
    data = point_mass_data(window, history, scale)
    parameters = np.empty(H.N_PARAMETERS)
    parameters[[H.T_0, H.V_0]] = data.delta_t.mean(), data.V.mean()
    for first, command, angle in ((H.WN_PHI, data.phi_c, data.phi), (H.WN_THETA, data.theta_c, data.theta)):
        warm_lag = None if warm_start is None else warm_start.parameters[first : first + 3]
        parameters[first : first + 3] = fit_attitude_lag(command, angle, warm_lag)
    parameters[H.K_PSI : H.B_PSI + 1] = fit_turn_rate(data).value
    parameters[H.A_0 : H.A_N + 1] = fit_angle_of_attack(data, parameters[H.V_0]).value
    excess_power = fit_excess_power(data, parameters[H.T_0], parameters[H.V_0])
    parameters[H.C_0 : H.C_N + 1] = excess_power.value
    return PointMassModel(parameters, excess_power, float(window.t[-1]))


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
        lags = ((H.WN_PHI, data.phi_c, data.phi), (H.WN_THETA, data.theta_c, data.theta))
        for (first, command, angle), faulty in zip(lags, increments.servo_faulty, strict=True):
            if faulty:
                parameters[first : first + 3] = fit_attitude_lag(command, angle, parameters[first : first + 3])
        parameters[H.C_0] += float(
            excess_power_residual(data, parameters[H.C_0 : H.C_N + 1], parameters[H.T_0], parameters[H.V_0]).mean()
        )
    cov = model.excess_power.cov + np.diag((_INCREMENT_SIGMA * d_power) ** 2)
    return PointMassModel(parameters, replace(model.excess_power, cov=cov), float(window.t[-1]))


def _power_increments(parameters: np.ndarray, increments: EffectIncrements) -> np.ndarray:
    """Return the increments of c_0 c_t c_v c_n: force along the path, regressed on their regressors, (4,)."""
    V = np.maximum(np.linalg.norm(increments.air, axis=1), 1.0)
    along = (increments.force * increments.air).sum(axis=1) / V
    n = load_factor(increments.phi)
    A = np.column_stack([np.ones(len(V)), increments.throttle - parameters[H.T_0], V - parameters[H.V_0], n * n - 1.0])
    return solve_ridge(A, along, _RIDGE_PENALTY)
