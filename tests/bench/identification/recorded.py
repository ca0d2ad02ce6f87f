"""Recorded flights: JSBSim's c172p, the flight stack as the product reads it, a real one by the bench's own reader."""

import json
from pathlib import Path

import numpy as np
import scipy.io

from fleet.airframes.airframe import servo_map
from fleet.contract import Params, Sample
from fleet.frames import Origin, ned_to_body
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.resample import DT, preprocess

from .flight import Case, Flight, true_airspeed, unwrapped

STACK = ("s01_nominal_calm", "s02_nominal_light_wind", "s03_nominal_modes")
_SPAN = {"c172p": 10.9, "stack": 1.88, "thor": 1.27}  # [m]
_GAP_S = 0.5  # longer ones are not measured [s]
_SETTLE_S = 8.0  # of the simulator, before the first row [s]
_STANDS = 3.0  # slower it has not left its place [m/s]
_LOW_M, _CLIMBED_S, _LANDING_S = 25.0, 12.0, 25.0  # take-off and landing are cut off
_THOR_S = (222.0, 560.0)  # airborne
_THOR_AUTO = 2  # mode in which the autopilot's commands are flown, else the pilot's
_THOR_THROW = 0.4363  # 25 deg [rad]


# --- JSBSim's c172p --------------------------------------------------------------------------------------------------


def c172p(folder: Path) -> list[Case]:
    """Read the flights without a concealed effect: calibration and controls."""
    labels = json.loads((folder / "concealed-open" / "labels.json").read_text())
    names = sorted(name for name, label in labels.items() if label["role"] in ("nominal", "control"))
    return [Case(_c172p(folder / "concealed-open" / f"{name}.npz", k)) for k, name in enumerate(names)]


def _c172p(path: Path, k: int) -> Flight:
    with np.load(path) as file:
        rows = {name: np.unique(file[name].astype(float), axis=0) for name in file if file[name].ndim == 2}
    attitude, servo, local, air = (
        rows[name] for name in ("ATTITUDE", "SERVO_OUTPUT_RAW", "LOCAL_POSITION_NED", "VFR_HUD")
    )
    needed = (attitude, servo, local, air)
    t = np.arange(max(r[0, 0] for r in needed) + _SETTLE_S, min(r[-1, 0] for r in needed), DT)
    attitude[:, 1:4] = unwrapped(attitude[:, 1:4])
    angles = _laid(attitude, t)
    velocity = ned_to_body(*angles[:, :3].T, _laid(local, t)[:, 3:])
    half = (_laid(servo, t)[:, :4] - 1500.0) / 500.0  # aileron, elevator (down), throttle, rudder (left)
    u = np.column_stack([half[:, 0], -half[:, 1], -half[:, 3], 0.5 * (half[:, 2] + 1)])
    hud = _laid(air, t)  # airspeed, ground speed, heading, throttle, height above sea level
    return Flight(
        name=path.stem,
        uav=k,
        dt=DT,
        t=t,
        x=np.hstack([velocity, angles[:, 3:], angles[:, :3]]),
        u=u,
        Va=true_airspeed(hud[:, 0], hud[:, 4]),
        ok=~(_gaps(attitude, t) | _gaps(servo, t) | _gaps(local, t)),
        b=_SPAN["c172p"],
    )


def _laid(rows: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Lay rows (n, 1 + k), time first, straight on the grid, (m, k)."""
    return np.column_stack([np.interp(t, rows[:, 0], column) for column in rows[:, 1:].T])


def _gaps(rows: np.ndarray, t: np.ndarray) -> np.ndarray:
    right = np.clip(np.searchsorted(rows[:, 0], t), 1, len(rows) - 1)
    return rows[right, 0] - rows[right - 1, 0] > _GAP_S


# --- the flight stack ------------------------------------------------------------------------------------------------


def stack(folder: Path) -> list[Case]:
    """Read the flights of the flight stack as the product sees them, in the air, whatever the mode."""
    return [Case(_airborne(folder / "sitl" / f"{name}.tlog.xz", k)) for k, name in enumerate(STACK)]


def _airborne(path: Path, k: int) -> Flight:
    history, params = TelemetryHistory(keep_s=1e5), {}
    for message in replay_messages(path):
        if isinstance(message, Sample):
            history.add(message)
        elif isinstance(message, Params):
            params |= message.values
    (t_p, place), (t_v, v) = history.rows("position"), history.rows("velocity")
    stands = t_p < t_v[np.linalg.norm(v, axis=1) > _STANDS][0]  # a row before the first fix has no height
    high = t_p[place[:, 2] - np.median(place[stands, 2]) > 1e3 * _LOW_M]
    begun, ended = high[0] + _CLIMBED_S, high[-1] - _LANDING_S
    window = preprocess(
        history, Origin(*(int(i) for i in place[0])), servo_map(params), np.zeros(3), until=ended, seconds=ended - begun
    )
    assert window is not None, f"{path.name}: found no rows of a needed kind"
    t_air, air = history.rows("air")
    Va = true_airspeed(np.interp(window.t, t_air, air[:, 0]), 1e-3 * np.interp(window.t, t_p, place[:, 2]))
    return Flight(path.name[:3], k, DT, window.t - window.t[0], window.x, window.u, Va, window.ok, _SPAN["stack"])


# --- Thor ------------------------------------------------------------------------------------------------------------


def thor(folder: Path) -> list[Case]:
    """Read the real flight: 50 Hz averaged to 25, the gyros' biases, as its own filter knew them, removed."""
    path = folder / "real" / "thor_flight75.mat"
    data = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)["flight_data"]
    t_all = data.time
    rows = (t_all >= _THOR_S[0]) & (t_all < _THOR_S[1])

    def read(name: str) -> np.ndarray:
        return np.asarray(getattr(data, name), float)[rows]

    def flown(name: str) -> np.ndarray:
        return np.where(read("mode") == _THOR_AUTO, read(name), read(f"{name}_in"))

    def halved(*columns: np.ndarray) -> np.ndarray:
        both = np.column_stack(columns)
        return 0.5 * (both[0 : len(both) // 2 * 2 : 2] + both[1::2])

    angles = halved(*unwrapped(np.column_stack([read("phi"), read("theta"), read("psi")])).T)
    rates = halved(*(read(name) - read(f"{name}_bias") for name in "pqr"))
    velocity = ned_to_body(*angles.T, halved(read("navvn"), read("navve"), read("navvd")))
    aileron = 0.5 * (flown("da_l") - flown("da_r"))
    surfaces = halved(aileron, -flown("de"), flown("dr")) / _THOR_THROW
    u = np.column_stack([surfaces, halved(np.clip(flown("dthr"), 0, 1))])
    t, Va = halved(t_all[rows]).ravel(), halved(read("ias")).ravel()
    x = np.hstack([velocity, rates, angles])
    return [Case(Flight("thor75", 0, DT, t - t[0], x, u, Va, np.ones(len(t), bool), _SPAN["thor"]))]
