"""What an approved option sends to the aircraft, in words, and the person who approves it."""

import getpass
import socket

import msgspec

from fleet.contract import Change, Item, Mission, Option
from fleet.process.sanitise import printable

MAX_NUMBERS = 8  # changed items that are listed
ID_LETTERS = 8  # of the id of a proposal that are shown


def describe_changes(option: Option, missions: dict[int, Mission]) -> list[str]:
    """Return what an option sends, one line for each command."""
    return [line for change in option.changes for line in _change_lines(change, missions.get(change.uav))]


def _change_lines(change: Change, mission: Mission | None) -> list[str]:
    lines = []
    if change.items is not None:
        lines.append(f"upload a mission of {len(change.items)} items: {_difference(change.items, mission)}")
    if change.seq is not None:
        lines.append(f"fly to item {change.seq} first")
    if change.speed is not None:
        lines.append(f"change the speed to {change.speed:.1f} m/s")
    if change.mode:
        lines.append(f"change the mode: {printable(change.mode)}")
    return [f"uav-{change.uav}: {line}" for line in lines]


def _difference(items: tuple[Item, ...], mission: Mission | None) -> str:
    if mission is None:
        return "the present one is not known"
    present = {msgspec.structs.replace(item, seq=0) for item in mission.items}
    new = [item.seq for item in items if msgspec.structs.replace(item, seq=0) not in present]
    numbers = ", ".join(map(str, new[:MAX_NUMBERS])) + (" …" if len(new) > MAX_NUMBERS else "")
    return f"the present one has {len(mission.items)}, new or changed are {numbers or 'none'}"


def user_name() -> str:
    """Return the user of this process, e.g. `kim@ground-station`."""
    return f"{getpass.getuser()}@{socket.gethostname()}"
