"""Notices above the fleet list: no router, too many UAVs, damaged recording.

Received texts are escaped here.
"""

from html import escape

from viewer.store.store import MAX_VEHICLES, FleetStore
from viewer.theme.palette import Palette

MAX_TEXT = 300  # characters of a received text


class RouterStatus:
    """Availability of the router."""

    def __init__(self) -> None:
        self._lost_since: float | None = None

    def describe(self, available: bool, now: float) -> str:
        """Describe a missing router and for how long; empty while it is available. `now` is monotonic [s]."""
        if available:
            self._lost_since = None
            return ""
        self._lost_since = now if self._lost_since is None else self._lost_since
        return (
            f"<b>No router</b> for {now - self._lost_since:.0f} s at the configured endpoint. "
            "The page shows the last received data. Start <code>zenohd</code> or <code>fleet up</code>, or choose "
            "another <code>--router</code>; the page reconnects automatically."
        )


def notices(store: FleetStore, router: str, ground: str, palette: Palette) -> str:
    """Return the notices as HTML cards; `router` and `ground` are the texts for router and terrain files."""
    notes = [router] if router else []
    notes += [f"<b>No ground</b>: {escape(ground)}"] if ground else []
    if store.rejected_uavs:
        notes.append(
            f"<b>Too many UAVs</b>: {MAX_VEHICLES:,} are shown, {len(store.rejected_uavs):,} more are "
            "received and not shown. "
            "Use a second router with its own viewer: <code>viewer --router</code>."
        )
    for link, sentence in list(store.links.items()):
        head = "Recording damaged" if link.startswith("replay:") else "Link"
        notes.append(f"<b>{head}</b>: {escape(sentence[:MAX_TEXT])}")
    return "".join(
        f'<div class="uav"><div class="say" style="border-color:{palette.mismatch}">{x}</div></div>' for x in notes
    )
