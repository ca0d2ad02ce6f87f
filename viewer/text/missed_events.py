"""Events during an absence of the operator; the browser stores the time of its last visit."""

import contextlib
import threading
import time
from html import escape
from typing import Any, NamedTuple

from viewer.store.received.datatime import moment
from viewer.store.vehicle import Vehicle
from viewer.text.clicks import click
from viewer.theme.events import Event, Kind
from viewer.theme.palette import MARK, Palette

KEY = "parauav-seen"  # in the local storage of the browser
AWAY_S = 5.0  # a shorter interruption is ignored [s]
LONGEST_S = 12 * 3600.0  # a longer absence lists nothing [s]
ROWS = 40
WORTH = {Kind.ALERT, Kind.MISMATCH, Kind.LOST, Kind.BACK, Kind.EASED, Kind.WARNING, Kind.NO_MODEL}


class Away(NamedTuple):
    """Absence of the operator, wall-clock time [s since 1970]."""

    left: float
    came: float


class Presence:
    """Time of the last visit of one browser."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self.away: Away | None = None
        threading.Thread(target=self._ask, name="viewer-presence", daemon=True).start()

    def _ask(self) -> None:
        with contextlib.suppress(RuntimeError, TimeoutError, ValueError):
            told, now = self._client.local_storage.get_item(KEY, timeout=10.0), time.time()
            left = float(told) if told is not None else now
            self.away = Away(left, now) if AWAY_S < now - left < LONGEST_S else None

    def here(self) -> None:
        """Store the current time in the browser."""
        self._client.local_storage.set_item(KEY, f"{time.time():.1f}")

    def seen(self) -> None:
        """Clear the absence after the operator has read its events."""
        self.away = None


def missed(fleet: list[Vehicle], away: Away) -> list[tuple[Vehicle, Event]]:
    """Return the reported events of live UAVs during an absence, newest first."""
    live = [vehicle for vehicle in fleet if not vehicle.recorded]
    found = [
        (v, event) for v in live for event in v.events if event.kind in WORTH and away.left < event.t <= away.came + 1.0
    ]
    return sorted(found, key=lambda one: -one[1].t)


def since(fleet: list[Vehicle], away: Away | None, palette: Palette, pick: str) -> str:
    """Return the missed events as HTML; empty without an absence. `pick` is the click handler with `{}`."""
    if away is None:
        return ""
    found = missed(fleet, away)
    head = f"<b>Since you left</b> <span class=soft>{moment(away.left)} to {moment(away.came)}</span>"
    rows = "".join(
        f'<div class="event pick" onpointerdown="{pick.format(click(v.uav, event.t))}">'
        f'<span class="num soft">{moment(event.t)}</span>'
        f'<b style="color:{palette.event(event.kind)}">{MARK[event.kind]}</b>'
        f"<span>{v.name} {escape(event.text)}</span></div>"
        for v, event in found[:ROWS]
    )
    more = f'<div class="soft">and {len(found) - ROWS} earlier</div>' if len(found) > ROWS else ""
    rows = rows or '<div class="soft">no events</div>'
    return f'<div class="uav">{head}<div class="events">{rows}{more}</div></div>'
