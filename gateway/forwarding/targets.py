"""Targets of MAVLink messages: the fields `target_system` and `target_component` of raw frames."""

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.parsing.decode import Frames, layout
from fleet.telemetry.mavlink.parsing.scan import EXTRA, ID, PAYLOAD, SIZE

NOWHERE = -1


def _places(field: str) -> np.ndarray:
    places = np.full(len(EXTRA), NOWHERE)
    for number, kind in dialect.mavlink_map.items():
        if field in kind.fieldnames:
            places[number] = layout(kind.msgname).fields[field][1]  # type: ignore[index]
    return places


_SYSTEM, _COMPONENT = _places("target_system"), _places("target_component")


def targets(frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    """Return the target system and component of every frame, (n,) each; 0: broadcast."""
    return _read(frames, _SYSTEM), _read(frames, _COMPONENT)


def _read(frames: Frames, places: np.ndarray) -> np.ndarray:
    place, found = places[frames.at[:, ID]], np.zeros(len(frames.at), np.int64)
    there = np.flatnonzero((place != NOWHERE) & (place < frames.at[:, SIZE]))  # trailing zeros are not transmitted
    found[there] = frames.buf[frames.at[there, PAYLOAD] + place[there]]
    return found
