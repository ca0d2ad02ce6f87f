"""Read a recording and resample each flight to one grid, with a mask of valid rows."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleet.contract import Params, Sample, Status
from fleet.frames import Origin, to_ned
from fleet.process.sanitise import below
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.diagnosis.data.card import Card
from twin_worker.diagnosis.data.smooth import DT
from twin_worker.telemetry.history import History

VANE_HZ = 18.0  # least accelerometer rate to measure flow angles; slower samples alias gusts [Hz]
_SEA_LEVEL, _LAPSE, _POWER = 101325.0, 2.25577e-5, 5.2559  # ISA: p = p0 (1 - lapse h)^power  [Pa, 1/m, -]
_WIDEST = {"attitude": 0.25, "velocity": 0.45, "servo": 0.3, "air": 0.7}  # longest gaps that are interpolated [s];
_SLOW = 1.9  # or this multiple of the median gap where telemetry is slower
_FASTER = 0.5  # rates come from the gyros if their gaps are below this share of the attitude gaps
_AROUND_GAP_S = 0.3
_SETTLE_S = 5.0, 1.5  # excluded at the start and at the end [s]
_LEAST_S = 25.0  # least length of valid flight
_ROTORS = ("multirotor", "helicopter")
_CLEAR_M = 30.0  # above the ground after a take-off in the recording
_LEAST_SPEED = 6.0  # [m/s]


@dataclass(frozen=True)
class Flight:
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
    """

    name: str
    t: np.ndarray
    zero: float
    readings: dict[str, np.ndarray]
    commands: np.ndarray
    place: np.ndarray
    ground: float
    ok: np.ndarray
    vane: bool
    lacks: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Return the length of the valid rows [s]."""
        return float(self.ok.sum() * DT)


def read_flights(path: Path, card: Card) -> list[Flight]:
    """Read every aircraft of a recording.

    Raises:
        ValueError: if the recording has no usable flight; the message names the reason.
        OSError: if the file cannot be opened.
    """
    told: dict[int, tuple[History, dict[str, float]]] = {}
    rotors: dict[int, str] = {}
    skipped: list[str] = []
    for message in replay_messages(path, skipped=skipped):
        uav = message.uav
        history, params = told.setdefault(uav, (History(keep_s=np.inf), {}))
        if isinstance(message, Sample):
            history.add(message)
        elif isinstance(message, Params):
            params.update(message.values)
        elif isinstance(message, Status) and message.vehicle in _ROTORS:
            rotors[uav] = message.vehicle
    stem = path.name.split(".")[0]
    flights, refused = [], []
    for uav, (history, params) in sorted(told.items()):
        name = stem if len(told) == 1 else f"{stem}-uav{uav}"
        if uav in rotors:
            refused.append(f"{name}: found a {rotors[uav]}, expected a fixed wing; diagnose fixed-wing flights only")
            continue
        try:
            flights.append(lay(name, history, params, card))
        except ValueError as error:
            refused.append(str(error))
    if not flights:
        raise ValueError("; ".join([*refused, *skipped]) or f"{stem}: found no aircraft, expected a flight; check it")
    return flights


def lay(name: str, history: History, params: dict[str, float], card: Card) -> Flight:
    """Resample the telemetry of one aircraft to the grid.

    Raises:
        ValueError: if required telemetry is missing; the message names it.
    """
    rows = {kind: history.rows(kind) for kind in ("attitude", "velocity", "position", "servo", "air", "imu")}
    length = np.ptp(rows["attitude"][0]) if len(rows["attitude"][0]) else 0.0
    if length < _LEAST_S:
        raise ValueError(
            f"{name}: found {below(length, _LEAST_S)} s, expected {_LEAST_S:.0f} s of flight at least; record longer"
        )
    for kind in ("attitude", "velocity", "position", "servo"):
        if len(rows[kind][0]) < 50:
            raise ValueError(f"{name}: found no {kind} in it, expected telemetry of a flight; record that message too")
    zero = float(rows["attitude"][0][0])
    start = max(float(rows[kind][0][0]) for kind in ("attitude", "velocity", "servo")) - zero + 0.1
    stop = min(float(rows[kind][0][-1]) for kind in ("attitude", "velocity", "servo")) - zero - 0.1
    if stop - start < _LEAST_S:
        raise ValueError(
            f"{name}: found {below(max(stop - start, 0.0), _LEAST_S)} s, expected {_LEAST_S:.0f} s of flight at least; "
            "record longer"
        )
    t = np.arange(np.ceil(start / DT), np.floor(stop / DT)) * DT
    lacks: list[str] = []
    readings, vane = _readings(rows, history, t, zero, lacks)
    t_p, place = rows["position"]
    origin = Origin(*np.rint(place[0]).astype(int).tolist())
    ned = to_ned(origin, *place.T)
    readings["h"] = np.interp(t, t_p - zero, place[:, 2] * 1e-3)
    horizontal = np.column_stack([np.interp(t, t_p - zero, ned[:, i]) for i in (0, 1)])
    commands = card.commands(_on(t, rows["servo"], zero), params)
    commands[:, 3] = np.clip(commands[:, 3], 0.0, 1.0)
    ground = _ground(history, readings["h"], t, zero)
    ok = _trusted(rows, readings, t, zero, ground)
    flight = Flight(name, t, zero, readings, commands, horizontal, ground, ok, vane, tuple(lacks))
    if flight.seconds < _LEAST_S:
        raise ValueError(
            f"{name}: found {below(flight.seconds, _LEAST_S)} s in the air, expected {_LEAST_S:.0f} s at least; "
            "check that the aircraft flew"
        )
    return flight


def _on(t: np.ndarray, rows: tuple[np.ndarray, np.ndarray], zero: float) -> np.ndarray:
    at, x = rows
    return np.stack([np.interp(t, at - zero, column) for column in x.T], axis=1)


def _readings(
    rows: dict[str, tuple[np.ndarray, np.ndarray]], history: History, t: np.ndarray, zero: float, lacks: list[str]
) -> tuple[dict[str, np.ndarray], bool]:
    """Return the readings on the grid, and whether the accelerometer is fast enough to measure flow angles."""
    at, attitude = rows["attitude"]
    angles = np.column_stack([attitude[:, :2], np.unwrap(attitude[:, 2]), attitude[:, 3:]])
    out = dict(zip(("phi", "theta", "psi", "p", "q", "r"), _on(t, (at, angles), zero).T, strict=True))
    out |= dict(zip(("v_n", "v_e", "v_d"), _on(t, rows["velocity"], zero).T, strict=True))
    imu_t, imu = rows["imu"]
    usual = float(np.median(np.diff(imu_t))) if len(imu_t) > 50 else np.inf
    vane = usual <= 1.0 / VANE_HZ
    if len(imu_t) > 50:
        out |= dict(zip(("a_x", "a_y", "a_z"), _on(t, (imu_t, imu[:, :3]), zero).T, strict=True))
        gyros = _on(t, (imu_t, imu[:, 3:]), zero)
        if vane or usual < _FASTER * float(np.median(np.diff(at))):
            out |= dict(zip(("p", "q", "r"), gyros.T, strict=True))
    if not vane:
        rate = "no accelerometer" if not np.isfinite(usual) else f"the accelerometer at {1 / usual:.0f} Hz"
        lacks.append(f"{rate}: forces come from the velocity, with less sensitivity to gusts and small lift changes")
    if (gap := float(np.median(np.diff(at)))) > _WIDEST["attitude"]:
        lacks.append(f"attitude at {1 / gap:.1f} Hz: only effects of several seconds are detectable")
    air_t, air = rows["air"]
    if len(air_t) > 50 and np.ptp(air[:, 0]) > 0.5:
        out["Va"] = np.interp(t, air_t - zero, air[:, 0])
    else:
        lacks.append("no airspeed: wind, air density and airspeed sensor faults are not separable")
    wanted_t, wanted = history.rows("command")
    if len(wanted_t) > 50:
        out |= dict(zip(("low", "slow"), _on(t, (wanted_t, wanted[:, 3:5]), zero).T, strict=True))
    pressure_t, pressure = history.rows("pressure")
    if len(pressure_t) > 20:
        height = (1.0 - (np.clip(pressure[:, 0], 2e4, 1.2e5) / _SEA_LEVEL) ** (1 / _POWER)) / _LAPSE
        out["baro"] = np.interp(t, pressure_t - zero, height)
        gnss_t, gnss = history.rows("gnss")
        if len(gnss_t) > 50:  # the estimator height follows the barometer; only the satellite height is independent
            out["gnss"] = np.interp(t, gnss_t - zero, gnss[:, 0] * 1e-3)
    else:
        lacks.append("no static pressure: barometer faults are not detectable")
    return out, vane


def _ground(history: History, h: np.ndarray, t: np.ndarray, zero: float) -> float:
    """Return the height of home above mean sea level, or the least height of the flight if unknown [m]."""
    at, above = history.rows("height")
    if len(at) < 50:
        return float(h.min())
    return float(np.median(h - np.interp(t, at - zero, above[:, 0])))


def _trusted(
    rows: dict[str, tuple[np.ndarray, np.ndarray]],
    readings: dict[str, np.ndarray],
    t: np.ndarray,
    zero: float,
    ground: float,
) -> np.ndarray:
    """Return the grid times with measurements without gaps, taken in flight, (n,) bool."""
    bad = np.zeros(len(t), bool)
    for kind, widest in _WIDEST.items():
        at = rows[kind][0] - zero
        if len(at) < 50:
            continue
        gaps = np.diff(at)
        usual = float(np.median(gaps))
        for k in np.flatnonzero(gaps > (widest if usual < widest else _SLOW * usual)):
            bad |= (t > at[k] - _AROUND_GAP_S) & (t < at[k + 1] + _AROUND_GAP_S)
    speed = np.hypot(readings["v_n"], readings["v_e"])
    bad |= speed < _LEAST_SPEED
    if speed[: int(5 / DT)].min() < 3.0:  # it took off in this recording
        bad |= readings["h"] - ground < _CLEAR_M
    bad[: int(_SETTLE_S[0] / DT)] = True
    bad[-int(_SETTLE_S[1] / DT) :] = True
    return ~bad
