"""Read a recording, smooth it and resample each flight to one grid, with a mask of valid rows."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import firwin, upfirdn

from fleet.contract import Params, Sample, Status
from fleet.frames import Origin, to_ned
from fleet.process.sanitise import format_below
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions
from fleet.telemetry.recording.recordings import replay_messages
from fleet.vehicles import vehicle_class
from twin_worker.diagnosis.data.card import AircraftCard
from twin_worker.diagnosis.data.outputs import ServoOutputs, read_outputs
from twin_worker.telemetry.history import TelemetryHistory

DT = 0.04  # grid of a flight [s]
DECIMATION = 5  # grid steps between two residuals
STEP_S = DT * DECIMATION
CUTOFF_HZ = 1.5  # band of the residuals
SLOW_CUTOFF_HZ = 0.6  # band of residuals between two sensors
_HALF = 31  # half length of the filter [grid steps]

_LOWPASS = firwin(2 * _HALF + 1, CUTOFF_HZ, fs=1 / DT)
_SLOPE = np.convolve(_LOWPASS, [0.5 / DT, 0.0, -0.5 / DT])
_SLOW = firwin(21, SLOW_CUTOFF_HZ, fs=1 / STEP_S)
HALF_SUPPORT = _HALF + 1  # half length of the filter support [grid steps]


def smooth(x: np.ndarray) -> np.ndarray:
    """Filter and decimate x, (n,), to (n_dec,)."""
    return _filter_decimated(_LOWPASS, x)


def slope(x: np.ndarray) -> np.ndarray:
    """Differentiate, filter and decimate x, (n,), to dx/dt, (n_dec,) [1/s]."""
    return _filter_decimated(_SLOPE, x)


def slow(x: np.ndarray) -> np.ndarray:
    """Filter decimated columns, (n, k), to `SLOW_CUTOFF_HZ`."""
    half = len(_SLOW) // 2
    padded = np.concatenate([np.repeat(x[:1], half, axis=0), x, np.repeat(x[-1:], half, axis=0)])
    return np.stack([np.convolve(column, _SLOW, mode="valid") for column in padded.T], axis=1)


def decimated(x: np.ndarray) -> np.ndarray:
    """Return every fifth value, the grid of `smooth`, without filtering."""
    return x[::DECIMATION]


def valid_decimated(ok: np.ndarray, half_support: int = HALF_SUPPORT // 2) -> np.ndarray:
    """Return which decimated values depend on valid rows only, (n_dec,) bool; ignores the tails of the filter."""
    bad = np.convolve(~ok, np.ones(2 * half_support + 1), mode="same") > 0.5
    return ~bad[::DECIMATION]


def _filter_decimated(taps: np.ndarray, x: np.ndarray) -> np.ndarray:
    half = len(taps) // 2
    lead = -2 * half % DECIMATION  # aligns the first output with the decimated grid
    padded = np.concatenate([np.full(lead + half, x[0]), x, np.full(half + DECIMATION, x[-1])])
    first = (2 * half + lead) // DECIMATION
    return upfirdn(taps, padded, 1, DECIMATION)[first : first + (len(x) + DECIMATION - 1) // DECIMATION]


VANE_HZ = 18.0  # least accelerometer rate to measure flow angles; slower samples alias gusts [Hz]
_SEA_LEVEL, _LAPSE, _POWER = 101325.0, 2.25577e-5, 5.2559  # ISA: p = p0 (1 - lapse h)^power  [Pa, 1/m, -]
_MAX_GAP_S = {"attitude": 0.25, "velocity": 0.45, "servo": 0.3, "air": 0.7}  # longest gaps that are interpolated [s];
_MAX_GAP_RATIO = 1.9  # or this multiple of the median gap where telemetry is slower
_GYRO_GAP_RATIO = 0.5  # rates come from the gyros if their gaps are below this share of the attitude gaps
_AROUND_GAP_S = 0.3
_TRANSIENT_S = 5.0, 1.5  # excluded at the start and at the end [s]
_MIN_FLIGHT_S = 25.0  # least length of valid flight
_MIN_HEIGHT_M = 30.0  # above the ground after a take-off in the recording
_MIN_SPEED = 6.0  # [m/s]


@dataclass(frozen=True)
class FlightData:
    """One aircraft's flight.

    Attributes:
        name: of the recording
        t: time since the first attitude, equally spaced, (n,) [s]
        t_start: time of the first attitude [s since 1970]
        readings: by the names in `fleet.effects.READINGS`, (n,) each, psi unwrapped; also gnss, the satellite
            height, and low, slow: commanded less measured height [m] and airspeed [m/s]
        commands: delta_a delta_e delta_r delta_t as commanded, (n, 4) [-]
        position: north and east of the first position, (n, 2) [m]
        ground: height of home above mean sea level [m]
        ok: valid rows, (n,) bool
        vane: the accelerometer is fast enough to measure flow angles (`VANE_HZ`)
        limitations: detection power lost because of missing data, in sentences
        outputs: servo outputs at their own times; None where the control errors are not recorded
    """

    name: str
    t: np.ndarray
    t_start: float
    readings: dict[str, np.ndarray]
    commands: np.ndarray
    position: np.ndarray
    ground: float
    ok: np.ndarray
    vane: bool
    limitations: tuple[str, ...] = ()
    outputs: ServoOutputs | None = None

    @property
    def seconds(self) -> float:
        """Return the length of the valid rows [s]."""
        return float(self.ok.sum() * DT)


def read_flights(path: Path, card: AircraftCard, options: RecordingOptions = NO_OPTIONS) -> list[FlightData]:
    """Read every aircraft of a recording.

    Raises:
        ValueError: if the recording has no usable flight; the message names the reason.
        OSError: if the file cannot be opened.
    """
    telemetry: dict[int, tuple[TelemetryHistory, dict[str, float]]] = {}
    rotors: dict[int, str] = {}
    modes: dict[int, list[tuple[float, str]]] = {}
    skipped: list[str] = []
    for message in replay_messages(path, skipped=skipped, options=options):
        uav = message.uav
        history, params = telemetry.setdefault(uav, (TelemetryHistory(keep_s=np.inf), {}))
        if isinstance(message, Sample):
            history.add(message)
        elif isinstance(message, Params):
            params.update(message.values)
        elif isinstance(message, Status):
            if vehicle_class(message.vehicle).is_rotorcraft:
                rotors[uav] = message.vehicle
            changes = modes.setdefault(uav, [])
            if message.mode and (not changes or changes[-1][1] != message.mode):
                changes.append((message.t, message.mode))
    stem = path.name.split(".")[0]
    flights, refused = [], []
    for uav, (history, params) in sorted(telemetry.items()):
        name = stem if len(telemetry) == 1 else f"{stem}-uav{uav}"
        if uav in rotors:
            refused.append(f"{name}: found a {rotors[uav]}, expected a fixed wing; diagnose fixed-wing flights only")
            continue
        try:
            flights.append(resample_flight(name, history, params, card, modes.get(uav, ())))
        except ValueError as error:
            refused.append(str(error))
    if not flights:
        raise ValueError("; ".join([*refused, *skipped]) or f"{stem}: found no aircraft, expected a flight; check it")
    return flights


def resample_flight(
    name: str,
    history: TelemetryHistory,
    params: dict[str, float],
    card: AircraftCard,
    modes: Sequence[tuple[float, str]] = (),
) -> FlightData:
    """Resample the telemetry of one aircraft to the grid; `modes` as in `read_outputs`.

    Raises:
        ValueError: if required telemetry is missing; the message names it.
    """
    series = {kind: history.rows(kind) for kind in ("attitude", "velocity", "position", "servo", "air", "imu")}
    length = float(np.ptp(series["attitude"][0])) if len(series["attitude"][0]) else 0.0
    _check_length(name, length, "s", "s of flight at least; record longer")
    for kind in ("attitude", "velocity", "position", "servo"):
        if len(series[kind][0]) < 50:
            raise ValueError(f"{name}: found no {kind} in it, expected telemetry of a flight; record that message too")
    t_start = float(series["attitude"][0][0])
    start = max(float(series[kind][0][0]) for kind in ("attitude", "velocity", "servo")) - t_start + 0.1
    stop = min(float(series[kind][0][-1]) for kind in ("attitude", "velocity", "servo")) - t_start - 0.1
    _check_length(name, max(stop - start, 0.0), "s", "s of flight at least; record longer")
    t = np.arange(np.ceil(start / DT), np.floor(stop / DT)) * DT
    limitations: list[str] = []
    readings, vane = _readings(series, history, t, t_start, limitations)
    t_p, lla = series["position"]
    origin = Origin(*np.rint(lla[0]).astype(int).tolist())
    ned = to_ned(origin, *lla.T)
    readings["h"] = np.interp(t, t_p - t_start, lla[:, 2] * 1e-3)
    horizontal = np.column_stack([np.interp(t, t_p - t_start, ned[:, i]) for i in (0, 1)])
    commands = card.commands(_interpolated(t, series["servo"], t_start), params)
    commands[:, 3] = np.clip(commands[:, 3], 0.0, 1.0)
    ground = _ground_height(history, readings["h"], t, t_start)
    ok = _valid_rows(series, readings, t, t_start, ground)
    outputs = read_outputs(history, dict(card.servo_parameters(params)), t_start, modes)
    flight = FlightData(name, t, t_start, readings, commands, horizontal, ground, ok, vane, tuple(limitations), outputs)
    _check_length(name, flight.seconds, "s in the air", "s at least; check that the aircraft flew")
    return flight


def _check_length(name: str, seconds: float, span: str, requirement: str) -> None:
    if seconds < _MIN_FLIGHT_S:
        least = f"{_MIN_FLIGHT_S:.0f} {requirement}"
        raise ValueError(f"{name}: found {format_below(seconds, _MIN_FLIGHT_S)} {span}, expected {least}")


def _interpolated(t: np.ndarray, samples: tuple[np.ndarray, np.ndarray], t_start: float) -> np.ndarray:
    times, x = samples
    return np.stack([np.interp(t, times - t_start, column) for column in x.T], axis=1)


def _readings(
    series: dict[str, tuple[np.ndarray, np.ndarray]],
    history: TelemetryHistory,
    t: np.ndarray,
    t_start: float,
    limitations: list[str],
) -> tuple[dict[str, np.ndarray], bool]:
    """Return the readings on the grid, and whether the accelerometer is fast enough to measure flow angles."""
    out: dict[str, np.ndarray] = {}

    def add(names: Iterable[str], times: np.ndarray, x: np.ndarray) -> None:
        out.update(zip(names, _interpolated(t, (times, x), t_start).T, strict=True))

    attitude_t, attitude = series["attitude"]
    gap = float(np.median(np.diff(attitude_t)))
    angles = np.column_stack([attitude[:, :2], np.unwrap(attitude[:, 2]), attitude[:, 3:]])
    add(("phi", "theta", "psi", "p", "q", "r"), attitude_t, angles)
    add(("v_n", "v_e", "v_d"), *series["velocity"])
    imu_t, imu = series["imu"]
    usual = float(np.median(np.diff(imu_t))) if len(imu_t) > 50 else np.inf
    vane = usual <= 1.0 / VANE_HZ
    if len(imu_t) > 50:
        add(("a_x", "a_y", "a_z"), imu_t, imu[:, :3])
        if vane or usual < _GYRO_GAP_RATIO * gap:
            add(("p", "q", "r"), imu_t, imu[:, 3:])
    if not vane:
        rate = "no accelerometer" if not np.isfinite(usual) else f"the accelerometer at {1 / usual:.0f} Hz"
        limitations.append(
            f"{rate}: forces come from the velocity, with less sensitivity to gusts and small lift changes"
        )
    if gap > _MAX_GAP_S["attitude"]:
        limitations.append(f"attitude at {1 / gap:.1f} Hz: only effects of several seconds are detectable")
    air_t, air = series["air"]
    if len(air_t) > 50 and np.ptp(air[:, 0]) > 0.5:
        out["Va"] = np.interp(t, air_t - t_start, air[:, 0])
    else:
        limitations.append("no airspeed: wind, air density and airspeed sensor faults are not separable")
    command_t, command = history.rows("command")
    if len(command_t) > 50:
        add(("low", "slow"), command_t, command[:, 3:5])
    pressure_t, pressure = history.rows("pressure")
    if len(pressure_t) > 20:
        height = (1.0 - (np.clip(pressure[:, 0], 2e4, 1.2e5) / _SEA_LEVEL) ** (1 / _POWER)) / _LAPSE
        out["baro"] = np.interp(t, pressure_t - t_start, height)
        gnss_t, gnss = history.rows("gnss")
        if len(gnss_t) > 50:  # the estimator height follows the barometer; only the satellite height is independent
            out["gnss"] = np.interp(t, gnss_t - t_start, gnss[:, 0] * 1e-3)
    else:
        limitations.append("no static pressure: barometer faults are not detectable")
    return out, vane


def _ground_height(history: TelemetryHistory, h: np.ndarray, t: np.ndarray, t_start: float) -> float:
    """Return the height of home above mean sea level, or the least height of the flight if unknown [m]."""
    height_t, above = history.rows("height")
    if len(height_t) < 50:
        return float(h.min())
    return float(np.median(h - np.interp(t, height_t - t_start, above[:, 0])))


def _valid_rows(
    series: dict[str, tuple[np.ndarray, np.ndarray]],
    readings: dict[str, np.ndarray],
    t: np.ndarray,
    t_start: float,
    ground: float,
) -> np.ndarray:
    """Return the grid times with measurements without gaps, taken in flight, (n,) bool."""
    bad = np.zeros(len(t), bool)
    for kind, max_gap in _MAX_GAP_S.items():
        times = series[kind][0] - t_start
        if len(times) < 50:
            continue
        gaps = np.diff(times)
        usual = float(np.median(gaps))
        for k in np.flatnonzero(gaps > (max_gap if usual < max_gap else _MAX_GAP_RATIO * usual)):
            bad |= (t > times[k] - _AROUND_GAP_S) & (t < times[k + 1] + _AROUND_GAP_S)
    speed = np.hypot(readings["v_n"], readings["v_e"])
    bad |= speed < _MIN_SPEED
    if speed[: int(5 / DT)].min() < 3.0:  # it took off in this recording
        bad |= readings["h"] - ground < _MIN_HEIGHT_M
    bad[: int(_TRANSIENT_S[0] / DT)] = True
    bad[-int(_TRANSIENT_S[1] / DT) :] = True
    return ~bad
