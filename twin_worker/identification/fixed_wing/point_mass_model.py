"""Identify the point-mass model: two lags, turn, lift and power, from the last two minutes of flight."""

from dataclasses import dataclass

import numpy as np

from fleet.physics import point_mass as H
from fleet.window import Window
from twin_worker.identification.fixed_wing import attitude_lag, energy_balance
from twin_worker.identification.fixed_wing.energy_balance import PointMassData, RegressionResult
from twin_worker.telemetry.history import TelemetryHistory

FIT_WINDOW_S = 120.0  # identification window [s]
MIN_FIT_S = 20.0  # minimum window [s]
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
    """Resample the flight in rows of `attitude_lag.STEP`, newest last.

    Args:
        window: telemetry without gaps
        history: telemetry as received, with airspeed and commands
        scale: true over reported airspeed [-]
    """
    times, V = airspeed_of(window, history, scale)

    def resampled(x: np.ndarray) -> np.ndarray:
        return np.interp(times, window.t, x)

    commands = _reported_commands(history, times)
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
        phi_c=commands[:, 0],
        theta_c=commands[:, 1],
    )


def airspeed_of(window: Window, history: TelemetryHistory, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times at `attitude_lag.STEP`, newest last, (n,) [s], and true airspeed, (n,) [m/s]."""
    times = window.t[-1] - attitude_lag.STEP * np.arange(int(window.seconds / attitude_lag.STEP) + 1)[::-1]
    t_air, air = history.rows_since("air", times[0] - 2.0)
    if len(t_air) > 1 and float(air[:, 0].max()) > 3.0:
        return times, np.interp(times, t_air, air[:, 0]) * scale
    return times, np.interp(times, window.t, np.linalg.norm(window.x[:, :3], axis=1))


def _climb_command(h_c: np.ndarray) -> np.ndarray:
    """Return the smoothed slope of the commanded height, (n,) [m/s]; a step counts as a climb."""
    padded = np.pad(h_c, _SMOOTH_ROWS // 2, mode="edge")
    return np.clip(
        np.gradient(np.convolve(padded, np.ones(_SMOOTH_ROWS) / _SMOOTH_ROWS, "valid")[: len(h_c)], attitude_lag.STEP),
        -5.0,
        5.0,
    )


def _reported_commands(history: TelemetryHistory, times: np.ndarray) -> np.ndarray:
    """Return the reported commands, zero-order hold for at most 1 s, nan where missing, (n, 5)."""
    t, x = history.rows_since("command", times[0] - 2.0)
    if not len(t):
        return np.full((len(times), 5), np.nan)
    k = np.searchsorted(t, times, side="right") - 1
    out = x[np.clip(k, 0, None)].copy()
    out[(k < 0) | (times - t[np.clip(k, 0, None)] > 1.0)] = np.nan
    return out


def identify(
    window: Window, history: TelemetryHistory, scale: float, warm_start: PointMassModel | None = None
) -> PointMassModel:
    """Identify from the newest `FIT_WINDOW_S` of gap-free telemetry.

    Args:
        window, history, scale: as for `point_mass_data`
        warm_start: earlier model, start of the search
    Raises:
        ValueError: with less than `MIN_FIT_S` of telemetry; wait for more.
    """
    window = window.part(max(len(window) - int(FIT_WINDOW_S / window.dt), 0), len(window))
    if window.seconds < MIN_FIT_S:
        raise ValueError(f"hybrid: found {window.seconds:.0f} s of flight, expected {MIN_FIT_S:.0f} s; wait")
    data = point_mass_data(window, history, scale)
    parameters = np.empty(H.N_PARAMETERS)
    parameters[[H.T_0, H.V_0]] = data.delta_t.mean(), data.V.mean()
    for first, command, angle in ((H.WN_PHI, data.phi_c, data.phi), (H.WN_THETA, data.theta_c, data.theta)):
        warm_lag = None if warm_start is None else warm_start.parameters[first : first + 3]
        parameters[first : first + 3] = attitude_lag.identify(command, angle, warm_lag)
    parameters[H.K_PSI : H.B_PSI + 1] = energy_balance.fit_turn_rate(data).value
    parameters[H.A_0 : H.A_N + 1] = energy_balance.fit_angle_of_attack(data, parameters[H.V_0]).value
    excess_power = energy_balance.fit_excess_power(data, parameters[H.T_0], parameters[H.V_0])
    parameters[H.C_0 : H.C_N + 1] = excess_power.value
    return PointMassModel(parameters, excess_power, float(window.t[-1]))
