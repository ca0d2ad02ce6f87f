"""Events during an absence of the operator; the browser stores the time of its last visit."""

from html import escape
from typing import NamedTuple

from viewer.store.inbox import time_of_day
from viewer.store.vehicle import Vehicle
from viewer.theme.events import LATEST, EventKind, TimelineEvent
from viewer.theme.palette import Palette


def encode_click(uav: int, t: float) -> str:
    """Encode a UAV id and a data time [s since 1970]: `7@1700000000.500`; omit an invalid time."""
    return f"{uav}@{t:.3f}" if 0 <= t < LATEST else f"{uav}"


def parse_click(text: str) -> tuple[int, float | None] | None:
    """Parse `7` or `7@1700000000.500`; return None for any other text."""
    uav, _, t = text[:40].partition("@")
    if not (uav.isascii() and uav.isdecimal() and len(uav) <= 6):
        return None
    if not t:
        return int(uav), None
    valid = t.isascii() and t.replace(".", "", 1).isdecimal() and float(t) < LATEST
    return (int(uav), float(t)) if valid else None


MAX_ROWS = 40
REPORTED_KINDS = {
    EventKind.ALERT,
    EventKind.MISMATCH,
    EventKind.LINK_LOST,
    EventKind.LINK_RESTORED,
    EventKind.CLEARED,
    EventKind.WARNING,
    EventKind.NO_MODEL,
}


class Absence(NamedTuple):
    """Absence of the operator, wall-clock time [s since 1970]."""

    left: float
    returned: float


def missed_events(fleet: list[Vehicle], absence: Absence) -> list[tuple[Vehicle, TimelineEvent]]:
    """Return the reported events of live UAVs during an absence, newest first."""
    events = [(v, event) for v in fleet if not v.recorded for event in v.events if event.kind in REPORTED_KINDS]
    missed = [(v, event) for v, event in events if absence.left < event.t <= absence.returned + 1.0]
    return sorted(missed, key=lambda entry: -entry[1].t)


def missed_events_html(fleet: list[Vehicle], absence: Absence | None, palette: Palette, pick: str) -> str:
    """Return the missed events as HTML; empty without an absence. `pick` is the click handler with `{}`."""
    if absence is None:
        return ""
    events = missed_events(fleet, absence)
    interval = f"{time_of_day(absence.left)} to {time_of_day(absence.returned)}"
    head = f"<b>Since you left</b> <span class=soft>{interval}</span>"
    rows = "".join(
        f'<div class="event pick" onpointerdown="{pick.format(encode_click(v.uav, event.t))}">'
        f'<span class="num soft">{time_of_day(event.t)}</span>'
        f'<b style="color:{palette.event(event.kind)}">{event.kind.glyph}</b>'
        f"<span>{v.name} {escape(event.text)}</span></div>"
        for v, event in events[:MAX_ROWS]
    )
    more = f'<div class="soft">and {len(events) - MAX_ROWS} earlier</div>' if len(events) > MAX_ROWS else ""
    rows = rows or '<div class="soft">no events</div>'
    return f'<div class="uav">{head}<div class="events">{rows}{more}</div></div>'
