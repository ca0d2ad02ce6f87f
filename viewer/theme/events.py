"""Events of a UAV in data time.

Texts are not escaped here but where they become HTML.
"""

from enum import StrEnum
from typing import NamedTuple

MAX_EVENTS = 200  # events of one UAV; the oldest are dropped first
MAX_ALERTS = 64  # simultaneous alerts accepted of one UAV
LATEST = 4e9  # later times are invalid [s since 1970]


class EventKind(StrEnum):
    """Kind of event, with its glyph and the `Palette` field of its colour."""

    glyph: str
    colour: str

    def __new__(cls, value: str, glyph: str, colour: str) -> "EventKind":
        """Create a member from its value, glyph and colour."""
        kind = str.__new__(cls, value)
        kind._value_, kind.glyph, kind.colour = value, glyph, colour
        return kind

    MODE = "mode", "◆", "predicting"
    ITEM = "item", "›", "route"
    MISSION = "mission", "≡", "route"
    ARMED = "armed", "●", "ink"
    DISARMED = "disarmed", "○", "ink"
    WARNING = "warning", "!", "mismatch"
    ALERT = "alert", "▲", "mismatch"
    MISMATCH = "mismatch", "≠", "mismatch"
    CLEARED = "cleared", "△", "lost"
    LINK_LOST = "link lost", "✕", "lost"
    LINK_RESTORED = "link restored", "↺", "lost"
    VERIFIED = "verified", "✓", "verified"
    ACCEPTED = "accepted", "✓", "verified"
    UNVERIFIED = "unverified", "◑", "identifying"
    NO_MODEL = "no model", "◌", "identifying"
    PARAMETERS = "parameters", "≈", "route"
    TAKE_OFF = "take-off", "↗", "ink"
    LANDING = "landing", "↘", "ink"
    GROUND = "ground", "▁", "ink"
    TELEMETRY_LOST = "telemetry lost", "⊘", "lost"
    TELEMETRY_RESTORED = "telemetry restored", "⊙", "lost"
    FRAME = "frame", "⌖", "mismatch"
    END = "end", "■", "ink"


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


def clip(text: str, n: int) -> str:
    """Truncate a received text to n characters."""
    return text if len(text) <= n else text[: n - 1] + "…"
