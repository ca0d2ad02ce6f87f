"""Read mission files of ground stations, `QGC WPL 110`: one item per line, twelve columns separated by white space.

    seq  current  frame  command  param1  param2  param3  param4  latitude  longitude  altitude  autocontinue

Source: MAVLink developer guide, "Mission plain-text file format".
"""

from math import isfinite
from pathlib import Path

from fleet.contract import MAX_ITEMS, Item

_HEADER = "QGC WPL 110"
_COLUMNS = 12
_MAX_BYTES = 1 << 20


def read_waypoints(path: Path) -> tuple[Item, ...]:
    """Read a mission file.

    Raises:
        ValueError: if it is not a mission file, or a line is invalid; the message names the line.
    """
    with path.open("rb") as file:
        text = file.read(_MAX_BYTES + 1).decode(errors="replace")
    lines = [line.strip() for line in text.splitlines()]
    if not lines or " ".join(lines[0].lstrip("\ufeff").split()) != _HEADER:
        first_line = lines[0][:40] if lines else "nothing"
        raise ValueError(
            f"{path.name}: found {first_line!r} in the first line, expected {_HEADER!r}; save the mission as waypoints"
        )
    items = tuple(
        _item(path.name, number, line) for number, line in enumerate(lines[1:], start=2) if line and line[0] != "#"
    )
    if not items or len(items) > MAX_ITEMS:
        raise ValueError(
            f"{path.name}: found {len(items):,} items, expected 1 to {MAX_ITEMS:,}; select another mission"
        )
    return items


def _item(name: str, number: int, line: str) -> Item:
    columns = line.split()
    try:
        seq_text, _, frame_text, command_text, *numbers = columns
        p1, p2, p3, p4, lat, lon, alt, _ = map(float, numbers)
        seq, frame, command = int(seq_text), int(frame_text), int(float(command_text))
    except (ValueError, OverflowError):
        raise ValueError(
            f"{name} line {number}: found {line[:60]!r}, expected {_COLUMNS} numbers; save the mission again"
        ) from None
    if not (abs(lat) <= 90 and abs(lon) <= 180 and isfinite(alt)):
        raise ValueError(
            f"{name} line {number}: found {lat}, {lon} at {alt} m, expected a position on earth; correct it"
        )
    return Item.at((lat, lon, alt), seq=seq, frame=frame, command=command, params=(p1, p2, p3, p4))
