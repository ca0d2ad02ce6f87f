"""Notices above the fleet list: no router, too many UAVs, damaged recording.

Received texts are escaped here.
"""

from html import escape

from viewer.store.store import MAX_VEHICLES, FleetStore
from viewer.theme.palette import Palette

MAX_TEXT = 300  # characters of a received text


def notices(store: FleetStore, ground: str, palette: Palette, now: float) -> str:
    """Return the notices as HTML cards; `ground` is the text for terrain files, `now` monotonic [s]."""
    notes = []
    if (lost_s := store.router_lost_s(now)) is not None:
        notes.append(
            f"<b>No router</b> for {lost_s:.0f} s at the configured endpoint. "
            "The page shows the last received data. Start <code>zenohd</code> or <code>fleet up</code>, or choose "
            "another <code>--router</code>; the page reconnects automatically."
        )
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
