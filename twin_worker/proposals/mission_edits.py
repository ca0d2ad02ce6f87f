"""Kinds of mission items; insert, remove and move them: numbers and jumps of the others follow."""

from collections.abc import Sequence
from math import hypot

import msgspec
import numpy as np

from fleet import mission_legs as m
from fleet.contract import Item
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.mission_jumps import JUMP


def is_circle(item: Item) -> bool:
    """Return whether an item is a circle."""
    return m.KINDS.get(item.command) in m.CIRCLES


def is_positional(item: Item) -> bool:
    """Return whether an item is flown to: a waypoint or a circle with a position."""
    return item.command in m.KINDS and m.KINDS[item.command] != m.CHANGE_ALTITUDE and not m.is_zero_position(item)


def insert(items: Sequence[Item], new: Item) -> tuple[Item, ...]:
    """Insert an item before the one of the same number; those after it, and jumps to them, move up by one."""

    def moved(item: Item) -> Item:
        param1 = item.param1 + 1 if item.command == JUMP and item.param1 >= new.seq else item.param1
        return msgspec.structs.replace(item, seq=item.seq + (item.seq >= new.seq), param1=param1)

    return tuple(sorted((*map(moved, items), new), key=lambda item: item.seq))


def remove(items: Sequence[Item], seq: int) -> tuple[Item, ...]:
    """Leave out one item; those after it, and jumps to them, move down by one."""

    def moved(item: Item) -> Item:
        param1 = item.param1 - 1 if item.command == JUMP and item.param1 > seq else item.param1
        return msgspec.structs.replace(item, seq=item.seq - (item.seq > seq), param1=param1)

    return tuple(moved(item) for item in items if item.seq != seq)


def without_jumps(items: Sequence[Item]) -> tuple[Item, ...]:
    """Leave out all jumps, so that nothing is repeated."""
    for jump in reversed([item for item in items if item.command == JUMP]):
        items = remove(items, jump.seq)
    return tuple(items)


def move_within(item: Item, home: Origin, radius: float) -> Item:
    """Return an item moved towards home where it is farther than `radius` from it [m]."""
    offset = to_ned(home, np.array([item.lat_e7], float), np.array([item.lon_e7], float), np.zeros(1))[0]
    distance = hypot(*offset[:2])
    if distance <= radius:
        return item
    lat, lon, _ = to_geodetic(home, np.array([*(offset[:2] * radius / distance), 0.0]))
    return msgspec.structs.replace(item, lat_e7=int(lat), lon_e7=int(lon))
