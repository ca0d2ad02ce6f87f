"""Position targets for aircraft whose mission list is unknown: with MISSION_CURRENT each is one item of it."""

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.parsing.decode import IDS, Frames
from fleet.telemetry.mavlink.parsing.scan import ID

_TARGET = IDS["POSITION_TARGET_GLOBAL_INT"]
_PERIOD_S = 0.5  # minimum time between two targets of one aircraft [s]


def queue_targets(frames: Frames, owner: np.ndarray, links: list[AircraftLink]) -> None:
    """Queue the targets of aircraft without a mission list.

    Args:
        frames: received frames
        owner: number of the aircraft of each frame, -1 without, (n,)
        links: aircraft by number
    """
    is_target = frames.headers[:, ID] == _TARGET
    if not is_target.any():
        return
    wanted = np.array([link.mission.needs_targets for link in links] + [False])
    newest: dict[int, float] = {}
    selected: list[int] = []
    for k in np.flatnonzero(is_target & wanted[owner]).tolist():
        number, arrival = int(owner[k]), float(frames.arrival[k])
        if not 0 <= arrival - newest.get(number, -np.inf) < _PERIOD_S:
            newest[number] = arrival
            selected.append(k)
    for k, message in zip(selected, frames.messages(np.array(selected, int)), strict=True):
        link = links[int(owner[k])]
        link.queue(float(frames.arrival[k]), link.process_target, message)
