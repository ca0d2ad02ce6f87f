"""Events of a UAV in data time.

Texts are not escaped here but where they become HTML.
"""

from enum import StrEnum
from typing import NamedTuple

MAX_EVENTS = 200  # events of one UAV; the oldest are dropped first
MAX_ALERTS = 64  # simultaneous alerts accepted of one UAV
LATEST = 4e9  # later times are invalid [s since 1970]


class EventKind(StrEnum):
    """Kind of event; each has a glyph and a colour."""

    MODE = "mode"
    ITEM = "item"
    MISSION = "mission"
    ARMED = "armed"
    DISARMED = "disarmed"
    WARNING = "warning"
    ALERT = "alert"
    MISMATCH = "mismatch"
    CLEARED = "cleared"
    LINK_LOST = "link lost"
    LINK_RESTORED = "link restored"
    VERIFIED = "verified"
    ACCEPTED = "accepted"
    UNVERIFIED = "unverified"
    NO_MODEL = "no model"
    PARAMETERS = "parameters"
    TAKE_OFF = "take-off"
    LANDING = "landing"
    GROUND = "ground"
    TELEMETRY_LOST = "telemetry lost"
    TELEMETRY_RESTORED = "telemetry restored"
    FRAME = "frame"
    END = "end"


class TimelineEvent(NamedTuple):
    """Event of a UAV."""

    t: float  # data time [s since 1970]
    kind: EventKind
    text: str  # untrusted: escape it in HTML


def merged(events: tuple[TimelineEvent, ...], new_events: list[TimelineEvent]) -> tuple[TimelineEvent, ...]:
    """Merge events by time; keep the newest `MAX_EVENTS`."""
    return tuple(sorted((*events, *new_events), key=lambda event: event.t)[-MAX_EVENTS:])


def closed_at(events: tuple[TimelineEvent, ...], t: float) -> tuple[TimelineEvent, ...]:
    """End the events at the end of the recording, t [s]; drop a link loss after it."""
    remaining = tuple(event for event in events if event.t <= t or event.kind is not EventKind.LINK_LOST)
    return merged(remaining, [TimelineEvent(t, EventKind.END, "end of the recording")] if 0 < t < LATEST else [])
