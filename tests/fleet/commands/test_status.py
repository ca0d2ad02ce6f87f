"""The table of `fleet status`: a late prediction is red, and a horizon that has passed is none."""

import math
import re

import pytest
from rich.console import Console

from fleet.commands.live.status import LATE_S, fleet_table
from fleet.contract import FleetRow, TwinState

RED = "\x1b[31m"


def printed(row: FleetRow) -> str:
    console = Console(width=200, force_terminal=True, color_system="standard")
    with console.capture() as capture:
        console.print(fleet_table([row]))
    return capture.get()


@pytest.mark.parametrize(("age_s", "red"), [(LATE_S - 0.5, False), (LATE_S + 0.5, True)])
def test_the_age_of_a_late_prediction_is_red(age_s: float, red: bool) -> None:
    row = FleetRow(uav=0, state=TwinState.PREDICTING, verdict="", horizon_s=60.0, prediction_age_s=age_s)
    text = printed(row)
    assert f"{age_s:.1f}" in text and (f"{RED}{age_s:.1f}" in text) == red


@pytest.mark.parametrize(
    ("horizon_s", "age_s", "shown"),
    [(60.0, 1.0, "60"), (60.0, None, "60"), (4.0, 4.1, "-"), (0.3, 0.0, "-"), (math.nan, 1.0, "-")],
)
def test_a_prediction_older_than_its_horizon_has_none(horizon_s: float, age_s: float | None, shown: str) -> None:
    row = FleetRow(uav=0, state=TwinState.VERIFIED, verdict="", horizon_s=horizon_s, prediction_age_s=age_s)
    assert re.sub(r"\x1b\[[0-9;]*m", "", printed(row)).splitlines()[1].split()[3] == shown
