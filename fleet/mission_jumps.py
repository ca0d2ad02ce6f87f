"""Jumps in a mission: DO_JUMP, DO_JUMP_TAG, DO_LAND_START, and the jumps taken so far by the reported items.

MAVLink reports the current item but not how often a jump was taken. ArduPilot sets the counter of a completed jump
back to zero, unless MIS_OPTIONS bit 3 is set; PX4 keeps it.
Source: MAVLink MAV_CMD_DO_JUMP, MAV_CMD_DO_JUMP_TAG; ArduPilot parameter MIS_OPTIONS.
"""

from collections.abc import Mapping
from math import isfinite

import numpy as np

from fleet.contract import Item

JUMP, JUMP_TAG, JUMP_TO_TAG = 177, 600, 601  # MAV_CMD: DO_JUMP, JUMP_TAG, DO_JUMP_TAG
JUMPS = (JUMP, JUMP_TO_TAG)
LAND_START = 189  # MAV_CMD: DO_LAND_START
_LAST_NAV = 95  # MAV_CMD_NAV_LAST: commands up to it are navigation items, which MISSION_CURRENT reports
_MAX_UNREPORTED = 1  # navigation items that can pass between two reports [-]
_KEEP_COUNTER = 1 << 3  # MIS_OPTIONS: the counter of a completed jump stays


def jump_target(items: Mapping[int, Item], item: Item, first: int, last: int) -> int:
    """Return the item that a jump leads to; -1 if there is none between `first` and `last`."""
    target = item.param1
    if item.command == JUMP_TO_TAG:
        tags = (seq for seq in sorted(items) if items[seq].command == JUMP_TAG and items[seq].param1 == target)
        target = next(tags, -1)
    return int(target) if first <= target <= last else -1


def repetitions(item: Item) -> float:
    """Return how often a jump is taken; negative: without end."""
    return item.param2 if isfinite(item.param2) else 0.0


def next_repeated_jump(items: Mapping[int, Item], seq: int) -> Item | None:
    """Return the next jump after an item if it ends after some repetitions; None if there is none."""
    jumps = (items[number] for number in sorted(items) if number > seq and items[number].command in JUMPS)
    jump = next(jumps, None)
    return jump if jump is not None and repetitions(jump) > 0 else None


def resets_counters(params: Mapping[str, float], first: int) -> bool:
    """Return whether the autopilot sets the counter of a completed jump to zero: ArduPilot, by default."""
    options = params.get("MIS_OPTIONS", 0.0)
    return first > 0 and not (isfinite(options) and int(options) & _KEEP_COUNTER)


def count_jumps(
    items: Mapping[int, Item], taken: Mapping[int, int], step: tuple[int, int], *, first: int, resets: bool
) -> dict[int, int]:
    """Return the jumps taken at each jump after the current item changed.

    A change that no jump explains, such as an item selected by the operator, leaves the counts; a return to the first
    navigation item starts the mission again and clears them.

    Args:
        items: mission by sequence number
        taken: jumps taken before
        step: previous and new current item
        first: number of the first item to fly
        resets: as of `resets_counters`
    """
    previous, seq = step
    for n_unreported in range(_MAX_UNREPORTED + 1):
        for inverted in (False, True):
            counts = _follow(items, dict(taken), step, (first, n_unreported, inverted), resets)
            if counts is not None:
                return counts
    nav = [number for number, item in items.items() if number >= first and 0 < item.command <= _LAST_NAV]
    return {} if nav and seq == min(nav) and previous != seq else dict(taken)


def nearest_landing(
    items: Mapping[int, Item], positions: Mapping[int, np.ndarray], point: np.ndarray, first: int
) -> int:
    """Return the DO_LAND_START nearest to a point; -1 if there is none with a position.

    Its position is that of the next navigation item if it has none of its own.

    Args:
        items: mission by sequence number
        positions: of the items, NED, (3,) [m]
        point: where the return to launch starts, NED, (3,) [m]
        first: number of the first item to fly
    """
    distances = {}
    for seq in (seq for seq, item in items.items() if item.command == LAND_START and seq >= first):
        located = (n for n in sorted(items) if n >= seq and (n == seq or 0 < items[n].command <= _LAST_NAV))
        number = next((n for n in located if items[n].lat_e7 or items[n].lon_e7), None)
        if number is not None:
            distances[seq] = float(np.hypot(*(positions[number] - point)[:2]))
    return min(distances, key=lambda seq: (distances[seq], seq), default=-1)


def _follow(
    items: Mapping[int, Item],
    counts: dict[int, int],
    step: tuple[int, int],
    limits: tuple[int, int, bool],
    resets: bool,
) -> dict[int, int] | None:
    """Follow the mission between two reported items; return the counts, or None if it does not lead there.

    Args:
        items, step, resets: as for `count_jumps`
        counts: jumps taken, changed
        limits: first item to fly, navigation items passed unreported, and whether the first jump does what its count
            does not say: the count is unknown if the mission was not observed from its start
    """
    (previous, seq), (first, n_unreported, inverted) = step, limits
    last, at, passed = max(items, default=0), previous + 1, set[int]()
    while at <= last:
        item = items.get(at)
        if item is not None and item.command in JUMPS and at not in passed:
            passed.add(at)
            target, times = jump_target(items, item, first, last), repetitions(item)
            takes = target >= 0 and (times < 0 or counts.get(at, 0) < times)
            takes, inverted = (takes != inverted and target >= 0), False
            counts[at] = counts.get(at, 0) + 1 if takes else (0 if resets else max(int(times), 0))
            at = target if takes else at + 1
            continue
        if item is not None and 0 < item.command <= _LAST_NAV:
            if at == seq:
                return counts
            if not n_unreported:
                return None
            n_unreported -= 1
        at += 1
    return None
