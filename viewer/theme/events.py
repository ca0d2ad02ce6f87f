"""Events of a UAV in data time.

Texts are not escaped here but where they become HTML.
"""

from enum import StrEnum
from typing import NamedTuple

MAX_EVENTS = 200  # events of one UAV; the oldest are dropped first
MAX_RAISED = 64  # simultaneous alerts accepted of one UAV
LATEST = 4e9  # later times are invalid [s since 1970]


class Kind(StrEnum):
    """Kind of event; each has a glyph and a colour."""

    MODE = "mode"
    ITEM = "item"
    MISSION = "mission"
    ARMED = "armed"
    DISARMED = "disarmed"
    WARNING = "warning"
    ALERT = "alert"
    MISMATCH = "mismatch"
    EASED = "eased"
    LOST = "lost"
    BACK = "back"
    VERIFIED = "verified"
    SOUND = "sound"
    DOUBTED = "doubted"
    NO_MODEL = "no model"
    PARAMETERS = "parameters"
    TAKE_OFF = "take-off"
    LANDING = "landing"
    GROUND = "ground"
    BLIND = "blind"
    SIGHT = "sight"
    FRAME = "frame"
    END = "end"


class Event(NamedTuple):
    """Event of a UAV."""

    t: float  # data time [s since 1970]
    kind: Kind
    text: str  # untrusted: escape it in HTML


def merged(events: tuple[Event, ...], fresh: list[Event]) -> tuple[Event, ...]:
    """Merge events by time; keep the newest `MAX_EVENTS`."""
    return tuple(sorted((*events, *fresh), key=lambda event: event.t)[-MAX_EVENTS:])


def closed(events: tuple[Event, ...], t: float) -> tuple[Event, ...]:
    """End the events at the end of the recording, t [s]; drop a link loss after it."""
    flown = tuple(event for event in events if event.t <= t or event.kind is not Kind.LOST)
    return merged(flown, [Event(t, Kind.END, "end of the recording")] if 0 < t < LATEST else [])
