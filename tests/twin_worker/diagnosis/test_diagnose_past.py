"""Flights judged by their own past: changes found, nominal flights left in peace, what a past cannot tell said."""

from pathlib import Path

import numpy as np
import pytest

from twin_worker.diagnosis import __main__ as diagnosis
from twin_worker.diagnosis import learn
from twin_worker.diagnosis.baseline.own_past import OwnPast
from twin_worker.diagnosis.baseline.past import calibrate_past, part_after, part_before, split
from twin_worker.diagnosis.data.card import UNKNOWN, read_card
from twin_worker.diagnosis.data.flight import FlightData, read_flights
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.output import keep
from twin_worker.diagnosis.share import diagnose_all

pytestmark = pytest.mark.recordings
CARD = read_card(Path("skywalker"))
UNTIL_S = 130.0
ZERO_S = 2.045  # boot time of each flight's first attitude [s]
CHANGED = {  # flight -> effect and what it is not told from, boot time of the change [s]
    "s05_engine_75": ({"thrust_loss", "drag_increase"}, 246.08),
    "s07_servo_slow": ({"actuator_lag"}, 236.14),
    "s08_airspeed_ratio": ({"airspeed_scale", "airspeed_bias"}, 216.12),
}
NOMINAL = "s10_multi3_nominal"


@pytest.fixture(scope="module")
def sitl(recordings: Path) -> Path:
    return recordings / "sitl"


@pytest.fixture(scope="module")
def reports(sitl: Path) -> dict[str, Report]:
    files = [sitl / f"{name}.tlog.xz" for name in (*CHANGED, NOMINAL)]
    return {one.flight: one for found, _ in diagnose_all(files, OwnPast(UNTIL_S, CARD), 1, print) for one in found}


@pytest.fixture(scope="module")
def flight(sitl: Path) -> FlightData:
    return read_flights(sitl / "s07_servo_slow.tlog.xz", CARD)[0]


@pytest.mark.parametrize("name", CHANGED)
def test_a_change_is_named_and_dated_by_the_flights_own_past(name: str, reports: dict[str, Report]) -> None:
    effects, boot = CHANGED[name]
    report = reports[name]
    assert report.outcome is ReportOutcome.NAMED and len(report.findings) == 1, report.sentence
    found = report.findings[0]
    assert {found.hypothesis.effect.name, *found.rivals} <= effects, report.sentence
    assert abs(found.segments[0][0] - (boot - ZERO_S)) <= 1.5, report.sentence
    assert any("of its own past: effects present from the start" in word for word in report.limitations)


def test_nominal_flights_are_left_in_peace(reports: dict[str, Report]) -> None:
    nominal = [report for name, report in reports.items() if name.startswith(NOMINAL)]
    assert len(nominal) == 3
    for report in nominal:
        assert report.outcome in (ReportOutcome.NONE, ReportOutcome.SUSPECTED), report.sentence


def test_reports_say_what_would_have_been_named_and_where_that_comes_from(reports: dict[str, Report]) -> None:
    for report in reports.values():
        assert "limits of detection measured on" in report.detection_limits[-1]
        assert "reference own past" in report.detection_limits[-1]
        assert keep.as_json(report)["detection_limits"] == list(report.detection_limits)


def test_axes_the_past_does_not_foretell_are_said(reports: dict[str, Report]) -> None:
    assert any("yaw not covered" in word for word in reports["s10_multi3_nominal-uav21"].limitations)


def test_pieces_share_no_instant_and_leave_none_out(flight: FlightData) -> None:
    past = part_before(flight, UNTIL_S)
    count = np.sum([piece.ok for piece in split(past)], axis=0)
    assert (count[past.ok] == 1).all() and not count[~past.ok].any()
    assert past.t[-1] < UNTIL_S <= part_after(flight, UNTIL_S).t[0]
    assert len(past.t) + len(part_after(flight, UNTIL_S).t) == len(flight.t)


def test_the_part_to_diagnose_keeps_the_flights_clock(flight: FlightData) -> None:
    later = part_after(flight, 100.0)
    assert later.t[0] >= 100.0 and later.t_start == flight.t_start and len(later.readings["phi"]) == len(later.t)
    assert later.commands.shape == (len(later.t), 4) and later.position.shape == (len(later.t), 2)


def test_a_past_too_short_is_refused(flight: FlightData) -> None:
    with pytest.raises(ValueError, match=r"found 25 s of trusted flight before 65 s, expected 40 s at least"):
        calibrate_past(part_before(flight, 65.0), CARD)
    with pytest.raises(ValueError, match=r"found 0 s of trusted flight after 589 s.*trust a shorter past"):
        OwnPast(589.0, CARD).diagnose(flight)


def test_a_model_of_the_own_past_is_written_and_loaded(sitl: Path, tmp_path: Path) -> None:
    out = tmp_path / "own.json"
    file = str(sitl / "s02_nominal_light_wind.tlog.xz")
    assert learn.main([file, "--until", "110", "--airframe", "skywalker", "--out", str(out)]) == 0
    base, _ = keep.load(out)
    assert base.others and base.chance and base.undetermined == ("aileron", "rudder")
    assert base.envelope is None  # effects without an onset are no candidates


def test_it_is_one_thing_that_flights_are_compared_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight, model = tmp_path / "a.tlog", tmp_path / "m.json"
    flight.touch(), model.touch()
    assert diagnosis.main([str(flight), "--model", str(model), "--against-own-past", "90"]) == 2
    assert "exactly one of --model, --against, --against-own-past" in capsys.readouterr().err
    assert diagnosis.main([str(flight), "--against-own-past", "-3"]) == 2
    assert "--against-own-past: found -3" in capsys.readouterr().err


def test_a_loss_of_energy_that_a_short_past_in_moving_air_explains_is_not_named(recordings: Path) -> None:
    """No airspeed, 41 s of past, a loss in the last 16 s: six independent blocks against four coefficients."""
    (healthy,) = read_flights(recordings / "real" / "alfa_09-11-15-05-11_2_no_failure.tlog.xz", UNKNOWN)
    report = OwnPast(46.0, UNKNOWN).diagnose(healthy)
    assert report.outcome is not ReportOutcome.NAMED, report.sentence
