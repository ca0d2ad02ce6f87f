"""Missions nobody should upload, by name, and a word that a prediction on them must say where it is no wonder."""

import msgspec

from fleet.contract import MAX_ITEMS, Item
from tests.support.flights import item

NAN, INF = float("nan"), float("inf")
SYDNEY = {"lat_e7": -338_700_000, "lon_e7": 1_512_100_000}
_JUMPS = [item(k, 177, param1=float(1 + (k * 7) % 999), param2=-1.0) for k in range(1, MAX_ITEMS)]


def elsewhere(seq: int, **where: int) -> Item:
    return msgspec.structs.replace(item(seq), **where)


ODD: dict[str, tuple[tuple[Item, ...], str]] = {
    "empty": ((), "mission"),
    "home alone": ((item(0),), "nothing to fly"),
    "home alone far away": ((elsewhere(0, **SYDNEY),), "nothing to fly"),
    "a jump to itself": ((item(0), item(1, 177, param1=1.0, param2=-1.0)), "jump loop"),
    "jumps for ever": ((item(0), item(1, 177, param1=2.0, param2=-1.0), item(2, 177, param1=1.0, param2=-1.0)), "jump"),
    "a thousand jumps": ((item(0), *_JUMPS), "jump loop"),
    "a waypoint behind a thousand jumps": ((item(0), *_JUMPS[:-1], item(999, north=500.0)), ""),
    "a jump to nowhere": ((item(0), item(1, 177, param1=NAN, param2=INF), item(2, north=300.0)), "found jump to nan"),
    "no length": ((item(0), *(item(k, north=100.0) for k in range(1, 9))), "zero length"),
    "a thousand legs of no length": ((item(0), *(item(k, north=100.0) for k in range(1, MAX_ITEMS))), "zero length"),
    "a loiter for ever": ((item(0), item(1, 17, north=100.0, param3=50.0)), ""),
    "a loiter of no number": ((item(0), item(1, 17, north=100.0, param3=NAN)), ""),
    "a loiter of no radius": ((item(0), item(1, 17, north=100.0, param3=1e-9)), ""),
    "a loiter round the sun": ((item(0), item(1, 17, north=100.0, param3=1.5e11)), ""),
    "turns without end": ((item(0), item(1, 18, north=100.0, param1=INF, param3=30.0), item(2)), ""),
    "a billion turns": ((item(0), item(1, 18, north=100.0, param1=1e9, param3=1.0), item(2)), ""),
    "another continent": ((item(0), elsewhere(1, **SYDNEY), item(2)), "km from the previous point"),
    "the pole": ((item(0), elsewhere(1, lat_e7=900_000_000), item(2)), "km from the previous point"),
    "no place on earth": ((item(0), elsewhere(1, lat_e7=2**62, lon_e7=-(2**62)), item(2)), "latitude"),
    "no number": ((item(0), item(1, param1=NAN, param2=INF, param3=NAN, param4=NAN, alt_m=NAN)), "altitude nan"),
    "light speed": ((item(0), item(1, 178, param2=3e8), item(2, north=900.0)), "a speed of 3e+08"),
    "a snail": ((item(0), item(1, 178, param2=1e-3), item(2, north=900.0)), ""),
    "the edge of space": ((item(0), item(1, north=900.0, alt_m=9e4)), ""),
    "the middle of the earth": ((item(0), item(1, north=900.0, alt_m=-9e4)), ""),
    "commands nobody knows": ((item(0), item(1, 2**60), item(2, 94, north=900.0)), "command 94"),
    "numbers with gaps": ((item(7), item(3), item(900, north=50.0)), "download the mission again"),
    "a thousand waypoints": (tuple(item(k, north=300.0 * (k % 2), east=20.0 * k) for k in range(MAX_ITEMS)), ""),
}
"""Name -> items, and what is said of them."""
