"""Event list of one UAV as HTML: newest first, with data time, glyph and colour."""

from html import escape

from viewer.store.received.datatime import day, moment, stamp
from viewer.theme.events import Event
from viewer.theme.palette import MARK, Palette

ROWS = 40  # events shown; earlier ones are counted


def listing(events: tuple[Event, ...], palette: Palette, seek: str = "") -> str:
    """Return the events as HTML, newest first; texts are escaped here.

    Args:
        events: oldest first
        palette: colours
        seek: page code that seeks to the time inserted at `{}`; empty: rows are not clickable
    """
    if not events:
        return '<div class="uav"><b>Events</b> <span class="soft">none yet</span></div>'
    rows = "".join(_row(event, palette, seek) for event in reversed(events[-ROWS:]))
    earlier = len(events) - ROWS
    more = f'<div class="soft">and {earlier} earlier</div>' if earlier > 0 else ""
    return (
        f'<div class="uav"><b>Events</b> <span class="soft">{len(events)} · {day(events[-1].t)}</span>'
        f'<div class="events">{rows}{more}</div></div>'
    )


def _row(event: Event, palette: Palette, seek: str) -> str:
    press = f' onpointerdown="{seek.format(event.t)}"' if seek else ""
    return (
        f'<div class="event" data-kind="{event.kind.value}" title="{stamp(event.t)}"{press}>'
        f'<span class="num soft">{moment(event.t)}</span>'
        f'<b style="color:{palette.event(event.kind)}">{MARK[event.kind]}</b><span>{escape(event.text)}</span></div>'
    )
