"""Event list of one UAV as HTML: newest first, with data time, glyph and colour."""

from html import escape

from viewer.store.inbox import date_text, time_of_day, timestamp
from viewer.theme.events import TimelineEvent
from viewer.theme.palette import MARK, Palette

MAX_EVENT_ROWS = 40  # events shown; earlier ones are counted


def event_list_html(events: tuple[TimelineEvent, ...], palette: Palette, seek: str = "") -> str:
    """Return the events as HTML, newest first; texts are escaped here.

    Args:
        events: oldest first
        palette: colours
        seek: page code that seeks to the time inserted at `{}`; empty: rows are not clickable
    """
    if not events:
        return '<div class="uav"><b>Events</b> <span class="soft">none yet</span></div>'
    rows = "".join(_row(event, palette, seek) for event in reversed(events[-MAX_EVENT_ROWS:]))
    earlier = len(events) - MAX_EVENT_ROWS
    more = f'<div class="soft">and {earlier} earlier</div>' if earlier > 0 else ""
    return (
        f'<div class="uav"><b>Events</b> <span class="soft">{len(events)} · {date_text(events[-1].t)}</span>'
        f'<div class="events">{rows}{more}</div></div>'
    )


def _row(event: TimelineEvent, palette: Palette, seek: str) -> str:
    press = f' onpointerdown="{seek.format(event.t)}"' if seek else ""
    return (
        f'<div class="event" data-kind="{event.kind.value}" title="{timestamp(event.t)}"{press}>'
        f'<span class="num soft">{time_of_day(event.t)}</span>'
        f'<b style="color:{palette.event(event.kind)}">{MARK[event.kind]}</b><span>{escape(event.text)}</span></div>'
    )
