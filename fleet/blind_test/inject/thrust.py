"""Thrust curve that a flight shows: specific thrust as a function of throttle and airspeed.

    dVa/dt + g h_dot / Va = T/m - D/m
    T/m = k_t sigma w (2 Va + w),   w = delta_t (k_motor - Va)
    D/m = rho Va^2 / 2 c_0 + 2 c_2 (n g)^2 / (rho Va^2)

sigma is the density over that of sea level, n = 1 / cos phi the load factor. Only the shape of T matters for a loss of
thrust, its scale for a drag increase.
Source: Beard & McLain 2012, section 4.3 (momentum theory of the propeller); Anderson, Introduction to Flight, ch. 6.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from fleet.airframes.airframe import ServoMap
from fleet.blind_test.inject.recorded import FlightRecording
from fleet.frames import G

MIN_R2 = 0.5  # share of the variance of specific excess power that the curve must explain [-]
_RHO_0, _LAPSE, _POWER = 1.225, 2.25577e-5, 4.2559  # ISA density: rho = rho_0 (1 - lapse h)^power
_STEP_S, _MEAN_S = 0.2, 2.0
_MOTOR_RATIOS = np.geomspace(1.1, 6.0, 40)  # k_motor over the highest airspeed [-]


@dataclass(frozen=True)
class ThrustCurve:
    """Specific thrust of one flight.

    Attributes:
        k_t: scale [1/m]; k_motor: airspeed at which full throttle gives no thrust [m/s]
        c_0: specific drag area [m2/kg]
        r2: share of the variance of specific excess power that it explains [-]
    """

    k_t: float
    k_motor: float
    c_0: float
    r2: float

    def thrust(self, delta_t: np.ndarray, Va: np.ndarray, rho: np.ndarray) -> np.ndarray:
        """Return the specific thrust, (n,) [m/s2]."""
        w = delta_t * (self.k_motor - Va)
        return np.asarray(self.k_t * rho / _RHO_0 * w * (2.0 * Va + w))

    def throttle(self, thrust: np.ndarray, Va: np.ndarray, rho: np.ndarray) -> np.ndarray:
        """Return the throttle of a specific thrust, (n,) [-]; above 1 where the engine cannot give it."""
        root = np.sqrt(np.maximum(Va**2 + thrust * _RHO_0 / (self.k_t * rho), 0.0))
        return np.asarray((root - Va) / np.maximum(self.k_motor - Va, 1e-3))


def density(h: np.ndarray) -> np.ndarray:
    """Return the density of the standard atmosphere at height h, (n,) [kg/m3]."""
    return np.asarray(_RHO_0 * np.clip(1.0 - _LAPSE * h, 0.1, 2.0) ** _POWER)


def airspeed(flight: FlightRecording, times: np.ndarray) -> np.ndarray:
    """Return the airspeed, else the ground speed, at `times`, (n,) [m/s]."""
    if "air" in flight.t and np.ptp(flight.x["air"][:, 0]) > 0.5:
        return np.maximum(flight.at("air", times)[:, 0], 1.0)
    return np.maximum(np.linalg.norm(flight.at("velocity", times), axis=1), 1.0)


def fit_thrust_curves(flights: Sequence[FlightRecording], used_map: ServoMap) -> list[ThrustCurve]:
    """Fit thrust and drag of every flight of one aircraft, with one `k_motor`; `r2` says whether a flight shows them.

    Weight and battery differ between flights, the propeller does not.
    """
    balances = [_balance(flight, used_map) for flight in flights]
    highest = max(float(np.percentile(Va, 99)) for Va, *_ in balances)
    candidates = [[_fit(balance, k_motor) for balance in balances] for k_motor in _MOTOR_RATIOS * highest]
    return min(
        candidates,
        key=lambda curves: sum((1.0 - curve.r2) * len(b[0]) for curve, b in zip(curves, balances, strict=True)),
    )


def _fit(balance: tuple[np.ndarray, ...], k_motor: float) -> ThrustCurve:
    Va, delta_t, rho, load, excess = balance
    w = delta_t * np.maximum(k_motor - Va, 0.0)
    terms = (rho / _RHO_0 * w * (2.0 * Va + w), -0.5 * rho * Va**2, -2.0 * (load * G) ** 2 / (rho * Va**2))
    A = np.stack([_mean(column) for column in terms], axis=1)
    scale = np.maximum(np.abs(A).max(axis=0), 1e-12)
    x, norm = nnls(A / scale, excess)
    k_t, c_0, _ = x / scale
    r2 = 1.0 - norm**2 / max(float(((excess - excess.mean()) ** 2).sum()), 1e-12)
    return ThrustCurve(float(k_t), float(k_motor), float(c_0), r2 if k_t > 0.0 else 0.0)


def _balance(flight: FlightRecording, used_map: ServoMap) -> tuple[np.ndarray, ...]:
    """Return airspeed, throttle, density, load factor and specific excess thrust of a flight, (n,) each."""
    begin, end = (flight.t_start + x for x in flight.airborne)
    times = np.arange(begin, end, _STEP_S)
    inputs = used_map.inputs(flight.x["servo"][:, :8].astype(float))
    delta_t = flight.at("servo", times, {"servo": inputs})[:, 3]
    Va, climb = airspeed(flight, times), -flight.at("velocity", times)[:, 2]
    rho = density(flight.at("position", times)[:, 2] * 1e-3)
    load = 1.0 / np.cos(np.clip(flight.at("attitude", times)[:, 0], -1.2, 1.2))
    return Va, delta_t, rho, load, _mean(np.gradient(Va, _STEP_S) + G * climb / Va)


def _mean(x: np.ndarray) -> np.ndarray:
    """Return the running mean over `_MEAN_S`, (n,)."""
    n = round(_MEAN_S / _STEP_S)
    return np.convolve(np.pad(x, (n // 2, n - 1 - n // 2), mode="edge"), np.ones(n) / n, "valid")
