"""Telemetry of one multirotor on an equally spaced grid."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fleet.frames import Origin, to_ned
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.motors import RotorFrame, motor_inputs, rotor_frame

DT = 0.02  # of the grid [s]
MIN_HZ = 20.0  # of accelerometer and motor outputs; slower samples alias the answers of the attitude control
_MIN_ROWS, _MIN_FLIGHT_S = 50, 20.0
_MIN_HEIGHT_M = 3.0  # lower rows are on or near the ground
_MIN_INPUT = 0.08  # mean motor input of a flying multirotor [-]
_MAX_GAP_S, _AROUND_S = 0.5, 0.5
_SEA_LEVEL, _POWER, _LAPSE = 101_325.0, 5.25588, 2.25577e-5  # standard atmosphere [Pa, -, 1/m]


@dataclass(frozen=True)
class RotorFlight:
    """Flight data on the grid.

    Attributes:
        name: of the flight; frame: places of the motors
        t: since the first attitude, (n,) [s]; t_start: time of that attitude [s since 1970]
        inputs: of the motors 0..1, (n, m) [-]
        force: specific force FRD, (n, 3) [m/s2]; rates: p, q, r, (n, 3) [rad/s]
        velocity: NED, (n, 3) [m/s]; attitude: phi, theta, psi unwrapped, (n, 3) [rad]
        height: pressure height less satellite height, (n,) [m]; nan where not recorded
        position: north, east, up from the start, (n, 3) [m]
        ok: rows in flight without gaps, (n,) bool
        limitations: what the telemetry does not show, in sentences
    """

    name: str
    frame: RotorFrame
    t: np.ndarray
    t_start: float
    inputs: np.ndarray
    force: np.ndarray
    rates: np.ndarray
    velocity: np.ndarray
    attitude: np.ndarray
    height: np.ndarray
    position: np.ndarray
    ok: np.ndarray
    limitations: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Return the length of the valid rows [s]."""
        return float(self.ok.sum() * DT)


def rotor_flight(name: str, history: TelemetryHistory, params: Mapping[str, float]) -> RotorFlight:
    """Resample the telemetry of one multirotor to the grid.

    Raises:
        ValueError: if required telemetry is missing; the message names it.
    """
    frame = rotor_frame(params)
    if frame is None:
        raise ValueError(f"{name}: found no known frame in the parameters, expected a quadrotor or hexarotor")
    series = {kind: history.rows(kind) for kind in ("attitude", "velocity", "servo", "imu")}
    words = {"attitude": "attitude", "velocity": "velocity", "servo": "motor outputs", "imu": "accelerometer"}
    for kind, word in words.items():
        if len(series[kind][0]) < _MIN_ROWS:
            raise ValueError(f"{name}: found no {word} in it, expected telemetry of a flight; record that message too")
    for kind in ("servo", "imu"):
        if (hertz := _rate(series[kind][0])) < MIN_HZ:
            raise ValueError(
                f"{name}: found {words[kind]} at {hertz:.1f} Hz, expected {MIN_HZ:.0f} Hz at least for the rotor "
                "model; use the onboard log"
            )
    t_start = float(series["attitude"][0][0])
    begin = max(float(rows[0][0]) for rows in series.values()) - t_start
    end = min(float(rows[0][-1]) for rows in series.values()) - t_start
    t = np.arange(np.ceil(begin / DT), np.floor(end / DT)) * DT
    if len(t) * DT < _MIN_FLIGHT_S:
        raise ValueError(
            f"{name}: found {max(end - begin, 0):.0f} s, expected {_MIN_FLIGHT_S:.0f} s of flight at least"
        )

    def on_grid(times: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, times - t_start, column) for column in x.T], axis=1)

    motors = frame.places.shape[1]
    inputs = on_grid(series["servo"][0], motor_inputs(series["servo"][1][:, :motors], params))
    attitude_t, attitude = series["attitude"]
    attitude = np.column_stack([attitude[:, :2], np.unwrap(attitude[:, 2])])
    imu = on_grid(*series["imu"])
    height, position, limitations = _heights(history, t, t_start)
    height -= np.median(height)  # of the day's pressure and of the geoid
    flying = inputs.mean(axis=1) > _MIN_INPUT
    if np.isfinite(position[:, 2]).any():
        flying &= position[:, 2] > _MIN_HEIGHT_M
    ok = _trimmed(flying & _without_gaps(series, t, t_start))
    flight = RotorFlight(
        *(name, frame, t, t_start, inputs, imu[:, :3], imu[:, 3:6]),
        *(on_grid(*series["velocity"]), on_grid(attitude_t, attitude), height, position, ok, tuple(limitations)),
    )
    if flight.seconds < _MIN_FLIGHT_S:
        raise ValueError(
            f"{name}: found {flight.seconds:.0f} s in the air, expected {_MIN_FLIGHT_S:.0f} s at least; record longer"
        )
    return flight


def _rate(times: np.ndarray) -> float:
    return float(1.0 / max(np.median(np.diff(times)), 1e-3))


def _heights(history: TelemetryHistory, t: np.ndarray, t_start: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return pressure less satellite height, north, east and up from the start, and what is missing."""
    limitations: list[str] = []
    position = np.full((len(t), 3), np.nan)
    times, lla = history.rows("position")
    if len(times) >= _MIN_ROWS:
        ned = to_ned(Origin(*np.rint(lla[0]).astype(int).tolist()), *lla.T)
        position = np.stack([np.interp(t, times - t_start, column) for column in ned.T], axis=1)
        position[:, 2] = -position[:, 2]
    above_t, above = history.rows("height")
    if len(above_t) >= _MIN_ROWS:
        position[:, 2] = np.interp(t, above_t - t_start, above[:, 0])
    elif np.isfinite(position[:, 2]).any():
        position[:, 2] -= np.nanmin(position[:, 2])
    pressure_t, pressure = history.rows("pressure")
    gnss_t, gnss = history.rows("gnss")
    difference = np.full(len(t), np.nan)
    if len(pressure_t) >= _MIN_ROWS and len(gnss_t) >= _MIN_ROWS:
        baro = (1.0 - (np.clip(pressure[:, 0], 2e4, 1.2e5) / _SEA_LEVEL) ** (1 / _POWER)) / _LAPSE
        difference = np.interp(t, pressure_t - t_start, baro) - np.interp(t, gnss_t - t_start, gnss[:, 0] * 1e-3)
    else:
        limitations.append("no static pressure or satellite height: barometer faults are not detectable")
    return difference, position, limitations


def _without_gaps(series: dict[str, tuple[np.ndarray, np.ndarray]], t: np.ndarray, t_start: float) -> np.ndarray:
    ok = np.ones(len(t), bool)
    for times, _ in series.values():
        since, gaps = times - t_start, np.diff(times)
        for k in np.flatnonzero(gaps > max(_MAX_GAP_S, 3 * float(np.median(gaps)))):
            ok &= (t < since[k] - _AROUND_S) | (t > since[k + 1] + _AROUND_S)
    return ok


def _trimmed(ok: np.ndarray) -> np.ndarray:
    """Return the rows that are also in flight `_AROUND_S` before and after."""
    n = round(_AROUND_S / DT)
    padded = np.concatenate([np.zeros(n, bool), ok, np.zeros(n, bool)])
    count = np.convolve(padded, np.ones(2 * n + 1, int), "valid")
    return np.asarray(count == 2 * n + 1)
