"""What happened to a UAV, as a list of events: their times are data times, so a recording of 2013 tells 2013.

What the words say is not escaped here but where they become HTML.
"""

from enum import StrEnum
from typing import NamedTuple

MAX_EVENTS = 200  # kept of one UAV; the oldest go first
MAX_RAISED = 64  # alerts of one UAV in force at once; more are a stranger's
LATEST = 4e9  # times beyond are noise [s since 1970]


class Kind(StrEnum):
    """What sort of event it is; each has its glyph and its colour."""

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
    """Something that happened."""

    t: float  # data time [s since 1970]
    kind: Kind
    text: str  # from outside: escape it before it becomes HTML


def merged(events: tuple[Event, ...], fresh: list[Event]) -> tuple[Event, ...]:
    """Add events in the order of their times; of too many the newest stay."""
    return tuple(sorted((*events, *fresh), key=lambda event: event.t)[-MAX_EVENTS:])


def closed(events: tuple[Event, ...], t: float) -> tuple[Event, ...]:
    """End the events with the recording at time t [s]: that nothing came after it is no loss of the link."""
    flown = tuple(event for event in events if event.t <= t or event.kind is not Kind.LOST)
    return merged(flown, [Event(t, Kind.END, "end of the recording")] if 0 < t < LATEST else [])
