"""Recordings of real aircraft in formats the product does not read, laid on the grid of the diagnosis by hand."""

import io
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scipy.io

from fleet.frames import Origin, to_ned
from twin_worker.diagnosis.data.flight import DT, FlightData

_THOR_S = 205.0, 590.0  # what is read; and in the air
_AIRBORNE_S = 222.0, 560.0
_AUTO = 2  # mode in which the autopilot's commands are flown, else the pilot's
_THROW = 0.4363  # 25 deg [rad]


def streams(folder: Path) -> Iterator[tuple[str, FlightData, float | None]]:
    """Give ALFA's five streams: fault, flight, and when it was injected [s], None where none was.

    No position, no rates and no surfaces are in them: rates are differences of angles, velocity is airspeed along the
    heading, as without wind, and the height to hold is the usual one.
    """
    with tarfile.open(folder / "real" / "alfa_streams_5_faults_10hz.tar.xz") as archive:
        for member in archive.getmembers():
            if (file := archive.extractfile(member)) is not None:
                rows = np.genfromtxt(io.BytesIO(file.read()), delimiter=",", names=True)
                injected = rows["t_sec"][rows["is_boundary"] > 0]
                fault = member.name.rsplit("/", 1)[-1].removesuffix("_failure.csv").rsplit("_", 1)[-1]
                yield fault, _stream(fault, rows), float(injected[0]) if len(injected) else None


def _stream(fault: str, rows: np.ndarray) -> FlightData:
    ts, Va, climb = rows["t_sec"], rows["airspeed"], rows["climb"]
    t = np.arange(DT, ts[-1], DT)
    # resampled angles are wrong where they wrap, and these two wrap at different places
    heading = np.where(np.abs(rows["heading"] - 180.0) < 170.0, rows["heading"], rows["yaw"])
    phi, theta, psi = np.radians(rows["roll"]), np.radians(rows["pitch"]), np.unwrap(np.radians(heading))
    phi_dot, theta_dot, psi_dot = (np.gradient(x, ts) for x in (phi, theta, psi))
    level = np.sqrt(np.maximum(Va**2 - climb**2, 1.0))
    readings = {
        "phi": phi,
        "theta": theta,
        "psi": psi,
        "p": phi_dot - psi_dot * np.sin(theta),
        "q": theta_dot * np.cos(phi) + psi_dot * np.cos(theta) * np.sin(phi),
        "r": psi_dot * np.cos(theta) * np.cos(phi) - theta_dot * np.sin(phi),
        "v_n": level * np.cos(psi),
        "v_e": level * np.sin(psi),
        "v_d": -climb,
        "h": rows["altitude"],
        "Va": Va,
        "low": np.median(rows["altitude"]) - rows["altitude"],
        "slow": np.median(Va) - Va,
    }
    commands = np.zeros((len(t), 4))
    commands[:, 3] = np.interp(t, ts, rows["throttle"])
    ok = (t > 2.0) & (t < ts[-1] - 1.2)
    laid = {name: np.interp(t, ts, x) for name, x in readings.items()}
    return FlightData(
        fault, t, 0.0, laid, commands, np.zeros((len(t), 2)), float(rows["altitude"].min()), ok, vane=False
    )


def thor(folder: Path) -> FlightData:
    """Give UMN's Thor: 50 Hz, gyros and accelerometers less the biases its own filter knew."""
    data = scipy.io.loadmat(folder / "real" / "thor_flight75.mat", squeeze_me=True, struct_as_record=False)
    rows = data["flight_data"]
    within = (rows.time >= _THOR_S[0]) & (rows.time < _THOR_S[1])

    def read(name: str) -> np.ndarray:
        return np.asarray(getattr(rows, name), float)[within]

    def flown(name: str) -> np.ndarray:
        return np.where(read("mode") == _AUTO, read(name), read(f"{name}_in"))

    ts = read("time")
    t = np.arange(np.ceil(ts[0] / DT), np.floor(ts[-1] / DT)) * DT
    place = np.degrees(read("navlat")) * 1e7, np.degrees(read("navlon")) * 1e7, read("navalt") * 1e3
    ned = to_ned(Origin(*(round(float(x[0])) for x in place)), *place)
    names = {"phi": "phi", "theta": "theta", "v_n": "navvn", "v_e": "navve", "v_d": "navvd", "h": "navalt", "Va": "ias"}
    readings = {name: read(column) for name, column in names.items()} | {"psi": np.unwrap(read("psi"))}
    for name in ("p", "q", "r", "ax", "ay", "az"):
        readings[name if len(name) == 1 else f"a_{name[1]}"] = read(name) - read(f"{name}_bias")
    aileron = 0.5 * (flown("da_l") - flown("da_r"))
    commands = aileron / _THROW, -flown("de") / _THROW, flown("dr") / _THROW, np.clip(flown("dthr"), 0.0, 1.0)

    def laid(x: np.ndarray) -> np.ndarray:
        return np.interp(t, ts, x)

    return FlightData(
        name="thor",
        t=t,
        t_start=0.0,
        readings={name: laid(x) for name, x in readings.items()},
        commands=np.column_stack([laid(x) for x in commands]),
        position=np.column_stack([laid(ned[:, 0]), laid(ned[:, 1])]),
        ground=float(readings["h"].min()),
        ok=(t >= _AIRBORNE_S[0]) & (t < _AIRBORNE_S[1]),
        vane=True,
    )
