"""Identify the point-mass model: two lags, turn, lift and power, from the last two minutes of flight."""

from dataclasses import dataclass

import numpy as np

from fleet.physics import point_mass as H
from fleet.window import Window
from twin_worker.identification.fixed_wing import attitude_lag, energy_balance
from twin_worker.identification.fixed_wing.energy_balance import Flight, Ridge
from twin_worker.telemetry.history import History

SEEN_S = 120.0  # identification window [s]
LEAST_S = 20.0  # minimum window [s]
_SMOOTH = 51  # smoothing of the commanded height [rows]


@dataclass(frozen=True)
class Hybrid:
    """Identified point-mass model.

    Attributes:
        parameters: parameters of `fleet.physics.point_mass`, (N_BODY,)
        excess_power: regression of the excess power, with covariance
        t: end of the data [s since 1970]
    """

    body: np.ndarray
    power: Ridge
    t: float


def flight_of(good: Window, history: History, scale: float) -> Flight:
    """Resample the flight in rows of `attitude_lag.STEP`, newest last.

    Args:
        window: telemetry without gaps
        history: telemetry as received, with airspeed and commands
        scale: true over reported airspeed [-]
    """
    at, V = airspeed_of(good, history, scale)

    def on(x: np.ndarray) -> np.ndarray:
        return np.interp(at, good.t, x)

    asked = _commands(history, at)
    h = -on(good.p[:, 2])
    V_c = asked[:, 4] + V / scale
    return Flight(
        V=V, h=h, h_dot=-on(good.v[:, 2]), phi=on(good.x[:, 6]), theta=on(good.x[:, 7]), psi=on(good.x[:, 8]),
        delta_t=on(good.u[:, 3]), climb_c=_climb(asked[:, 3] + h), V_c=V_c * scale,
        phi_c=asked[:, 0], theta_c=asked[:, 1],
    )  # fmt: skip


def airspeed_of(good: Window, history: History, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times at `attitude_lag.STEP`, newest last, (n,) [s], and true airspeed, (n,) [m/s]."""
    at = good.t[-1] - attitude_lag.STEP * np.arange(int(good.seconds / attitude_lag.STEP) + 1)[::-1]
    t_air, air = history.look("air", at[0] - 2.0)
    if len(t_air) > 1 and float(air[:, 0].max()) > 3.0:
        return at, np.interp(at, t_air, air[:, 0]) * scale
    return at, np.interp(at, good.t, np.linalg.norm(good.x[:, :3], axis=1))


def _climb(h_c: np.ndarray) -> np.ndarray:
    """Return the smoothed slope of the commanded height, (n,) [m/s]; a step counts as a climb."""
    wide = np.pad(h_c, _SMOOTH // 2, mode="edge")
    return np.clip(
        np.gradient(np.convolve(wide, np.ones(_SMOOTH) / _SMOOTH, "valid")[: len(h_c)], attitude_lag.STEP), -5.0, 5.0
    )


def _commands(history: History, at: np.ndarray) -> np.ndarray:
    """Return the reported commands, zero-order hold for at most 1 s, nan where missing, (n, 5)."""
    t, x = history.look("command", at[0] - 2.0)
    if not len(t):
        return np.full((len(at), 5), np.nan)
    k = np.searchsorted(t, at, side="right") - 1
    out = x[np.clip(k, 0, None)].copy()
    out[(k < 0) | (at - t[np.clip(k, 0, None)] > 1.0)] = np.nan
    return out


def identify(good: Window, history: History, scale: float, near: Hybrid | None = None) -> Hybrid:
    """Identify from the newest `FIT_WINDOW_S` of gap-free telemetry.

    Args:
        window, history, scale: as for `point_mass_data`
        warm_start: earlier model, start of the search
    Raises:
        ValueError: with less than `MIN_FIT_S` of telemetry; wait for more.
    """
    good = good.part(max(len(good) - int(SEEN_S / good.dt), 0), len(good))
    if good.seconds < LEAST_S:
        raise ValueError(f"hybrid: found {good.seconds:.0f} s of flight, expected {LEAST_S:.0f} s; wait")
    flown = flight_of(good, history, scale)
    body = np.empty(H.N_BODY)
    body[[H.T_0, H.V_0]] = flown.delta_t.mean(), flown.V.mean()
    for first, command, angle in ((H.WN_PHI, flown.phi_c, flown.phi), (H.WN_THETA, flown.theta_c, flown.theta)):
        before = None if near is None else near.body[first : first + 3]
        body[first : first + 3] = attitude_lag.identify(command, angle, before)
    body[H.K_PSI : H.B_PSI + 1] = energy_balance.turning(flown).value
    body[H.A_0 : H.A_N + 1] = energy_balance.lifting(flown, body[H.V_0]).value
    power = energy_balance.power(flown, body[H.T_0], body[H.V_0])
    body[H.C_0 : H.C_N + 1] = power.value
    return Hybrid(body, power, float(good.t[-1]))
