"""Collect the onboard mission from downloads and uploads of any ground station."""

from itertools import pairwise
from math import isfinite
from typing import Any

import msgspec

from fleet.contract import MAX_ITEMS, Item, Mission

NOTHING = 0  # not a MAV_CMD; marks an invalid item
NAV_LAST = 95  # MAV_CMD_NAV_LAST: commands above it have no waypoint
DO_JUMP = 177
WAYPOINT = 16
SPOT, FIRST = 10, 3  # check of a recalled mission: the first 3 of every 10 items are downloaded
ACCEPT_S = 3.0  # silence after which an upload without acknowledgement is accepted [s]
SETTLE_S = 2.0  # silence after which an incomplete list is published [s]

_MOVED_M = 1.0  # smaller changes of home are ignored [m]
_ABSOLUTE = {3: 0, 6: 5}  # MAV_FRAME: relative to home -> above sea level

_NAMES = ("MISSION_COUNT", "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_ACK", "MISSION_CLEAR_ALL", "MISSION_CURRENT")
MESSAGES = frozenset(_NAMES)


class _Draft:
    """A mission transfer in progress, in one direction."""

    def __init__(self, count: int | None, now: float) -> None:
        self.count = count
        self.items: dict[int, Item] = {}
        self.notes: dict[int, str] = {}
        self.guessed: set[int] = set()  # items from the recalled mission
        self.heard = now

    def whole(self) -> bool:
        return self.count is not None and all(seq in self.items for seq in range(self.count))


class RouteBook:
    """Mission of one aircraft: transfers in both directions, accepted items, current item."""

    def __init__(self, uav: int) -> None:
        self.uav = uav
        self.items: tuple[Item, ...] = ()
        self.complete = False
        self.stale = True  # the mission must be downloaded again
        self.seq = -1
        self.count: int | None = None  # item count of the download in progress
        self.rejected = 0
        self.unproven: set[int] = set()  # recalled items, accepted after a check of a few others
        self._recalled: tuple[Item, ...] = ()
        self._home_m: float | None = None
        self._sentence = ""
        self._drafts: dict[bool, _Draft | None] = {False: None, True: None}
        self._changed = False

    def hear(self, message: Any, *, up: bool, now: float) -> None:
        """Process one mission protocol message; `is_upload` if a ground station sent it to the aircraft."""
        name = message.get_type()
        if name == "MISSION_CURRENT":
            self._in_force(message.seq)
        elif getattr(message, "mission_type", 0) != 0:
            return  # geofence or rally points
        elif name == "MISSION_COUNT":
            self._open(message.count, up, now)
        elif name in ("MISSION_ITEM", "MISSION_ITEM_INT"):
            self._write(message, up, now)
        elif name == "MISSION_ACK" and not up:
            self._settle(accepted=message.type == 0)
        elif name == "MISSION_CLEAR_ALL" and up:
            self.stale = True

    def adopt(self, items: tuple[Item, ...]) -> None:
        """Set a complete mission from an onboard log."""
        draft = _Draft(len(items), 0.0)
        draft.items = dict(enumerate(items))
        self._adopt(draft)

    def recall(self, items: tuple[Item, ...]) -> None:
        """Set the previous mission; it is reused if the count and a few items are equal."""
        self._recalled = items

    def place_home(self, altitude_m: float) -> None:
        """Set the altitude of home above sea level [m], for missions without home item (PX4)."""
        if isfinite(altitude_m) and (self._home_m is None or abs(altitude_m - self._home_m) > _MOVED_M):
            self._home_m = altitude_m
            self._changed = self._changed or bool(self.items)

    def missing(self) -> list[int] | None:
        """Return the missing sequence numbers of the download in progress; None without count."""
        draft = self._drafts[False]
        if draft is None or draft.count is None:
            return None
        return [seq for seq in range(draft.count) if seq not in draft.items]

    def drop_download(self) -> None:
        """Discard a stalled download; the mission must be requested again."""
        self._drafts[False], self.stale = None, True

    def take(self, now: float) -> Mission | None:
        """Return the mission if it has changed."""
        up, down = self._drafts[True], self._drafts[False]
        if up is not None and up.whole() and now - up.heard > ACCEPT_S:
            self._settle(accepted=True)
        if down is not None and not self.complete and down.items and now - down.heard > SETTLE_S:
            self._show_part(down)
        if not self._changed:
            return None
        self._changed = False
        sentence = f"uav-{self.uav}: {self._sentence}" if self._sentence else ""
        items = self.items if self._home_m is None else tuple(_absolute(i, self._home_m) for i in self.items)
        return Mission(uav=self.uav, t=now, items=items, seq=self.seq, complete=self.complete, sentence=sentence)

    def _in_force(self, seq: int) -> None:
        seq = -1 if seq == 65535 else seq
        if seq != self.seq:
            self.seq = seq
            self._changed = self._changed or self.complete or bool(self.items)

    def _open(self, count: int, up: bool, now: float) -> None:
        if count > MAX_ITEMS:
            self.rejected += 1
            self._say(f"found a mission of {count} items, expected at most {MAX_ITEMS}; shorten it")
            return
        draft = self._drafts[up]
        if draft is None or draft.count != count:
            draft = self._drafts[up] = _Draft(count, now)
            if not up and count == len(self._recalled):
                draft.items = {item.seq: item for item in self._recalled if item.seq % SPOT >= FIRST}
                draft.guessed = set(draft.items)
        if count == 0 and not up:
            self._adopt(draft)

    def _write(self, message: Any, up: bool, now: float) -> None:
        draft = self._drafts[up]
        if draft is None and not up and self.complete and message.get_type() == "MISSION_ITEM_INT":
            return self._compare(message)
        if draft is None:
            draft = self._drafts[up] = _Draft(None, now)
        limit = MAX_ITEMS if draft.count is None else draft.count
        if message.seq >= limit:
            self.rejected += 1
            return
        item, note = read_item(message)
        self.rejected += bool(note)
        if draft.guessed and item != self._recalled[item.seq]:
            draft.items = {seq: known for seq, known in draft.items.items() if seq not in draft.guessed}
            draft.guessed, self._recalled = set(), ()
        draft.guessed.discard(item.seq)
        draft.items[item.seq], draft.heard = item, now
        draft.notes.pop(item.seq, None)
        if note:
            draft.notes[item.seq] = note
        if not up and draft.whole():
            self._adopt(draft)

    def _compare(self, message: Any) -> None:
        """Compare one item with the complete mission; request a download if it differs."""
        known = self.items[message.seq : message.seq + 1]
        if known == (read_item(message)[0],):
            self.unproven.discard(message.seq)
        elif known:
            self.stale = True

    def _settle(self, accepted: bool) -> None:
        draft, self._drafts[True] = self._drafts[True], None
        if accepted:
            if draft is not None and draft.whole():
                self._adopt(draft)
            self._drafts[False] = None  # the download is of the replaced mission
            self.stale = True  # the autopilot may change items, e.g. home; download again

    def _adopt(self, draft: _Draft) -> None:
        items = tuple(draft.items[seq] for seq in range(draft.count or 0))
        sentence = "; ".join([*draft.notes.values(), *review(items)][:4])
        if items != self.items or not self.complete or sentence != self._sentence:
            self.items, self.complete, self._sentence = items, True, sentence
            self._changed = True
        self._drafts[False] = self._drafts[True] = None
        self.stale, self.unproven, self._recalled = False, draft.guessed, ()

    def _show_part(self, draft: _Draft) -> None:
        items = tuple(draft.items[seq] for seq in sorted(draft.items))
        if items != self.items:
            self.items = items
            of = "an unknown number of" if draft.count is None else draft.count
            self._say(f"{len(items)} of {of} mission items arrived; request the mission again")

    def _say(self, sentence: str) -> None:
        self._changed = self._changed or sentence != self._sentence
        self._sentence = sentence


def _absolute(item: Item, home_m: float) -> Item:
    """Convert an altitude relative to home to altitude above sea level."""
    if item.frame not in _ABSOLUTE:
        return item
    return msgspec.structs.replace(item, frame=_ABSOLUTE[item.frame], alt_m=item.alt_m + home_m)


def read_item(message: Any) -> tuple[Item, str]:
    """Parse MISSION_ITEM or MISSION_ITEM_INT; an item with a non-finite coordinate gets command 0."""
    scale = 1.0 if message.get_type() == "MISSION_ITEM_INT" else 1e7
    params = [message.param1, message.param2, message.param3, message.param4]
    place = [message.x * scale, message.y * scale, float(message.z)]
    note = ""
    command = message.command
    if not all(map(isfinite, place)) or abs(place[0]) > 2**31 or abs(place[1]) > 2**31:
        note = f"mission item {message.seq} has an invalid coordinate and is ignored; upload it again"
        command, place = NOTHING, [0.0, 0.0, 0.0]
    elif not all(map(isfinite, params[:3])):
        note = f"mission item {message.seq} has a non-finite parameter, set to 0; upload it again"
    p1, p2, p3, p4 = (p if isfinite(p) else 0.0 for p in params)  # param4 = nan is legal: keep the yaw
    item = Item(
        seq=message.seq,
        command=command,
        frame=message.frame,
        param1=p1,
        param2=p2,
        param3=p3,
        param4=p4,
        lat_e7=round(place[0]),
        lon_e7=round(place[1]),
        alt_m=place[2],
    )
    return item, note


def review(items: tuple[Item, ...]) -> list[str]:
    """Return the problems of a mission: no items, endless jumps, legs of zero length."""
    if not items:
        return ["the mission has no items; upload one"]
    found = [f"jump of item {item.seq} never reaches a waypoint; upload another target" for item in _endless(items)]
    places = [item for item in items[1:] if item.command == WAYPOINT and (item.lat_e7 or item.lon_e7)]
    for a, b in pairwise(places):
        if (a.lat_e7, a.lon_e7, a.alt_m) == (b.lat_e7, b.lon_e7, b.alt_m):
            found.append(f"the leg from item {a.seq} to {b.seq} has no length")
    return found


def _endless(items: tuple[Item, ...]) -> list[Item]:
    """Return the jumps that never reach a waypoint: a loop, or a target that does not exist."""
    by_seq = {item.seq: item for item in items}
    lost = []
    for jump in (item for item in items if item.command == DO_JUMP):
        seq, seen = int(jump.param1), {jump.seq}
        while (item := by_seq.get(seq)) is not None and seq not in seen and item.command > NAV_LAST:
            seen.add(seq)
            seq = int(item.param1) if item.command == DO_JUMP else seq + 1
        if item is None or seq in seen:
            lost.append(jump)
    return lost
