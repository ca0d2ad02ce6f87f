"""Targets of MAVLink messages: the fields `target_system` and `target_component` of raw frames."""

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.parsing.decode import Frames, layout
from fleet.telemetry.mavlink.parsing.scan import EXTRA, ID, PAYLOAD, SIZE

ABSENT = -1


def _field_offsets(field: str) -> np.ndarray:
    offsets = np.full(len(EXTRA), ABSENT)
    for number, kind in dialect.mavlink_map.items():
        if field in kind.fieldnames:
            offsets[number] = layout(kind.msgname).fields[field][1]  # type: ignore[index]
    return offsets


_SYSTEM, _COMPONENT = _field_offsets("target_system"), _field_offsets("target_component")


def targets(frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    """Return the target system and component of every frame, (n,) each; 0: broadcast."""
    return _read_field(frames, _SYSTEM), _read_field(frames, _COMPONENT)


def _read_field(frames: Frames, offsets: np.ndarray) -> np.ndarray:
    frame_offsets, values = offsets[frames.headers[:, ID]], np.zeros(len(frames.headers), np.int64)
    present = np.flatnonzero(
        (frame_offsets != ABSENT) & (frame_offsets < frames.headers[:, SIZE])
    )  # trailing zeros are not transmitted
    values[present] = frames.buf[frames.headers[present, PAYLOAD] + frame_offsets[present]]
    return values
