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
from twin_worker.telemetry.history import History
from twin_worker.telemetry.resample import preprocess

_WIND_S = 0.2  # sampling interval of the wind filter [s]
_SETTLE_S = 20.0  # convergence time of the wind filter [s]


@dataclass(frozen=True)
class Flown:
    """One aircraft's flight.

    Attributes:
        uav: id
        recording: whole flight, velocities over the ground
        wind: filtered wind at each row, NED, (n, 3) [m/s]
    """

    uav: int
    whole: Window
    wind: np.ndarray

    def window(self, start: int, seen_s: float, unseen_s: float) -> Window:
        """Return the window around row `start`, with air-relative velocities from the wind at `start`."""
        dt = self.whole.dt
        part = self.whole.part(start - round(seen_s / dt), start + round(unseen_s / dt))
        phi, theta, psi = part.columns(("phi", "theta", "psi")).T
        air = ned_to_body(phi, theta, psi, part.v - self.wind[start])
        return replace(part, x=np.hstack([air, part.x[:, 3:]]))

    def starts(self, seen_s: float, unseen_s: float, every_s: float) -> Iterator[int]:
        """Yield the start rows of unseen windows without gaps."""
        dt = self.whole.dt
        seen, unseen, every = (round(s / dt) for s in (seen_s, unseen_s, every_s))
        for start in range(round(_SETTLE_S / dt) + seen, len(self.whole) - unseen + 1, every):
            if self.whole.ok[start - unseen : start + unseen].all():
                yield start


def flown(path: Path, offset: int = 0) -> Iterator[Flown]:
    """Read every flight of a recording that has all required rows.

    Args:
        path: recording, e.g. flight.tlog.xz
        offset: UAV id = MAVLink system id + this
    """
    histories: dict[int, History] = {}
    params: dict[int, dict[str, float]] = {}
    for message in replay_messages(path, offset):
        if isinstance(message, Sample):
            histories.setdefault(message.uav, History(keep_s=1e5)).add(message)
        elif isinstance(message, Params):
            params.setdefault(message.uav, {}).update(message.values)
    for uav, history in sorted(histories.items()):
        whole = _whole(history, servo_map(params.get(uav, {})))
        if whole is not None:
            yield Flown(uav, whole, _wind(history, whole))


def _whole(history: History, servos: ServoMap) -> Window | None:
    t, place = history.rows("position")
    if len(t) < 2:
        return None
    origin, still = Origin(*(int(k) for k in place[0])), np.zeros(3)
    return preprocess(history, origin, servos, still, until=float(t[-1]), seconds=float(t[-1] - t[0]))


def _wind(history: History, whole: Window) -> np.ndarray:
    """Filter the wind along the flight, (n, 3) [m/s]; zero without airspeed."""
    wind = np.zeros((len(whole), 3))
    t_air, air = history.rows("air")
    if not len(t_air):
        return wind
    filt, every = WindFilter(), round(_WIND_S / whole.dt)
    Va = np.interp(whole.t, t_air, air[:, 0])
    for k in range(0, len(whole), every):
        if whole.ok[k]:
            filt.update(float(whole.t[k]), whole.v[k], float(Va[k]), float(whole.x[k, 8]))
        wind[k : k + every] = filt.wind
    return wind
