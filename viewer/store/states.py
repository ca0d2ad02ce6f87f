"""What is wrong with the picture as a whole, in its own words: no router, too many UAVs, a recording that is damaged.

Said above the fleet; everything that came over the bus is escaped here.
"""

from html import escape

from viewer.store.store import MAX_VEHICLES, Feed
from viewer.theme.palette import Palette

LETTERS = 300  # of a sentence from outside


class Router:
    """Since when the router has been away."""

    def __init__(self) -> None:
        self._gone: float | None = None

    def say(self, there: bool, now: float) -> str:
        """Say that it is away and for how long; empty while it is there. `now` is monotonic [s]."""
        if there:
            self._gone = None
            return ""
        self._gone = now if self._gone is None else self._gone
        return (
            f"<b>No router</b> for {now - self._gone:.0f} s: nobody answers where this viewer was told to look. "
            "What is shown is the last that came. Start <code>zenohd</code> or <code>fleet up</code>, or name another "
            "<code>--router</code>; the page goes on by itself."
        )


def notices(feed: Feed, router: str, ground: str, palette: Palette) -> str:
    """Give what is wrong, as cards; `router` is what `Router` says, `ground` what is wrong with the ground's files."""
    said = [router] if router else []
    said += [f"<b>No ground</b>: {escape(ground)}"] if ground else []
    if feed.away:
        said.append(
            f"<b>Too many UAVs</b>: {MAX_VEHICLES:,} are shown, {len(feed.away):,} more are heard and not shown. "
            "Give them a router of their own, and that a viewer of its own: <code>viewer --router</code>."
        )
    for link, sentence in list(feed.links.items()):
        head = "Recording damaged" if link.startswith("replay:") else "Link"
        said.append(f"<b>{head}</b>: {escape(sentence[:LETTERS])}")
    return "".join(
        f'<div class="uav"><div class="say" style="border-color:{palette.mismatch}">{x}</div></div>' for x in said
    )
