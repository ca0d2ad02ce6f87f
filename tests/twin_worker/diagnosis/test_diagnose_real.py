"""Real flights, and channels concealed that would give the answer away: what is found without, compared afterwards."""

import tarfile
from pathlib import Path

import numpy as np
import pytest

from fleet.contract import Sample
from fleet.telemetry.recording.recordings import replay_messages
from tests.support import real_flights
from twin_worker.diagnosis import __main__ as diagnosis
from twin_worker.diagnosis.baseline import own_past as hidden
from twin_worker.diagnosis.baseline.own_past import ENERGY, OwnPast, find_tracking_loss
from twin_worker.diagnosis.baseline.past import calibrate_past, part_after, part_before
from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.diagnosis.data.flight import FlightData, read_flights
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import CHANNELS, Baseline
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.weather import fit_wind
from twin_worker.telemetry.history import TelemetryHistory

pytestmark = pytest.mark.recordings
ALFA = "alfa_20180718_155331_1_engine_failure"
BEFORE_S = 8.0  # of ALFA's streams, before the fault, are not trusted
FORWARD_S = 547.5  # on the quadplane's clock: transition done


# --- ALFA ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alfa(recordings: Path) -> FlightData:
    return read_flights(recordings / "real" / f"{ALFA}.tlog", UNKNOWN)[0]


def test_an_engine_loss_is_located_by_the_flights_own_first_90_s(alfa: FlightData, recordings: Path) -> None:
    report = OwnPast(90.0, UNKNOWN).diagnose(alfa, conceal=("throttle", "wind", "battery"))
    assert report.outcome is ReportOutcome.UNKNOWN and report.where[0] == ENERGY, report.sentence
    with tarfile.open(recordings / "real" / f"{ALFA}_csv.tar.xz") as archive:  # the label, read only now
        (label,) = [member for member in archive.getmembers() if "failure_status-engines" in member.name]
        first = archive.extractfile(label).read().split()[1]
    truth = float(first.split(b",")[0]) * 1e-9 - alfa.t_start
    assert abs(report.where[1][0][0] - truth) <= 5.0, (report.where, truth)


def test_the_engine_loss_shows_however_much_of_the_past_is_trusted(alfa: FlightData) -> None:
    found = [find_tracking_loss(alfa, until) for until in (70.0, 90.0, 110.0)]
    assert all(one is not None and one[0] == ENERGY and abs(one[1] - 116.1) <= 5.0 for one in found), found


@pytest.fixture(scope="module")
def streams(recordings: Path) -> dict[str, tuple[Report, float | None]]:
    out = {}
    for fault, flight, injected in real_flights.streams(recordings):
        until = (injected or 60.0) - BEFORE_S
        out[fault] = OwnPast(until, UNKNOWN).diagnose(flight, conceal=("throttle",)), injected
    return out


def test_where_no_surfaces_are_recorded_nothing_is_ever_named(streams: dict[str, tuple[Report, float | None]]) -> None:
    assert sorted(streams) == ["aileron", "elevator", "engine", "no", "right"]
    for report, _ in streams.values():
        assert report.outcome in (ReportOutcome.NONE, ReportOutcome.UNKNOWN) and not report.findings, report.sentence
        assert any("roll not covered" in word for word in report.limitations)


@pytest.mark.parametrize("fault", ["engine", "right"])
def test_a_lost_engine_and_a_locked_rudder_are_dated(
    fault: str, streams: dict[str, tuple[Report, float | None]]
) -> None:
    report, injected = streams[fault]
    assert report.outcome is ReportOutcome.UNKNOWN, report.sentence
    assert abs(report.where[1][0][0] - injected) <= 3.0, report.sentence


def test_without_a_fault_nothing_is_lost(streams: dict[str, tuple[Report, float | None]]) -> None:
    assert streams["no"][0].outcome is ReportOutcome.NONE, streams["no"][0].sentence


# --- Thor, the quadplane, rotors -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def thor(recordings: Path) -> FlightData:
    return real_flights.thor(recordings)


def test_a_real_flight_without_a_fault_is_left_in_peace(thor: FlightData) -> None:
    report = OwnPast(320.0, UNKNOWN).diagnose(thor)
    assert report.outcome is ReportOutcome.NONE, report.sentence


def test_wind_found_without_airspeed_foretells_the_concealed_airspeed(thor: FlightData) -> None:
    dark = hidden.conceal_channels(thor, ("airspeed",), thor)
    later = part_after(dark, 400.0)
    case = ModelledFlight(later, calibrate_past(part_before(dark, 400.0), UNKNOWN).baseline(dark))
    w = fit_wind(case, np.zeros(4))
    s = case.corrected_readings(())
    pitot = np.interp(case.t, thor.t, thor.readings["Va"])[case.ok]
    told = np.hypot(s["v_n"] - w[0], s["v_e"] - w[1])[case.ok]
    ground = np.hypot(s["v_n"], s["v_e"])[case.ok]
    assert np.std(pitot - told) < 0.45 * np.std(pitot - ground)
    assert abs(np.mean(pitot - told)) < 1.5


def test_the_quadplanes_wind_agrees_with_its_own_estimator(recordings: Path) -> None:
    path = recordings / "real" / "cuav_quadplane_20161112.tlog"
    flight = part_after(read_flights(path, UNKNOWN)[0], FORWARD_S)
    case = ModelledFlight(flight, Baseline(UNKNOWN, {}, 20.0, vane=False))
    w = fit_wind(case, np.zeros(4))
    history = TelemetryHistory(keep_s=np.inf)
    for message in replay_messages(path):  # the concealed estimate, read only now
        if isinstance(message, Sample):
            history.add(message)
    t, estimate = history.rows("wind")
    last = estimate[t > t[-1] - 10.0].mean(axis=0)
    assert np.hypot(*(w[:2] - last)) < 1.5 and np.hypot(*last) > 1.0, (w, last)


def test_rotors_are_told_from_wings(recordings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recordings / "real" / "ardupilot_mechanical_fail_quad.log"
    assert diagnosis.main([str(path), "--against-own-past", "60"]) == 0
    assert "loss of control since 90.9 s" in capsys.readouterr().out
    with pytest.raises(ValueError, match="found a multirotor, expected a fixed wing"):
        read_flights(path, UNKNOWN)


# --- concealing ------------------------------------------------------------------------------------------------------


def test_what_is_concealed_is_gone_and_commands_stand_as_usual(alfa: FlightData) -> None:
    dark = hidden.conceal_channels(alfa, ("airspeed", "throttle"), part_before(alfa, 90.0))
    assert "Va" not in dark.readings and "Va" in alfa.readings
    assert np.ptp(dark.commands[:, 3]) == 0.0 < np.ptp(alfa.commands[:, 3])
    assert (dark.commands[:, :3] == alfa.commands[:, :3]).all()
    assert dark.limitations[0] == "concealed: airspeed, throttle"


def test_an_axis_whose_command_is_concealed_is_not_judged() -> None:
    base = Baseline(UNKNOWN, {}, 20.0, r2={"X": 0.9, "L": 0.9})
    dull = hidden.exclude_concealed(base, ("throttle", "airspeed"))
    assert dull.r2 == {"X": 0.0, "L": 0.9}
    assert np.flatnonzero(dull.noise.sigma != base.noise.sigma).tolist() == [CHANNELS.index("force_x")]


def test_a_channel_there_is_none_of_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = tmp_path / "a.tlog"
    flight.touch()
    assert diagnosis.main([str(flight), "--against-own-past", "60", "--conceal", "truth"]) == 2
    assert "--conceal: found 'truth', expected names of airspeed, imu" in capsys.readouterr().err
