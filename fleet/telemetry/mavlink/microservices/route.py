"""Collect the onboard mission from downloads and uploads of any ground station."""

from itertools import pairwise
from math import inf, isfinite
from typing import Any

import msgspec

from fleet.contract import MAX_ITEMS, Item, Mission
from fleet.telemetry.mavlink.microservices.learned import LearnedMission

NO_COMMAND = 0  # not a MAV_CMD; marks an invalid item
NAV_LAST = 95  # MAV_CMD_NAV_LAST: commands above it have no waypoint
DO_JUMP = 177
WAYPOINT = 16
CHECK_STRIDE, CHECK_COUNT = 10, 3  # check of a recalled mission: the first 3 of every 10 items are downloaded
TARGET_AFTER_S = 15.0  # the mission list may still arrive for this time after the first position target [s]
TARGET_CONFIRM_S = 1.0  # a target belongs to the current item when both are unchanged for this time [s]
ACCEPT_S = 3.0  # silence after which an upload without acknowledgement is accepted [s]
PARTIAL_AFTER_S = 2.0  # silence after which an incomplete list is published [s]

_NO_IDENTITY = ((0, 0), (65535, 0))  # item count and mission id where neither is reported
_MAX_ALTITUDE_M = 1e5
_MIN_HOME_MOVE_M = 1.0  # smaller changes of home are ignored [m]
_ABSOLUTE = {3: 0, 6: 5}  # MAV_FRAME: relative to home -> above sea level

_NAMES = ("MISSION_COUNT", "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_ACK", "MISSION_CLEAR_ALL", "MISSION_CURRENT")
MISSION_MESSAGES = frozenset(_NAMES)


class _MissionTransfer:
    """A mission transfer in progress, in one direction."""

    def __init__(self, count: int | None, now: float) -> None:
        self.count = count
        self.items: dict[int, Item] = {}
        self.notes: dict[int, str] = {}
        self.recalled: set[int] = set()  # items from the recalled mission
        self.last_arrival = now

    def is_complete(self) -> bool:
        return self.count is not None and all(seq in self.items for seq in range(self.count))


class MissionCollector:
    """Mission of one aircraft: transfers in both directions, accepted items, current item."""

    def __init__(self, uav: int) -> None:
        self.uav = uav
        self.items: tuple[Item, ...] = ()
        self.complete = False
        self.needs_download = True  # the mission must be downloaded again
        self.seq = -1
        self.count: int | None = None  # item count of the download in progress
        self.rejected = 0
        self.unconfirmed: set[int] = set()  # recalled items, accepted after a check of a few others
        self._recalled: tuple[Item, ...] = ()
        self._home: Item | None = None  # replaces item 0 of missions that contain home (ArduPilot)
        self._home_m: float | None = None
        self._text = ""
        self._fence: tuple[Item, ...] = ()  # as last published
        self._identity: tuple[int, int] | None = None  # reported item count and mission id
        self._transfers: dict[bool, _MissionTransfer | None] = {False: None, True: None}
        self._changed = False
        self._learned = LearnedMission()
        self._is_learned = False  # the items are from position targets
        self._target: tuple[int, int, int, int] | None = None  # current item, position [1e-7 deg], altitude [m]
        self._target_t, self._first_target_t = inf, inf

    def process(self, message: Any, *, is_upload: bool, now: float) -> None:
        """Process one mission protocol message; `is_upload` if a ground station sent it to the aircraft."""
        name = message.get_type()
        if name == "MISSION_CURRENT":
            self._set_current(message.seq)
            self._check_identity((getattr(message, "total", 0), getattr(message, "mission_id", 0)))
        elif getattr(message, "mission_type", 0) != 0:
            return  # geofence or rally points
        elif name == "MISSION_COUNT":
            self._start_transfer(message.count, is_upload, now)
        elif name in ("MISSION_ITEM", "MISSION_ITEM_INT"):
            self._add_item(message, is_upload, now)
        elif name == "MISSION_ACK" and not is_upload:
            self._finish_upload(accepted=message.type == 0)
        elif name == "MISSION_CLEAR_ALL" and is_upload:
            self.needs_download = True

    def set_items(self, items: tuple[Item, ...]) -> None:
        """Set a complete mission from an onboard log."""
        transfer = _MissionTransfer(len(items), 0.0)
        transfer.items = dict(enumerate(items))
        self._accept(transfer)

    def set_partial(self, items: tuple[Item, ...], total: int) -> None:
        """Set the known items of a mission of `total` items, 0 if unknown; the mission is complete if none is missing.

        Items after the first missing one are not predicted: nothing tells what is flown in between.
        """
        if total and [item.seq for item in items] == list(range(total)):
            self.set_items(items)
        elif items != self.items:
            self.items, self.complete, self._changed = items, False, True
            expected = f"{total}" if total else "an unknown number"
            self._set_text(
                f"found {len(items)} mission items, expected {expected}; predicted up to the last known one, "
                "name a mission file with --mission"
            )

    @property
    def needs_targets(self) -> bool:
        """Return whether no mission list is known, so that position targets are all there is."""
        return not self.complete and (not self.items or self._is_learned)

    def add_target(self, lat_e7: int, lon_e7: int, alt_m: float, now: float) -> None:
        """Learn the current item from the position the autopilot flies to, above sea level [1e-7 deg, m]."""
        self._first_target_t = min(self._first_target_t, now)
        if not (isfinite(alt_m) and abs(alt_m) < _MAX_ALTITUDE_M and (lat_e7 or lon_e7)):
            return
        target = (self.seq, lat_e7, lon_e7, round(alt_m))
        if target != self._target:
            self._target, self._target_t = target, now
        is_confirmed = now - self._target_t >= TARGET_CONFIRM_S and now - self._first_target_t >= TARGET_AFTER_S
        if not (self.needs_targets and is_confirmed and 0 <= self.seq < MAX_ITEMS):
            return
        item = Item(seq=self.seq, command=WAYPOINT, frame=0, lat_e7=lat_e7, lon_e7=lon_e7, alt_m=float(target[3]))
        if self._learned.add(item):
            self.items, self._is_learned, self._changed = self._learned.items, True, True
            self._set_text(
                f"no mission list was received; {len(self.items)} items are known from position targets, "
                "taken as waypoints; request the mission, or name a file with --mission"
            )

    def set_recalled(self, items: tuple[Item, ...]) -> None:
        """Set the previous mission; it is reused if the count and a few items are equal."""
        self._recalled = items

    def set_home_altitude(self, altitude_m: float) -> None:
        """Set the altitude of home above sea level [m], for missions without home item (PX4)."""
        if isfinite(altitude_m) and (self._home_m is None or abs(altitude_m - self._home_m) > _MIN_HOME_MOVE_M):
            self._home_m = altitude_m
            self._changed = self._changed or bool(self.items)

    def set_home(self, lat_e7: int, lon_e7: int, altitude_m: float) -> None:
        """Set home of an autopilot whose item 0 is home: until it has one, it returns zeros for item 0."""
        if not isfinite(altitude_m) or not (lat_e7 or lon_e7):
            return
        home = Item(seq=0, command=WAYPOINT, frame=0, lat_e7=lat_e7, lon_e7=lon_e7, alt_m=altitude_m)
        self._changed = self._changed or (home != self._home and bool(self.items))
        self._home = home

    @property
    def needs_home(self) -> bool:
        """Return whether item 0 has no position, and home is unknown."""
        return bool(self.items) and self._home is None and not _has_position(self.items[0])

    def missing(self) -> list[int] | None:
        """Return the missing sequence numbers of the download in progress; None without count."""
        transfer = self._transfers[False]
        if transfer is None or transfer.count is None:
            return None
        return [seq for seq in range(transfer.count) if seq not in transfer.items]

    def abort_download(self) -> None:
        """Discard a stalled download; the mission must be requested again."""
        self._transfers[False], self.needs_download = None, True

    def take_update(self, now: float, fence: tuple[Item, ...] = ()) -> Mission | None:
        """Return the mission with the fence items on board if either has changed."""
        upload, download = self._transfers[True], self._transfers[False]
        if upload is not None and upload.is_complete() and now - upload.last_arrival > ACCEPT_S:
            self._finish_upload(accepted=True)
        if download is not None and now - download.last_arrival > PARTIAL_AFTER_S and not self.complete:
            self._publish_partial(download)
        fence = fence if self.items or self.complete else self._fence  # no fence without a mission list
        if not self._changed and fence == self._fence:
            return None
        self._changed, self._fence = False, fence
        sentence = f"uav-{self.uav}: {self._text}" if self._text else ""
        return Mission(
            uav=self.uav,
            t=now,
            items=self.published_items,
            fence=fence,
            seq=self.seq,
            complete=self.complete,
            sentence=sentence,
        )

    @property
    def published_items(self) -> tuple[Item, ...]:
        """Return the items as published: above sea level where home is known, item 0 of ArduPilot replaced by home."""
        items = self.items if self._home_m is None else tuple(_absolute(item, self._home_m) for item in self.items)
        if self._home is not None and items and items[0].seq == 0:
            items = (self._home, *items[1:])
        return items

    def _set_current(self, seq: int) -> None:
        seq = -1 if seq == 65535 else seq
        if seq != self.seq:
            self.seq = seq
            self._changed = self._changed or self.complete or bool(self.items)

    def _check_identity(self, identity: tuple[int, int]) -> None:
        """Request a download if the reported item count or mission id is not that of the last report."""
        if identity in _NO_IDENTITY:
            return
        known, self._identity = self._identity, identity
        if known is not None and known != identity:
            self.mark_replaced()

    def mark_replaced(self) -> None:
        """Request a download: the autopilot reports that it received another mission."""
        self._transfers[False] = None  # the download is of the replaced mission
        self.needs_download = True

    def _start_transfer(self, count: int, is_upload: bool, now: float) -> None:
        if count > MAX_ITEMS:
            self.rejected += 1
            self._set_text(f"found a mission of {count} items, expected at most {MAX_ITEMS}; shorten it")
            return
        transfer = self._transfers[is_upload]
        if transfer is None or transfer.count != count:
            transfer = self._transfers[is_upload] = _MissionTransfer(count, now)
            if not is_upload and count == len(self._recalled):
                transfer.items = {item.seq: item for item in self._recalled if item.seq % CHECK_STRIDE >= CHECK_COUNT}
                transfer.recalled = set(transfer.items)
        if count == 0 and not is_upload:
            self._accept(transfer)

    def _add_item(self, message: Any, is_upload: bool, now: float) -> None:
        transfer = self._transfers[is_upload]
        if transfer is None and not is_upload and self.complete and message.get_type() == "MISSION_ITEM_INT":
            return self._check_item(message)
        if transfer is None:
            transfer = self._transfers[is_upload] = _MissionTransfer(None, now)
        limit = MAX_ITEMS if transfer.count is None else transfer.count
        if message.seq >= limit:
            self.rejected += 1
            return
        item, note = read_item(message)
        self.rejected += bool(note)
        if transfer.recalled and item != self._recalled[item.seq]:
            transfer.items = {seq: existing for seq, existing in transfer.items.items() if seq not in transfer.recalled}
            transfer.recalled, self._recalled = set(), ()
        transfer.recalled.discard(item.seq)
        transfer.items[item.seq], transfer.last_arrival = item, now
        transfer.notes.pop(item.seq, None)
        if note:
            transfer.notes[item.seq] = note
        if not is_upload and item.seq == 0:
            self._update_home(item)
        if not is_upload and transfer.is_complete():
            self._accept(transfer)

    def _update_home(self, item: Item) -> None:
        """Update a known home with item 0 as the autopilot reports it."""
        if self._home is not None and item.command == WAYPOINT and item.frame == 0:
            self.set_home(item.lat_e7, item.lon_e7, item.alt_m)

    def _check_item(self, message: Any) -> None:
        """Compare one item with the complete mission; request a download if it differs."""
        expected = self.items[message.seq : message.seq + 1]
        if message.seq == 0 and expected and self._home is not None:  # home moves, the mission is the same
            self._update_home(read_item(message)[0])
            self.unconfirmed.discard(0)
        elif expected == (read_item(message)[0],):
            self.unconfirmed.discard(message.seq)
        elif expected:
            self.needs_download = True

    def _finish_upload(self, accepted: bool) -> None:
        transfer, self._transfers[True] = self._transfers[True], None
        if accepted:
            if transfer is not None and transfer.is_complete():
                self._accept(transfer)
            self._transfers[False] = None  # the download is of the replaced mission
            self.needs_download = True  # the autopilot may change items, e.g. home; download again

    def _accept(self, transfer: _MissionTransfer) -> None:
        items = tuple(transfer.items[seq] for seq in range(transfer.count or 0))
        text = "; ".join([*transfer.notes.values(), *mission_problems(items)][:4])
        if items != self.items or not self.complete or text != self._text:
            self.items, self.complete, self._text = items, True, text
            self._changed = True
        self._transfers[False] = self._transfers[True] = None
        self._is_learned = False
        self.needs_download, self.unconfirmed, self._recalled = False, transfer.recalled, ()

    def _publish_partial(self, transfer: _MissionTransfer) -> None:
        self._is_learned = False
        items = tuple(transfer.items[seq] for seq in sorted(transfer.items))
        if items and items != self.items:
            self.items = items
            total = "an unknown number of" if transfer.count is None else transfer.count
            self._set_text(f"{len(items)} of {total} mission items arrived; request the mission again")

    def _set_text(self, text: str) -> None:
        self._changed = self._changed or text != self._text
        self._text = text


def _has_position(item: Item) -> bool:
    return item.lat_e7 != 0 or item.lon_e7 != 0


def _absolute(item: Item, home_m: float) -> Item:
    if item.frame not in _ABSOLUTE:
        return item
    return msgspec.structs.replace(item, frame=_ABSOLUTE[item.frame], alt_m=item.alt_m + home_m)


def read_item(message: Any) -> tuple[Item, str]:
    """Parse MISSION_ITEM or MISSION_ITEM_INT; an item with a non-finite coordinate gets command 0."""
    scale = 1.0 if message.get_type() == "MISSION_ITEM_INT" else 1e7
    params = [message.param1, message.param2, message.param3, message.param4]
    coordinates = [message.x * scale, message.y * scale, float(message.z)]
    note = ""
    command = message.command
    if not all(map(isfinite, coordinates)) or abs(coordinates[0]) > 2**31 or abs(coordinates[1]) > 2**31:
        note = f"mission item {message.seq} has an invalid coordinate and is ignored; upload it again"
        command, coordinates = NO_COMMAND, [0.0, 0.0, 0.0]
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
        lat_e7=round(coordinates[0]),
        lon_e7=round(coordinates[1]),
        alt_m=coordinates[2],
    )
    return item, note


def mission_problems(items: tuple[Item, ...]) -> list[str]:
    """Return the problems of a mission: no items, endless jumps, legs of zero length."""
    if not items:
        return ["the mission has no items; upload one"]
    problems = [f"jump of item {n} never reaches a waypoint; upload another target" for n in _endless_jumps(items)]
    waypoints = [item for item in items[1:] if item.command == WAYPOINT and (item.lat_e7 or item.lon_e7)]
    for start, end in pairwise(waypoints):
        if (start.lat_e7, start.lon_e7, start.alt_m) == (end.lat_e7, end.lon_e7, end.alt_m):
            problems.append(f"the leg from item {start.seq} to {end.seq} has no length")
    return problems


def _endless_jumps(items: tuple[Item, ...]) -> list[int]:
    """Return the sequence numbers of jumps that never reach a waypoint: a loop, or a target that does not exist."""
    by_seq = {item.seq: item for item in items}
    endless = []
    for jump in (item for item in items if item.command == DO_JUMP):
        seq, visited = int(jump.param1), {jump.seq}
        while (item := by_seq.get(seq)) is not None and seq not in visited and item.command > NAV_LAST:
            visited.add(seq)
            seq = int(item.param1) if item.command == DO_JUMP else seq + 1
        if item is None or seq in visited:
            endless.append(jump.seq)
    return endless
