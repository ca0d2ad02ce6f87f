"""Read a recording into arrays by kind of telemetry, and write an altered copy as a fleet recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleet.airframes.airframe import ASSUMED, ServoMap, servo_map
from fleet.airframes.servo_learning import learn_servo_map
from fleet.bus.codec import encode, encoding
from fleet.contract import COLUMNS, Array, Params, Rows, Sample, Status
from fleet.telemetry.recording.fleet_log import BusRecord
from fleet.telemetry.recording.options import RecordingOptions
from fleet.telemetry.recording.recordings import replay_messages
from fleet.vehicles import vehicle_class

MIN_ROWS = 50  # of a kind that an injected fault needs
_MIN_SPEED = 6.0  # over ground, of flight [m/s]
_MIN_HEIGHT_M = 30.0  # above the start where the recording begins on the ground
_REQUIRED = ("attitude", "velocity", "position", "servo")
Series = dict[str, np.ndarray]


@dataclass(frozen=True)
class FlightRecording:
    """One recorded aircraft.

    Attributes:
        name: of the recording
        messages: as recorded
        params: autopilot parameters
        t: by kind of telemetry, time of each row in recorded order, (n,) [s since 1970]
        x: the rows themselves, columns as in `fleet.contract.COLUMNS`, (n, k)
        airborne: first and last time in the air since the first attitude [s]
    """

    name: str
    messages: tuple[Any, ...]
    params: dict[str, float]
    t: Series
    x: Series
    airborne: tuple[float, float]

    @property
    def t_start(self) -> float:
        """Return the time of the first attitude [s since 1970]."""
        return float(self.t["attitude"].min())

    def at(self, kind: str, times: np.ndarray, x: Series | None = None) -> np.ndarray:
        """Interpolate the rows of a kind to `times` [s since 1970], (n, k)."""
        order = np.argsort(self.t[kind], kind="stable")
        columns = (self.x if x is None else x)[kind][order].astype(float).T
        return np.stack([np.interp(times, self.t[kind][order], column) for column in columns], axis=1)


def common_servo_map(flights: Sequence[FlightRecording]) -> ServoMap:
    """Return the servo map that the parameters of one aircraft describe, else the one that its flights show together.

    Without control errors it is the usual assignment of outputs.
    """
    described = servo_map({name: value for flight in flights for name, value in flight.params.items()})
    if not described.sentence.startswith(ASSUMED) or any(not {"command", "air"} <= set(flight.t) for flight in flights):
        return described
    parts = []
    for flight in flights:
        times = flight.t["servo"]
        attitude, command = flight.at("attitude", times), flight.at("command", times)
        pulses, errors = flight.x["servo"][:, :8].astype(float), command[:, :2] - attitude[:, :2]
        parts.append((pulses, errors, attitude[:, 3:5], flight.at("air", times)[:, 1]))
    return learn_servo_map(*map(np.concatenate, zip(*parts, strict=True))) or described


def read_recorded(path: Path, options: RecordingOptions) -> FlightRecording:
    """Read the recording of one fixed wing.

    Raises:
        ValueError: if it contains several aircraft, a rotorcraft, or lacks telemetry; the text names the remedy.
        OSError: if it cannot be opened.
    """
    name = path.name.split(".")[0]
    messages = tuple(replay_messages(path, options=options))
    samples = [message for message in messages if isinstance(message, Sample)]
    if len(aircraft := {sample.uav for sample in samples}) != 1:
        raise ValueError(f"{name}: found {len(aircraft)} aircraft, expected one; record each in a file of its own")
    vehicles = {m.vehicle for m in messages if isinstance(m, Status) and vehicle_class(m.vehicle).is_rotorcraft}
    if vehicles:
        raise ValueError(f"{name}: found a {vehicles.pop()}, expected a fixed wing; name fixed-wing flights only")
    params: dict[str, float] = {}
    for message in messages:
        if isinstance(message, Params):
            params.update(message.values)
    rows = {kind: [r for s in samples if (r := getattr(s, kind)) is not None] for kind in COLUMNS}
    t = {kind: np.concatenate([r.t.numpy() for r in parts]) for kind, parts in rows.items() if parts}
    x = {kind: np.concatenate([r.x.numpy() for r in parts]) for kind, parts in rows.items() if parts}
    for kind in _REQUIRED:
        if len(t.get(kind, ())) < MIN_ROWS:
            raise ValueError(f"{name}: found no {kind} in it, expected telemetry of a flight; record that message too")
    return FlightRecording(name, messages, params, t, x, _airborne(name, t, x))


def _airborne(name: str, t: Series, x: Series) -> tuple[float, float]:
    """Return the first and the last time in the air since the first attitude [s]."""
    speed = np.hypot(*x["velocity"][:, :2].T)
    flying = speed > _MIN_SPEED
    if speed[:10].min() < 0.5 * _MIN_SPEED:  # it took off in this recording
        order = np.argsort(t["position"], kind="stable")
        height = x["position"][order, 2] * 1e-3
        flying &= np.interp(t["velocity"], t["position"][order], height - height[0]) > _MIN_HEIGHT_M
    if flying.sum() < MIN_ROWS:
        raise ValueError(f"{name}: found no flight in it, expected speeds above {_MIN_SPEED:.0f} m/s; name another")
    times = t["velocity"][flying] - t["attitude"].min()
    return float(times.min()), float(times.max())


def write_recorded(flight: FlightRecording, altered: Mapping[str, np.ndarray], path: Path) -> None:
    """Write the messages of a flight with altered rows (n, k) of some kinds, in recorded order."""
    position = dict.fromkeys(altered, 0)
    received_t = 0.0
    with path.open("wb") as file:
        for message in flight.messages:
            received_t = max(received_t, message.t)
            if isinstance(message, Sample):
                changes: dict[str, Rows] = {}
                for kind, x in altered.items():
                    rows: Rows | None = getattr(message, kind)
                    if rows is not None:
                        begin = position[kind]
                        position[kind] += len(rows.t.numpy())
                        changes[kind] = Rows(rows.t, _as_recorded(x[begin : position[kind]], rows.x.dtype))
                message = msgspec.structs.replace(message, **changes)
            file.write(BusRecord(received_t, encoding(type(message)), encode(message)).pack())


def _as_recorded(x: np.ndarray, dtype: str) -> Array:
    return Array.of(np.rint(x) if np.dtype(dtype).kind in "iu" else x, dtype)
