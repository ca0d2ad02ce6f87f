"""Tables by a column map: CSV, archives, MATLAB; units, frames, and a real flight equal to its telemetry log."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from fleet.contract import Sample, Status
from fleet.telemetry.onboard_logs.columns.column_map import read_map
from fleet.telemetry.recording.options import RecordingOptions
from fleet.telemetry.recording.recordings import Recording
from tests.support import tables as made
from tests.support.talker import of


def read(path: Path, columns: object = "") -> tuple[list, list[str], Recording]:
    recording = Recording(path, options=RecordingOptions(columns=str(columns)))
    return [n for _, step in recording.steps() for n in step], recording.skipped, recording


def rows(news: list, field: str) -> tuple[np.ndarray, np.ndarray]:
    parts = [getattr(s, field) for s in of(Sample, news) if getattr(s, field) is not None]
    return tuple(np.concatenate([getattr(p, k).numpy() for p in parts]) for k in "tx")  # type: ignore[return-value]


def column_map(folder: Path, text: str = made.MAP, file: str = "flight.csv", **changes: str) -> Path:
    path = folder / "map.toml"
    text = text.replace("FILE", file)
    for before, after in changes.items():
        text = text.replace(before, after)
    path.write_text(text)
    return path


def check_steady_flight(news: list) -> None:
    """Every number is the flight's own, in SI, NED and FRD."""
    t, attitude = rows(news, "attitude")
    assert t == pytest.approx(made.T0 + made.DT * np.arange(made.N), abs=1e-3)
    truth = (made.ROLL, made.PITCH, made.YAW, made.P, made.Q, made.R)
    np.testing.assert_allclose(attitude, np.tile(truth, (made.N, 1)), atol=1e-6)
    np.testing.assert_allclose(rows(news, "velocity")[1], np.tile(made.SPEED, (made.N, 1)), atol=1e-6)
    np.testing.assert_allclose(rows(news, "position")[1][0], (474000000, 85000000, 520000), atol=1)


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_a_csv_is_converted_by_units_and_frame(tmp_path: Path, separator: str) -> None:
    path = tmp_path / "flight.csv"
    path.write_text(made.csv_text(made.flight_columns(), separator))
    news, skipped, _ = read(path, column_map(tmp_path))
    check_steady_flight(news)
    np.testing.assert_allclose(rows(news, "air")[1][:, :2], np.tile((14.0, 0.6), (made.N, 1)), atol=1e-6)
    np.testing.assert_allclose(rows(news, "servo")[1][0], (1600, 1400, 0, 0, 0, 0, 0, 0))
    status = of(Status, news)[-1]
    assert (status.vehicle, status.autopilot, status.mode) == ("fixed_wing", "ardupilot", "AUTO") and not skipped


def test_a_matlab_structure_is_the_same_flight(tmp_path: Path) -> None:
    path = tmp_path / "flight.mat"
    for compressed in (False, True):
        savemat(path, {"data": made.flight_columns()}, do_compression=compressed)
        text = made.MAP.replace('file = "FILE"', 'variable = "data"')
        check_steady_flight(read(path, column_map(tmp_path, text))[0])


def test_alfa_files_are_read_from_an_archive_and_from_a_folder(tmp_path: Path) -> None:
    files = made.per_topic()
    packed = tmp_path / "flight7.tar"
    packed.write_bytes(made.archive(files))
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    for path in (packed, tmp_path / "flight7-mavros-vfr_hud.csv"):
        news, _, _ = read(path, "alfa")
        check_steady_flight(news)
        np.testing.assert_allclose(rows(news, "imu")[1][0, :3], (0.5, 0.2, -9.8), atol=1e-9)
        assert of(Status, news)[-1].mode == "GUIDED" and of(Status, news)[-1].armed


def test_rates_that_no_table_has_are_differences_of_the_angles(tmp_path: Path) -> None:
    columns = made.flight_columns()
    columns["roll"] = np.degrees(0.2 * np.arange(made.N) * made.DT - 1.0)
    path = tmp_path / "flight.csv"
    path.write_text(made.csv_text(columns))
    text = made.MAP.replace(', "p", "q", "r"]', "]").replace(', "deg/s", "deg/s", "deg/s"]', "]")
    news, skipped, _ = read(path, column_map(tmp_path, text))
    np.testing.assert_allclose(rows(news, "attitude")[1][:, 3], 0.2, atol=1e-6)
    assert any("differences of the angles" in sentence for sentence in skipped)


def test_the_csv_of_a_real_flight_equals_its_telemetry(recordings: Path) -> None:
    """ALFA has the same MAVLink messages once as frames and once as MAVROS topics: the map's frames must be right."""
    folder = recordings / "real"
    by_map = read(folder / "alfa_20180718_155331_1_engine_failure_csv.tar.xz", "alfa")[0]
    by_frames = read(folder / "alfa_20180718_155331_1_engine_failure.tlog")[0]
    for field, tolerance in (("attitude", 0.02), ("velocity", 0.05), ("air", 0.02), ("wind", 0.05), ("servo", 0.5)):
        (t, x), (their_t, theirs) = rows(by_map, field), rows(by_frames, field)
        shift = np.median(t[0]) - their_t[0]
        best = min(
            float(np.median(np.abs(np.column_stack([np.interp(t, their_t + shift + d, c) for c in theirs.T]) - x)))
            for d in np.arange(-1.0, 1.01, 0.05)
        )
        assert best < tolerance, (field, best)


BAD = {
    "no map": ("", "expected one for tables"),
    "no such map": ("nothing.toml", "expected a TOML file or one of alfa, px4"),
    "no TOML": ("= 1", "invalid TOML"),
    "an unknown entry": ("[attitudes]", "the entry 'attitudes'"),
    "no tables": ('[attitude]\ncolumns = ["a", "b", "c"]', "a table [tables]"),
    "too few columns": (made.MAP.replace('["lat", "lon", "alt"]', '["lat"]'), "a list of 3 columns"),
    "an unknown unit": (made.MAP.replace('"knot"', '"furlong"'), "velocity.units"),
    "an unknown frame": (made.MAP.replace('"enu"', '"esu"'), "one of ned, enu"),
    "two stars": (made.MAP.replace('"FILE"', '"*a*"'), "at most one *"),
    "another time": (made.MAP.replace('time = "t"', 'time = "clock"'), "expected 'clock'"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_map_is_refused_with_its_entry(tmp_path: Path, what: str) -> None:
    text, sentence = BAD[what]
    path = tmp_path / "flight.csv"
    path.write_text(made.csv_text(made.flight_columns()))
    columns = text if "\n" not in text and not text.startswith(("=", "[")) else column_map(tmp_path, text)
    with pytest.raises((ValueError, OSError), match=re.escape(sentence)):
        read(path, columns)


def test_the_shipped_maps_are_valid() -> None:
    assert read_map("alfa").autopilot == "ardupilot" and read_map("px4").autopilot == "px4"
    assert read_map("alfa").needed("hud") >= {"field.airspeed", "%time"}


def test_hdf5_is_refused_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "flight.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512, b" "))
    with pytest.raises(ValueError, match="save it with -v7"):
        read(path, column_map(tmp_path))


def test_inspect_reports_a_refusal_in_json(tmp_path: Path) -> None:
    path, report = tmp_path / "flight.csv", tmp_path / "report.json"
    path.write_text(made.csv_text(made.flight_columns()))
    code = f"from fleet.cli import main; main(['inspect', {str(path)!r}, '--json', {str(report)!r}])"
    subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
    (file,) = json.loads(report.read_text())["files"]
    assert any("--columns" in sentence for sentence in file["sentences"]) and not file["aircraft"]
