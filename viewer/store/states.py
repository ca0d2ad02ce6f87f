"""Notices above the fleet list: no router, too many UAVs, damaged recording.

Received texts are escaped here.
"""

from html import escape

from viewer.store.store import MAX_VEHICLES, Feed
from viewer.theme.palette import Palette

LETTERS = 300  # characters of a received text


class Router:
    """Availability of the router."""

    def __init__(self) -> None:
        self._gone: float | None = None

    def say(self, there: bool, now: float) -> str:
        """Describe a missing router and for how long; empty while it is available. `now` is monotonic [s]."""
        if there:
            self._gone = None
            return ""
        self._gone = now if self._gone is None else self._gone
        return (
            f"<b>No router</b> for {now - self._gone:.0f} s at the configured endpoint. "
            "The page shows the last received data. Start <code>zenohd</code> or <code>fleet up</code>, or choose "
            "another <code>--router</code>; the page reconnects automatically."
        )


def notices(feed: Feed, router: str, ground: str, palette: Palette) -> str:
    """Return the notices as HTML cards; `router` and `ground` are the texts for router and terrain files."""
    said = [router] if router else []
    said += [f"<b>No ground</b>: {escape(ground)}"] if ground else []
    if feed.away:
        said.append(
            f"<b>Too many UAVs</b>: {MAX_VEHICLES:,} are shown, {len(feed.away):,} more are received and not shown. "
            "Use a second router with its own viewer: <code>viewer --router</code>."
        )
    for link, sentence in list(feed.links.items()):
        head = "Recording damaged" if link.startswith("replay:") else "Link"
        said.append(f"<b>{head}</b>: {escape(sentence[:LETTERS])}")
    return "".join(
        f'<div class="uav"><div class="say" style="border-color:{palette.mismatch}">{x}</div></div>' for x in said
    )
