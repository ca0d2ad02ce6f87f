"""The table of mission commands: complete, in agreement with the code; every row names its test or assumption."""

import re

import pytest
from conftest import ROOT
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Item
from fleet.frames import Origin
from fleet.mission import KINDS, LEG_NAMES, unroll_route
from fleet.mission_jumps import JUMP_TAG, JUMPS, LAND_START

PAGE = (ROOT / "docs/mission-commands.md").read_text()
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S))
ROUTE, NO_EFFECT = "Commands that shape the route", "Commands without effect on the path"
ARDUPLANE = (
    *(16, 17, 18, 19, 20, 21, 22, 30, 31, 36, 82, 83, 84, 85, 92, 93, 94, 112, 114, 115, 177, 178, 179, 181, 182, 183),
    *(
        184,
        188,
        189,
        191,
        194,
        195,
        197,
        201,
        202,
        203,
        205,
        206,
        207,
        208,
        210,
        211,
        212,
        213,
        215,
        216,
        217,
        218,
        222,
    ),
    *(222, 223, 531, 532, 534, 600, 601, 1000, 2000, 2001, 2500, 2501, 3000, 42600, 42702, 42703),
)
"""Commands of ArduPilot's mission storage. Source: ArduPilot, mission command list."""
PX4 = (16, 17, 19, 20, 21, 22, 31, 84, 85, 93, 4501, 42600, 211, 177, 178, 179, 183, 189, 2003, 203, 2000, 2001, 2500,
       2501, 200, 204, 205, 1000, 1001, 201, 195, 196, 197, 206, 260, 214, 530, 531, 532, 3000)  # fmt: skip
"""Commands of PX4 missions. Source: PX4, mission feasibility checks."""


def rows(section: str) -> list[list[str]]:
    lines = [line for line in SECTIONS[section].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


ALL_ROWS = [row for section in SECTIONS for row in rows(section)]
NUMBERS = {int(row[1]): row for section in (ROUTE, NO_EFFECT) for row in rows(section)}


def test_every_command_of_both_autopilots_is_listed_once_with_its_number() -> None:
    listed = [int(row[1]) for section in (ROUTE, NO_EFFECT) for row in rows(section)]
    assert len(listed) == len(set(listed))
    assert set(listed) == {*ARDUPLANE, *PX4}
    for number, row in NUMBERS.items():
        assert getattr(mav, f"MAV_CMD_{row[0]}") == number


@pytest.mark.parametrize("row", ALL_ROWS, ids=lambda row: row[0][:40])
def test_every_row_names_its_test_or_its_assumption(row: list[str]) -> None:
    tests = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", row[-1])
    assert tests or "Assumption" in row[-1]
    for path, name in tests:
        assert f"def {name}(" in (ROOT / path).read_text()


@pytest.mark.parametrize("number", NUMBERS)
def test_the_named_leg_is_the_one_that_is_flown(number: int) -> None:
    row = NUMBERS[number]
    leg = row[4] if len(row) == 6 else "none"
    place = {"lat_e7": 470_000_000, "lon_e7": 80_090_000, "frame": 3, "alt_m": 50.0}
    before, item = Item(seq=1, command=16, **(place | {"lon_e7": 80_030_000})), Item(seq=2, command=number, **place)
    route = unroll_route(
        [Item(seq=0, command=16, lat_e7=470_000_000, lon_e7=80_000_000), before, item],
        seq=1, origin=Origin(470_000_000, 80_000_000, 0), params={},
    )  # fmt: skip
    flown = [LEG_NAMES[int(kind)] for kind, seq in route.legs[:, [0, 8]] if seq == 2]
    names = {"LOITER_UNLIMITED": "loiter", "LOITER_TO_ALT": "loiter to altitude"}
    expected = [names.get(leg, leg.lower().replace("_", " "))] if leg.isupper() else []
    assert flown == expected
    assert (number in KINDS) == bool(expected)
    assert (leg == "order of the legs") == (number in {*JUMPS, LAND_START})
    assert number != JUMP_TAG or leg == "none"
