"""Read recorded flights as windows of air-relative velocities."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fleet.airframes.airframe import ServoMap, servo_map
from fleet.contract import Params, Sample
from fleet.frames import Origin, ned_to_body
from fleet.telemetry.recording.recordings import replay_messages
from fleet.window import Window
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.resample import preprocess

_WIND_S = 0.2  # sampling interval of the wind filter [s]
_WIND_TRANSIENT_S = 20.0  # convergence time of the wind filter [s]


@dataclass(frozen=True)
class RecordedFlight:
    """One aircraft's flight.

    Attributes:
        uav: id
        recording: whole flight, velocities over the ground
        wind: filtered wind at each row, NED, (n, 3) [m/s]
    """

    uav: int
    recording: Window
    wind: np.ndarray

    def window(self, start: int, seen_s: float, unseen_s: float) -> Window:
        """Return the window around row `start`, with air-relative velocities from the wind at `start`."""
        dt = self.recording.dt
        part = self.recording.part(start - round(seen_s / dt), start + round(unseen_s / dt))
        phi, theta, psi = part.columns(("phi", "theta", "psi")).T
        air = ned_to_body(phi, theta, psi, part.v - self.wind[start])
        return replace(part, x=np.hstack([air, part.x[:, 3:]]))

    def starts(self, seen_s: float, unseen_s: float, every_s: float) -> Iterator[int]:
        """Yield the start rows of unseen windows without gaps."""
        dt = self.recording.dt
        seen, unseen, every = (round(s / dt) for s in (seen_s, unseen_s, every_s))
        for start in range(round(_WIND_TRANSIENT_S / dt) + seen, len(self.recording) - unseen + 1, every):
            if self.recording.ok[start - unseen : start + unseen].all():
                yield start


def read_flights(path: Path, offset: int = 0) -> Iterator[RecordedFlight]:
    """Read every flight of a recording that has all required rows.

    Args:
        path: recording, e.g. flight.tlog.xz
        offset: UAV id = MAVLink system id + this
    """
    histories: dict[int, TelemetryHistory] = {}
    params: dict[int, dict[str, float]] = {}
    for message in replay_messages(path, offset):
        if isinstance(message, Sample):
            histories.setdefault(message.uav, TelemetryHistory(keep_s=1e5)).add(message)
        elif isinstance(message, Params):
            params.setdefault(message.uav, {}).update(message.values)
    for uav, history in sorted(histories.items()):
        recording = _resampled(history, servo_map(params.get(uav, {})))
        if recording is not None:
            yield RecordedFlight(uav, recording, _wind(history, recording))


def _resampled(history: TelemetryHistory, servos: ServoMap) -> Window | None:
    t, lla = history.rows("position")
    if len(t) < 2:
        return None
    origin, calm = Origin(*(int(k) for k in lla[0])), np.zeros(3)
    return preprocess(history, origin, servos, calm, until=float(t[-1]), seconds=float(t[-1] - t[0]))


def _wind(history: TelemetryHistory, recording: Window) -> np.ndarray:
    """Filter the wind along the flight, (n, 3) [m/s]; zero without airspeed."""
    wind = np.zeros((len(recording), 3))
    t_air, air = history.rows("air")
    if not len(t_air):
        return wind
    filt, every = WindFilter(), round(_WIND_S / recording.dt)
    Va = np.interp(recording.t, t_air, air[:, 0])
    for k in range(0, len(recording), every):
        if recording.ok[k]:
            filt.update(float(recording.t[k]), recording.v[k], float(Va[k]), float(recording.x[k, 8]))
        wind[k : k + every] = filt.wind
    return wind
