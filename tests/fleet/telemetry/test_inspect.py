"""What `fleet inspect` says of a recording: survey, abilities, table, JSON, page, exit codes."""

import json
import subprocess
import sys

import msgspec
import numpy as np
import pytest
from conftest import exit_code

from fleet.cli import main
from fleet.commands.offline import inspect
from fleet.contract import Link, Mission, Params, Status
from fleet.process.sanitise import printable
from fleet.report.ink import downsample, mode_colours
from fleet.report.report_text import table
from fleet.telemetry.inspection.abilities import abilities
from fleet.telemetry.inspection.findings import (
    AircraftFindings,
    FileFindings,
    LinkTexts,
    compute_findings,
    merged_events,
)
from fleet.telemetry.inspection.survey import Survey, airborne, survey_recording
from fleet.telemetry.inspection.thinned import DecimatedRows, TimeInterval, overlap
from fleet.telemetry.recording.recordings import replay_messages
from tests.support import flights

T0 = flights.T0
S02, S10 = "sitl/s02_nominal_light_wind.tlog.xz", "sitl/s10_multi3_nominal.tlog.xz"
CUAV = "real/cuav_quadplane_20161112.tlog"


@pytest.fixture(scope="module")
def tlog(heard, tmp_path_factory):
    """The pretend flight as a file."""
    return tmp_path_factory.getbasetemp() / "flight.tlog"


@pytest.fixture(scope="module")
def pretended(heard) -> Survey:
    return survey_recording(heard)[1]


def lively(seconds: float = 60.0) -> flights.Laid:
    """A level turn with hands on the stick, so that every needed thing moves."""
    laid = flights.turn(seconds)
    t, x = laid["attitude"]
    swing = np.sin(0.7 * (t - T0))
    x = x + np.column_stack([0.2 * swing, 0.05 * swing, 0 * t, 0.14 * swing, 0.1 * swing, 0 * t])
    t_u, u = laid["servo"]
    u = u + 100 * np.sin(0.7 * (t_u - T0))[:, None] * np.array([1, 1, 1, 1, 0, 0, 0, 0])
    return laid | {"attitude": (t, x), "servo": (t_u, u)}


def slower(laid: flights.Laid, name: str, every: int) -> flights.Laid:
    t, x = laid[name]
    return laid | {name: (t[::every], x[::every])}


def known(laid: flights.Laid, *, vehicle: str = "fixed_wing", mode: str = "AUTO", items: int = 4, **more) -> Survey:
    """A survey of rows, and of an aircraft that says what it is."""
    status = Status(uav=1, t=T0, mode=mode, armed=True, vehicle=vehicle, autopilot="ardupilot", **more)
    mission = Mission(uav=1, t=T0, items=tuple(flights.item(n, north=200.0 * n) for n in range(items)), complete=True)
    return survey_recording([status, *([mission] if items else []), *flights.messages(laid)])[1]


def judged(of: Survey) -> dict[str, tuple[bool, str]]:
    return {one.name: (one.can, one.why) for one in abilities(of)}


# --- survey ----------------------------------------------------------------------------------------------------------


def test_a_pretend_flight_is_described(pretended):
    told = compute_findings(
        pretended, LinkTexts("ArduPlane 4.7", ((T0 + 20, 2, "Engine out"), (T0 + 21, 6, "chatter")))
    )
    assert (told.uav, told.vehicle, told.autopilot, told.firmware) == (1, "fixed_wing", "ardupilot", "ArduPlane 4.7")
    assert told.seconds == pytest.approx(100, abs=2)
    assert told.airborne_s == pytest.approx(100, abs=3)
    assert told.distance_m == pytest.approx(23 * 100, rel=0.2)
    assert {mode.mode for mode in told.modes} == {"AUTO"}
    assert told.rows["attitude"].rate_hz == pytest.approx(25, rel=0.1)
    assert told.mission.items > 3
    assert told.mission.complete
    assert told.missed > 0
    assert {servo.surface for servo in told.servos if servo.moves} >= {"aileron", "elevator", "throttle"}
    assert 15 < told.airspeed.median < 30
    texts = [event.text for event in told.events if event.kind == "text"]
    assert "Engine out" in texts
    assert "chatter" not in texts
    assert {can.name for can in told.abilities if not can.can} == set()


def test_events_are_told_once_and_in_time():
    said = [
        Status(uav=1, t=T0, mode="MANUAL"),
        Params(uav=1, t=T0 + 1, values={"A": 1.0, "STAT_RUNTIME": 1.0}),
        Status(uav=1, t=T0 + 2, mode="AUTO", armed=True),
        Params(uav=1, t=T0 + 3, values={"A": 2.0, "B": 5.0, "STAT_RUNTIME": 2.0}),
        *flights.messages(flights.turn(1.0)),
        Status(uav=1, t=T0 + 9, mode="AUTO", armed=True, link=Link.LOST, sentence="uav-1: no message for 8 s"),
        Status(uav=1, t=T0 + 10, mode="AUTO", armed=True, clock_jumps=1, sentence="uav-1: PreArm: no GPS"),
        flights.sample(1, T0 + 11, leg=(np.array([T0 + 11]), np.array([[2.0]]))),
        Status(uav=1, t=T0 + 12, mode="AUTO", armed=False),
    ]
    one = survey_recording(said)[1]
    told = [(event.kind, event.text) for event in merged_events(one, LinkTexts())]
    assert told.count(("text", "PreArm: no GPS")) == 1
    assert [(kind, text) for kind, text in told if kind == "parameter"] == [("parameter", "A 1 to 2")]
    assert [kind for kind, _ in told if kind in ("mode", "armed", "link", "clock", "disarmed")] == [
        *("mode", "armed", "mode"),
        *("link", "clock", "link", "disarmed"),
    ]
    assert [text for kind, text in told if kind == "item"] == ["item 1", "item 2"]
    assert ("gap", "no row for 10.0 s") in told
    texts = ((T0 + 10, 2, "PreArm: no GPS"),)
    assert [e.kind for e in merged_events(one, LinkTexts("", texts))].count("text") == 1


def test_a_glider_on_the_ground_never_flew():
    assert airborne(known(flights.turn(30, Va=2.0))) == []


def test_rows_that_do_not_fit_the_contract_are_counted():
    bad = flights.sample(1, T0, attitude=(np.array([T0]), np.zeros((1, 3))))
    assert survey_recording([bad])[1].rejected_fields == 1


def test_thinned_rows_keep_rates_gaps_and_stretches():
    t = np.arange(0.0, 1000.0, 0.05)
    t = t[(t < 200) | (t > 210)]
    whole, thin = DecimatedRows(0.5), DecimatedRows(0.5, max_rows=500)
    for part in np.array_split(t, 77):
        for each in (whole, thin):
            each.add(T0 + part, part[:, None])
    for each in (whole, thin):
        assert each.rate_hz == pytest.approx(20, rel=1e-3)
        (gap,) = each.gaps()
        assert gap.start - T0 == pytest.approx(200, abs=0.1)
        assert gap.seconds == pytest.approx(10, abs=0.1)
        assert [round(span.seconds) for span in each.stretches()] == [200, 790]
    kept, x = thin.rows()
    assert len(kept) == len(x) <= 500
    assert np.ptp(np.diff(kept)[np.diff(kept) < 5]) < 1e-5
    np.testing.assert_allclose(kept - T0, x[:, 0], atol=1e-4)


def test_overlaps_of_spans():
    a, b = [TimeInterval(0, 10), TimeInterval(20, 30)], [TimeInterval(5, 22), TimeInterval(25, 26)]
    assert overlap(a, b) == [TimeInterval(5, 10), TimeInterval(20, 22), TimeInterval(25, 26)]


# --- the command -----------------------------------------------------------------------------------------------------


def told_by(args: list[str], capsys) -> tuple[int, dict]:
    code = main(["inspect", *map(str, args), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_table_json_and_page_of_one_file(tlog, tmp_path, capsys):
    page, answer = tmp_path / "page.png", tmp_path / "told.json"
    assert main(["inspect", str(tlog), "--json", str(answer), "--plot", str(page)]) == 0
    assert "uav-1" in capsys.readouterr().out
    (file,) = json.loads(answer.read_text())["files"]
    assert file["aircraft"][0]["uav"] == 1
    from PIL import Image

    with Image.open(page) as image:
        assert min(image.size) > 1000
        assert len(image.convert("RGB").getcolors(1 << 24) or ()) > 200  # ink of many colours, no blank sheet


@pytest.mark.parametrize("suffix", [".svg", ".pdf"])
def test_pages_for_printing(pretended, tmp_path, suffix):
    from fleet.report.inspection_page import ReportPage, write

    told = compute_findings(pretended, LinkTexts())
    sheets = [ReportPage(pretended, told, LinkTexts(), "a$b_{x.tlog")] * 2
    made = write(tmp_path / f"page{suffix}", sheets)
    assert len(set(made)) == (1 if suffix == ".pdf" else 2)
    assert all(path.stat().st_size > 20_000 for path in made)


def test_a_page_is_drawn_of_an_aircraft_that_said_next_to_nothing(tmp_path):
    from fleet.report.inspection_page import ReportPage, write

    silent = survey_recording([Status(uav=1, t=T0, mode="")])[1]
    told = compute_findings(silent, LinkTexts())
    assert told.wind is None
    (made,) = write(tmp_path / "page.png", [ReportPage(silent, told, LinkTexts(), "silent.tlog")])
    assert made.stat().st_size > 10_000


def test_the_keys_of_the_json_are_stable(tlog, capsys):
    code, told = told_by([tlog], capsys)
    assert code == 0
    (file,) = told["files"]
    assert set(file) == {"file", "bytes", "sentences", "aircraft", "twin"}
    assert set(file["aircraft"][0]) >= {
        *("uav", "vehicle", "autopilot", "firmware", "begun", "seconds", "airborne_s", "distance_m", "altitude_m"),
        *("received", "missed", "rejected", "clock_jumps", "modes", "rows", "mission", "params", "params_complete"),
        *("servo_map", "servos", "airspeed", "wind", "events", "events_lost", "abilities"),
    }
    assert set(file["aircraft"][0]["rows"]["attitude"]) == {"rows", "rate_hz", "gaps", "gap_s", "longest"}
    assert set(file["aircraft"][0]["abilities"][0]) == {"name", "can", "why"}
    assert msgspec.convert(file, FileFindings).aircraft[0].uav == 1
    explained = inspect.describe_keys()
    assert all(f"    {name}" in explained for name in AircraftFindings.__struct_fields__)


def test_damage_is_said_and_the_other_files_are_still_shown(tlog, tmp_path, capsys):
    damaged, empty = tmp_path / "damaged.tlog", tmp_path / "empty.tlog"
    raw = tlog.read_bytes()
    damaged.write_bytes(raw[: len(raw) // 2] + b"\xfe" * 3_000 + raw[len(raw) // 2 : -11])
    empty.write_bytes(b"")
    code, told = told_by([damaged, empty, tlog], capsys)
    assert code == 1
    first, second, third = told["files"]
    assert "damaged bytes skipped" in first["sentences"][0]
    assert first["aircraft"][0]["seconds"] > 90
    assert "is empty" in second["sentences"][0]
    assert second["aircraft"] == []
    assert third["sentences"] == []


def test_a_file_of_another_kind_is_refused_in_a_sentence(tmp_path, capsys):
    other = tmp_path / "holiday.jpg"
    other.write_bytes(b"\xff\xd8")
    code, told = told_by([other], capsys)
    assert code == 1
    assert told["files"][0]["sentences"]


@pytest.mark.parametrize(
    "args", [[], ["missing.tlog"], ["{tlog}", "--plot", "a.bmp"], ["{tlog}", "--json", "no/where"]]
)
def test_wrong_use_is_refused_before_anything_is_read(tlog, args, capsys):
    assert exit_code(lambda: main(["inspect", *(each.format(tlog=tlog) for each in args)])) == 2
    assert "expected" in capsys.readouterr().err


def test_a_recording_is_never_overwritten(tlog, tmp_path):
    copy = tmp_path / "flight.png"
    copy.write_bytes(tlog.read_bytes())
    assert main(["inspect", str(copy), "--plot", str(copy)]) == 2
    assert copy.read_bytes() == tlog.read_bytes()


def test_what_an_aircraft_says_cannot_steer_the_terminal(capsys):
    from rich.console import Console

    assert printable("a\x1b[2Jb") == "a?[2Jb"
    evil = Status(uav=1, t=T0, mode="\x1b[2J[red]", sentence="uav-1: \x1b]0;owned\x07")
    Console().print(
        table(FileFindings(file="x\x1b.tlog", aircraft=(compute_findings(survey_recording([evil])[1], LinkTexts()),)))
    )
    assert "\x1b" not in capsys.readouterr().out


def test_a_twin_that_answers_and_one_that_does_not(tlog, monkeypatch, capsys):
    def answers(module, *options):
        assert module == "twin_worker.evaluation.replay"
        told = {"1": {"methods": {"paper": 7}, "first_verified_s": 34.0, "within": {"10": 0.9}, "sentence": "well"}}
        with open(options[-1], "w") as file:
            json.dump(told, file)
        return 0, ""

    monkeypatch.setattr(inspect, "run_to_end", answers)
    assert main(["inspect", str(tlog), "--twin"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "7 by paper; verified after 34 s; within 10 %: 90% at 10 s; well" in out
    monkeypatch.setattr(inspect, "run_to_end", lambda *_: (1, "boom"))
    code, told = told_by([tlog, "--twin"], capsys)
    assert code == 1
    assert "boom" in told["files"][0]["twin"]["sentence"]


def test_the_help_does_not_load_the_plots():
    code = "import sys; from fleet.commands.offline import inspect; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_lines_keep_their_peaks_and_break_at_gaps():
    t = np.concatenate([np.arange(0, 100, 0.01), np.arange(200, 300, 0.01)])
    y = np.where(np.abs(t - 50.0) < 0.004, 9.0, 0.0)
    at, line = downsample(t, y, 1.0)
    assert len(at) < 3_100
    assert np.nanmax(line) == 9.0
    assert np.isnan(line).sum() == 1
    assert mode_colours(["AUTO", "WEIRD", "AUTO"])["AUTO"] == "#0072B2"


# --- recordings ------------------------------------------------------------------------------------------------------


def test_a_recorded_flight_of_another_autopilot(recordings):
    one = survey_recording(replay_messages(recordings / S02))[3]
    told = compute_findings(one, LinkTexts())
    assert (told.vehicle, told.mission.items, told.mission.complete) == ("fixed_wing", 17, True)
    assert [(mode.mode, round(mode.start_s)) for mode in told.modes] == [("MANUAL", 0), ("AUTO", 35)]
    rates = {"attitude": 25, "servo": 20, "position": 10, "air": 10, "command": 5, "wind": 2}
    assert {name: round(told.rows[name].rate_hz) for name in rates} == rates
    assert told.servo_map == "1 aileron, 2 elevator, 3 throttle, 4 rudder"
    assert told.airspeed.sensor == "yes"
    assert told.wind.from_deg == pytest.approx(4, abs=8)
    assert {can.name for can in told.abilities if not can.can} == set()


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({}, "motors assumed (no SERVOn_FUNCTION): 1 motor 1, 2 motor 2, 3 motor 3, 4 motor 4"),
        ({"SERVO1_FUNCTION": 33.0, "SERVO9_FUNCTION": 82.0, "SERVO3_FUNCTION": 0.0}, "1 motor 1, 9 motor 9"),
        ({"PWM_MAIN_FUNC2": 101.0, "PWM_AUX_FUNC1": 104.0}, "2 motor 1, 9 motor 4"),
        ({"FRAME_CLASS": 7.0}, "motors assumed (no SERVOn_FUNCTION): 1 motor 1, 2 motor 2, 3 motor 3"),
    ],
)
def test_outputs_of_a_multirotor_are_motors(params, text):
    copter = known(lively(), vehicle="multirotor")
    copter.params = Params(uav=1, t=T0, values=params)
    told = compute_findings(copter, LinkTexts())
    assert told.servo_map == text
    assert {f"{one.channel} {one.surface}" for one in told.servos} >= {text.rpartition(": ")[2].split(", ")[0]}


def test_three_aircraft_in_one_recording(recordings):
    found = survey_recording(replay_messages(recordings / S10))
    assert list(found) == [21, 22, 23]
    assert all(each.start_t == found[21].start_t for each in found.values())


def test_a_slow_link_without_a_mission_list(recordings):
    one = survey_recording(replay_messages(recordings / CUAV))[2]
    told = compute_findings(one, LinkTexts())
    assert told.vehicle == "quadplane"
    assert told.rows["attitude"].rate_hz == pytest.approx(1.9, abs=0.05)
    assert "no mission list was received; 3 items are known from position targets" in told.mission.sentence
    assert not told.mission.complete and told.mission.flown == (0, 2, 3, 4, 5, 6)
    able = judged(one)
    assert able["identify lateral"][0]
    assert "attitude at 1.9 Hz and servo at 0.9 Hz resolves fast motion poorly" in able["identify lateral"][1]
    assert able["estimate wind"][0]
