"""A third-party autopilot on its own physics, plain telemetry: changes named, nominal flights left in peace."""

from itertools import islice
from pathlib import Path

import pytest

from tests.support.left_out import left_out
from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.data.card import read_card
from twin_worker.diagnosis.data.flight import FlightData, read_flights
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.share import diagnose_all

pytestmark = pytest.mark.recordings
CARD = read_card(Path("skywalker"))
MULTI = "s10_multi3_nominal"
ZERO_S = 2.045  # boot time of each flight's first attitude [s]
CHANGED = {  # flight -> truth: effect, number, value, boot time of the change [s] or None from the start
    "s04_wind_step": ("wind_steady", "speed_mps", 9.0, 266.2),
    "s05_engine_75": ("thrust_loss", "loss", 0.30, 246.08),
    "s06_drag_up": ("drag_increase", "dCD", 0.06, None),
    "s07_servo_slow": ("actuator_lag", "tau_s", 0.25, 236.14),
    "s08_airspeed_ratio": ("airspeed_scale", "scale", (1.99 / 2.6) ** 0.5, 216.12),
}


@pytest.fixture(scope="module")
def sitl(recordings: Path) -> Path:
    return recordings / "sitl"


@pytest.fixture(scope="module")
def nominal(sitl: Path) -> list[FlightData]:
    return [f for path in sorted(sitl.glob("s0[123]*.tlog.xz")) for f in read_flights(path, CARD)]


@pytest.fixture(scope="module")
def base(nominal: list[FlightData]) -> Baseline:
    return calibrate(nominal, CARD)


@pytest.fixture(scope="module")
def reports(sitl: Path, base: Baseline) -> dict[str, Report]:
    files = [sitl / f"{name}.tlog.xz" for name in (*CHANGED, MULTI)]
    return {one.flight: one for found, _ in diagnose_all(files, base, 1, print) for one in found}


@pytest.mark.parametrize("name", CHANGED)
def test_a_change_in_flight_is_named_sized_and_dated(name: str, reports: dict[str, Report]) -> None:
    effect, number, truth, boot = CHANGED[name]
    report = reports[name]
    assert report.outcome is ReportOutcome.NAMED and len(report.findings) == 1, report.sentence
    found = report.findings[0]
    assert found.hypothesis.effect.name == effect and len(found.rivals) <= 2, report.sentence
    off = abs(found.reported[number] - truth) / (1.0 - truth if effect == "airspeed_scale" else truth)
    assert off <= 0.10, report.sentence
    assert report.fit_after < 0.97 * report.fit_before or report.force_after < 0.9 * report.force_before
    if boot is not None:
        assert abs(found.segments[0][0] - (boot - ZERO_S)) <= 1.5, report.sentence
    assert any("accelerometer at 5 Hz" in word for word in report.limitations)


def test_three_nominal_aircraft_of_one_recording_are_left_in_peace(reports: dict[str, Report]) -> None:
    found = [report for name, report in reports.items() if name.startswith(MULTI)]
    assert len(found) == 3
    for report in found:
        assert report.outcome is ReportOutcome.NONE, report.sentence


def test_nominal_flights_left_out_are_not_named(nominal: list[FlightData]) -> None:
    for report in islice(left_out(nominal, CARD), 1):
        assert report.outcome in (ReportOutcome.NONE, ReportOutcome.SUSPECTED), report.sentence


# --- airspeed concealed --------------------------------------------------------------------------------------------

WITHOUT_AIRSPEED = {
    "s04_wind_step": ("wind_steady", "speed_mps", 9.0, 0.2),
    "s05_engine_75": ("thrust_loss", "loss", 0.30, 0.1),
}


@pytest.fixture(scope="module")
def stack(sitl: Path, base: Baseline) -> dict[str, Report]:
    files = [sitl / f"{name}.tlog.xz" for name in (*WITHOUT_AIRSPEED, "s08_airspeed_ratio")]
    told = diagnose_all(files, base, 1, print, ("airspeed", "wind", "battery"))
    return {one.flight: one for found, _ in told for one in found}


@pytest.mark.parametrize("name", WITHOUT_AIRSPEED)
def test_without_airspeed_the_change_is_named_and_sized_all_the_same(name: str, stack: dict[str, Report]) -> None:
    effect, number, truth, within = WITHOUT_AIRSPEED[name]
    report = stack[name]
    assert report.outcome is ReportOutcome.NAMED and "concealed: airspeed, wind, battery" in report.limitations, (
        report.sentence
    )
    (found,) = report.findings
    assert found.hypothesis.effect.name == effect and len(found.rivals) <= 2, report.sentence
    assert abs(found.reported[number] - truth) <= within * truth, report.sentence


def test_a_fault_of_the_concealed_sensor_is_not_invented(stack: dict[str, Report]) -> None:
    assert stack["s08_airspeed_ratio"].outcome is ReportOutcome.NONE, stack["s08_airspeed_ratio"].sentence
