"""Flights and cards that cannot be judged: a clear sentence each, never a confident name."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleet.commands.offline import diagnose as verb
from twin_worker.diagnosis import __main__ as diagnosis
from twin_worker.diagnosis import learn
from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.data.card import UNKNOWN, AircraftCard, read_card
from twin_worker.diagnosis.data.flight import FlightData, read_flights, resample_flight
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.report import ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.output import keep
from twin_worker.telemetry.history import TelemetryHistory

T0 = 1.7e9


@pytest.fixture(scope="module")
def folder(recordings: Path) -> Path:
    return recordings / "concealed-open"


@pytest.fixture(scope="module")
def card(folder: Path) -> AircraftCard:
    return read_card(folder / "card.json")


@pytest.fixture(scope="module")
def nominal(folder: Path, card: AircraftCard) -> list[FlightData]:
    return [read_flights(path, card)[0] for path in sorted(folder.glob("cal_*.tlog"))[:3]]


@pytest.fixture(scope="module")
def base(nominal: list[FlightData], card: AircraftCard) -> Baseline:
    return calibrate(nominal, card)


def history(seconds: float, speed: float) -> TelemetryHistory:
    """Telemetry of an aircraft that does nothing, as far as it has rows."""
    out = TelemetryHistory(keep_s=np.inf)
    t = T0 + np.arange(0.0, seconds, 0.04)
    still = np.zeros(len(t))
    out.replace_rows("attitude", t, np.zeros((len(t), 6)))
    out.replace_rows("velocity", t, np.stack([still + speed, still, still], axis=1))
    out.replace_rows(
        "position", t, np.stack([still + 4.7e8, still + 8.5e7 + speed * 100 * (t - T0), still + 5e5], axis=1)
    )
    out.replace_rows("servo", t, np.full((len(t), 8), 1500.0))
    return out


def test_a_flight_of_ten_seconds_is_too_short() -> None:
    with pytest.raises(ValueError, match="found 10 s, expected 25 s of flight at least; record longer"):
        resample_flight("hop", history(10.0, 20.0), {}, UNKNOWN)


def test_standing_on_the_ground_is_no_flight() -> None:
    with pytest.raises(ValueError, match=r"found 0 s in the air.*check that the aircraft flew"):
        resample_flight("parked", history(120.0, 0.0), {}, UNKNOWN)


def test_what_is_missing_is_named() -> None:
    told = history(120.0, 20.0)
    told.replace_rows("servo", np.empty(0), np.empty((0, 8)))
    with pytest.raises(ValueError, match=r"found no servo in it.*record that message too"):
        resample_flight("mute", told, {}, UNKNOWN)


@pytest.mark.recordings
@pytest.mark.parametrize("lost", [("Va",), ("a_x", "a_y", "a_z")])
def test_without_airspeed_or_accelerometer_nothing_is_invented(
    lost: tuple[str, ...], nominal: list[FlightData], card: AircraftCard
) -> None:
    vane = "a_x" not in lost
    blind = [
        replace(flight, vane=vane, readings={name: x for name, x in flight.readings.items() if name not in lost})
        for flight in nominal
    ]
    report = diagnose(blind[0], calibrate(blind, card))
    assert report.outcome in (ReportOutcome.NONE, ReportOutcome.SUSPECTED), report.sentence


@pytest.mark.recordings
def test_without_accelerometer_the_model_asks_for_flights_like_it(nominal: list[FlightData], base: Baseline) -> None:
    with pytest.raises(ValueError, match=r"found no accelerometer.*calibrate on flights recorded like this one"):
        diagnose(replace(nominal[0], vane=False), base)


@pytest.mark.recordings
def test_another_aircraft_is_refused(nominal: list[FlightData], base: Baseline) -> None:
    slow = {name: x / 2.5 if name in ("v_n", "v_e", "Va") else x for name, x in nominal[0].readings.items()}
    with pytest.raises(ValueError, match=r"expected about 47 m/s.*use the model of this aircraft"):
        diagnose(replace(nominal[0], readings=slow), base)


@pytest.mark.recordings
def test_the_card_of_another_aircraft_is_refused(folder: Path, nominal: list[FlightData]) -> None:
    with pytest.raises(ValueError, match=r"Aerosonde.*lift slope.*use the card of this aircraft"):
        calibrate(
            [read_flights(folder / f"{flight.name}.tlog", read_card(Path("aerosonde")))[0] for flight in nominal],
            read_card(Path("aerosonde")),
        )


@pytest.mark.recordings
def test_nominal_flights_that_are_none_are_refused(folder: Path, nominal: list[FlightData], card: AircraftCard) -> None:
    faulty = read_flights(folder / "rec_7c39cb85.tlog", card)[0]
    with pytest.raises(ValueError, match=r"rec_7c39cb85: found roll .* expected nominal flights; leave it out"):
        calibrate([*nominal, faulty], card)
    windy = [read_flights(folder / f"rec_{name}.tlog", card)[0] for name in ("2e0d2cd3", "80835fb9")]
    with pytest.raises(ValueError, match="expected consistent nominal flights"):
        calibrate([*windy, nominal[0]], card)


@pytest.mark.recordings
def test_one_bad_recording_loses_no_other(
    folder: Path, base: Baseline, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, junk, out = tmp_path / "model.json", tmp_path / "junk.tlog", tmp_path / "out.json"
    keep.save(model, base)
    junk.write_bytes(np.random.default_rng(3).bytes(5000))
    files = [str(junk), str(tmp_path / "gone.tlog"), str(folder / "rec_27aced15.tlog")]
    assert diagnosis.main([*files, "--model", str(model), "--json", str(out)]) == 1
    said = capsys.readouterr()
    assert "junk.tlog" in said.err and "gone.tlog: found no such file" in said.err
    told = json.loads(out.read_text())
    verdicts = {one["flight"]: one["verdict"] for one in told}
    assert verdicts == {"rec_27aced15": "none", "junk": "refused", "gone": "refused"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[1, 2]", "found a list"),
        ("{", "found no JSON"),
        ('{"m": -5}', "found m = -5"),
        ('{"m": 1, "S": 1, "b": 1, "c": 1, "Ixx": NaN}', "found Ixx = nan"),
        (
            '{"m": 1, "S": 1, "b": 1, "c": 1, "Ixx": 1, "Iyy": 1, "Izz": 1, "Ixz": 0,'
            ' "surface_full_deg": {"aileron": 3}}',
            "surface_full_deg.aileron",
        ),
    ],
)
def test_a_card_that_is_none_is_refused(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "card.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=expected):
        read_card(path)


@pytest.mark.parametrize("text", ["nothing", "[]", '{"format": "other"}', '{"format": "parauav.simulation.2"}'])
def test_a_model_that_is_none_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"model.json: found .*(make it|model)"):
        keep.load(path)


def test_folders_that_are_not_there_are_named_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = str(tmp_path / "gone" / "x.json")
    (model := tmp_path / "m.json").write_text("{}")
    for main, option, words in (
        (learn.main, "--out", [str(model), "--out", gone]),
        (diagnosis.main, "--json", ["a.tlog", "--model", str(model), "--json", gone]),
    ):
        with pytest.raises(SystemExit) as left:
            main(words)
        assert left.value.code == 2 and f"{option}: found no folder" in capsys.readouterr().err


def test_it_must_be_said_what_to_compare_with() -> None:
    parser = argparse.ArgumentParser()
    verb.arguments(parser)
    with pytest.raises(ValueError, match="exactly one of --model, --against"):
        verb.run(parser.parse_args([__file__]))
