"""`fleet export`: files of a fleet, each opened by the library of its format."""

import io
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import fastkml
import geojson
import msgspec
import numpy as np
import pytest
from conftest import ROOT, unused_port
from foxglove_schemas_protobuf import GeoJSON_pb2, LocationFix_pb2, Log_pb2, SceneUpdate_pb2
from google.protobuf import json_format
from mcap.reader import make_reader

from fleet import cli
from fleet.bus.session import connect, open_router
from fleet.commands.live.record import BusRecorder
from fleet.contract import Alert, AlertKind, Array, Prediction
from fleet.export.features import FlightSummary, date, summarise
from fleet.export.foxglove import SCHEMAS
from fleet.export.geometry import ellipse, predicted_path
from fleet.export.map_files import geojson_text, kml_text
from fleet.export.message_source import EXPORTED, LiveSource
from fleet.frames import to_ned
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import HOME, HOSTILE, STAMP, PretendFleet, T

geojson.geometry.DEFAULT_PRECISION = 7  # it rounds to 6 decimals when it reads; a file has 7
UAVS, EVIL, SECONDS = 8, 3, 5
OFFICIAL = {
    "foxglove.LocationFix": LocationFix_pb2.LocationFix,
    "foxglove.GeoJSON": GeoJSON_pb2.GeoJSON,
    "foxglove.SceneUpdate": SceneUpdate_pb2.SceneUpdate,
    "foxglove.Log": Log_pb2.Log,
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five seconds of eight aircraft, one of them with hostile texts, two without a prediction, one with an alert."""
    path, bus = tmp_path_factory.mktemp("export") / "flight.parauav", MemoryBus()
    with path.open("wb", buffering=0) as file:
        recorder = BusRecorder(bus, file)  # type: ignore[arg-type]
        recorder.subscribe()
        fleet = PretendFleet(bus, UAVS, hostile=EVIL)  # type: ignore[arg-type]
        for k in range(10 * SECONDS):
            fleet.advance(T + k / 10)
        recorder.write()
    return path


def exported(recording: Path, tmp_path: Path, name: str, *options: str) -> Path:
    out = tmp_path / name
    assert cli.main(["export", str(out), "--from", str(recording), *options]) == 0
    assert list(tmp_path.iterdir()) == [out]  # nothing temporary is left
    return out


# --- GeoJSON ---------------------------------------------------------------------------------------------------------


def test_geojson_is_valid_and_has_the_newest_prediction(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = exported(recording, tmp_path, "now.geojson")
    collection = geojson.loads(out.read_text())
    assert collection.is_valid, collection.errors()
    kinds = {kind: [f for f in collection.features if f.properties["kind"] == kind] for kind in ("position", "horizon")}
    assert {f.properties["uav"] for f in kinds["position"]} == set(range(UAVS))
    assert {f.properties["uav"] for f in kinds["horizon"]} == set(range(UAVS)) - {1}  # identifying: no prediction
    assert "position" in capsys.readouterr().err


def test_a_predicted_path_ends_at_its_horizon_and_the_rest_is_marked(recording: Path, tmp_path: Path) -> None:
    features = geojson.loads(exported(recording, tmp_path, "one.geojson", "--uavs", "0").read_text()).features
    of = {f.properties["kind"]: f for f in features}  # the last of each kind
    assert {f.properties["uav"] for f in features} == {0}
    path, horizon = of["predicted_path"], of["horizon"]
    assert path.geometry.coordinates[-1] == horizon.geometry.coordinates == of["beyond_horizon"].geometry.coordinates[0]
    predicted_s = datetime.fromisoformat(horizon.properties["time"]) - datetime.fromisoformat(path.properties["time"])
    assert predicted_s.total_seconds() == pytest.approx(path.properties["horizon_s"], abs=0.06)
    assert of["prediction_region"].properties["ahead_s"] == path.properties["horizon_s"]


def test_regions_are_ellipses_with_the_stated_half_axes(recording: Path, tmp_path: Path) -> None:
    features = geojson.loads(exported(recording, tmp_path, "one.geojson", "--uavs", "0").read_text()).features
    regions = [f for f in features if f.properties["kind"] == "prediction_region"]
    assert 5 < len(regions) <= 24
    for region in regions:
        (ring,) = region.geometry.coordinates
        lon, lat, alt = np.array(ring).T
        ned = to_ned(HOME, lat * 1e7, lon * 1e7, alt * 1e3)[:, :2]
        assert ring[0] == ring[-1]
        distances = np.linalg.norm(ned[:-1] - ned[:-1].mean(axis=0), axis=1)
        along, cross, _ = region.properties["half_axes_m"]
        assert (distances.max(), distances.min()) == pytest.approx((along, cross), abs=0.03)
        east, north = ned[:, 1], ned[:, 0]
        assert np.sum(east[:-1] * north[1:] - east[1:] * north[:-1]) > 0  # counter-clockwise, RFC 7946


def test_an_ellipse_is_longest_along_the_path() -> None:
    ring = ellipse(np.zeros(3), np.array([10.0, 2.0, 1.0]), math.pi / 2)  # eastwards
    assert np.abs(ring[:, 1]).max() == pytest.approx(10.0) and np.abs(ring[:, 0]).max() == pytest.approx(2.0)


def test_alerts_are_at_their_place_else_at_the_aircraft(recording: Path, tmp_path: Path) -> None:
    features = geojson.loads(exported(recording, tmp_path, "all.geojson").read_text()).features
    (alert,) = [f for f in features if f.properties["kind"] == "alert"]
    (place,) = [f for f in features if f.properties["kind"] == "position" and f.properties["uav"] == 6]
    assert alert.properties["alert"] == "short_horizon" and alert.properties["place"] == "aircraft"
    assert alert.geometry.coordinates[:2] == pytest.approx(place.geometry.coordinates[:2], abs=1e-3)
    flight = FlightSummary(7)
    flight.add(Alert(uav=7, t=T, kind=AlertKind.GEOFENCE, lat=HOME.lat_e7, lon=HOME.lon_e7, alt=HOME.alt_mm))
    flight.add(Alert(uav=7, t=T, kind=AlertKind.GROUND))
    flight.add(Alert(uav=7, t=T + 1, kind=AlertKind.CONFLICT, other=9))
    flight.add(Alert(uav=7, t=T + 2, kind=AlertKind.CONFLICT, other=9, active=False))
    there, nowhere = flight.features()
    assert there.coordinates == [HOME.lon_e7 * 1e-7, HOME.lat_e7 * 1e-7, HOME.alt_mm * 1e-3]
    assert nowhere.geometry == "" and geojson.loads(geojson_text([nowhere])).features[0].geometry is None


# --- KML -------------------------------------------------------------------------------------------------------------


def test_kml_opens_with_a_folder_for_each_aircraft_and_no_markup_from_outside(recording: Path, tmp_path: Path) -> None:
    out = exported(recording, tmp_path, "all.kml")
    document = fastkml.KML.from_string(out.read_text().partition("?>")[2]).features[0]
    assert [folder.name for folder in document.features] == [f"uav-{uav}" for uav in range(UAVS)]
    assert {style.id for style in document.styles} >= {"flown_path", "predicted_path", "prediction_region", "alert"}
    placemarks = document.features[0].features
    assert all(mark.style_url.url.lstrip("#") in {style.id for style in document.styles} for mark in placemarks)
    shapes = {type(mark.geometry).__name__ for mark in placemarks}
    assert shapes == {"LineString", "Point", "Polygon"}
    flown = placemarks[0].geometry
    assert all(abs(lat - HOME.lat_e7 * 1e-7) < 0.1 and 400 < alt < 900 for _, lat, alt in flown.coords)
    assert "<img" not in out.read_text() and HOSTILE in document.features[EVIL].features[0].description


def test_control_characters_from_outside_do_not_break_a_file() -> None:
    flight = FlightSummary(1)
    flight.add(Alert(uav=1, t=float("nan"), kind=AlertKind.GROUND, sentence="\x00\x1b]0;x\x07 ]]> & <b>"))
    text = kml_text(flight.features())
    (mark,) = fastkml.KML.from_string(text.partition("?>")[2]).features[0].features[0].features
    assert "??]0;x? ]]> & <b>" in mark.description and mark.geometry is None


# --- MCAP ------------------------------------------------------------------------------------------------------------


def official(schema: str, content: dict[str, Any]) -> Any:
    """Read a message as the definition that Foxglove publishes: an unknown field or a wrong type is an error."""

    def in_protobuf(value: Any) -> Any:
        if isinstance(value, dict) and value.keys() == {"sec", "nsec"}:
            return f"{value['sec'] + value['nsec'] * 1e-9:.9f}s"
        if isinstance(value, dict):
            return {
                k: date(v["sec"] + v["nsec"] * 1e-9) if k == "timestamp" else in_protobuf(v) for k, v in value.items()
            }
        return [in_protobuf(one) for one in value] if isinstance(value, list) else value

    return json_format.ParseDict(in_protobuf(content), OFFICIAL[schema]())


def conforms(content: Any, schema: dict[str, Any]) -> bool:
    """Tell whether a value has the types and all the fields of a schema, and no other ones."""
    kinds = {"number": (int, float), "string": str, "boolean": bool, "integer": int, "object": dict, "array": list}
    if not isinstance(content, kinds[schema["type"]]):
        return False
    if schema["type"] == "array":
        return all(conforms(one, schema["items"]) for one in content)
    if schema["type"] != "object" or "properties" not in schema:
        return True
    return content.keys() == schema["properties"].keys() and all(
        conforms(content[name], inner) for name, inner in schema["properties"].items()
    )


def test_mcap_opens_with_its_library_and_every_message_is_foxgloves(recording: Path, tmp_path: Path) -> None:
    out = exported(recording, tmp_path, "flight.mcap")
    counts: dict[str, int] = {}
    with out.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        for schema, channel, message in reader.iter_messages():
            assert schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"
            content = json.loads(message.data)
            assert json.loads(schema.data) == SCHEMAS[schema.name] and conforms(content, SCHEMAS[schema.name])
            official(schema.name, content)
            if schema.name == "foxglove.GeoJSON":
                assert geojson.loads(content["geojson"]).is_valid
            assert T - 1 <= message.log_time * 1e-9 <= T + SECONDS + 1
            counts[schema.name] = counts.get(schema.name, 0) + 1
    assert summary.statistics.message_count == sum(counts.values())
    topics = {channel.topic for channel in summary.channels.values()}
    assert topics >= {"/uav/0/location", "/uav/0/prediction", "/uav/0/scene", "/alerts"}
    assert "/uav/1/prediction" not in topics
    assert counts["foxglove.LocationFix"] > UAVS * 10 * (SECONDS - 1)
    assert counts["foxglove.GeoJSON"] == counts["foxglove.SceneUpdate"] == (UAVS - 1) * SECONDS
    assert counts["foxglove.Log"] == 1


def test_the_scene_of_a_prediction_is_where_the_map_has_it(recording: Path, tmp_path: Path) -> None:
    out = exported(recording, tmp_path, "one.mcap", "--uavs", "2")
    with out.open("rb") as file:
        messages = {m[1].topic: json.loads(m[2].data) for m in make_reader(file).iter_messages()}
    (entity,) = messages["/uav/2/scene"]["entities"]
    features = geojson.loads(messages["/uav/2/prediction"]["geojson"]).features
    (path,) = [f for f in features if f.properties["kind"] == "predicted_path"]
    lon, lat, alt = np.array(path.geometry.coordinates).T
    n, e, d = to_ned(HOME, lat * 1e7, lon * 1e7, alt * 1e3).T
    drawn = np.array([[p["x"], p["y"], p["z"]] for p in entity["lines"][0]["points"]])
    assert drawn == pytest.approx(np.stack([e, n, -d], axis=-1), abs=0.05)
    regions = [f for f in features if f.properties["kind"] == "prediction_region"]
    sizes = [[s["size"][axis] / 2 for axis in "xyz"] for s in entity["spheres"]]
    assert np.array(sizes) == pytest.approx(np.array([f.properties["half_axes_m"] for f in regions]), abs=0.01)
    assert SCHEMAS["foxglove.SceneUpdate"]["title"] == "foxglove.SceneUpdate"


# --- Rerun -----------------------------------------------------------------------------------------------------------


def rerun_columns(path: Path) -> dict[str, dict[str, list[Any]]]:
    """Read a recording with Rerun's own reader: the columns of each entity, rows in order of time."""
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is absent: pip install -r requirements-rerun.lock")
    (store,) = chunk.RrdReader(path).recordings()
    assert store.application_id == "ParaUAV"
    entities: dict[str, dict[str, list[Any]]] = {}
    for part in chunk.RrdReader(path).stream().to_chunks():
        columns = entities.setdefault(part.entity_path, {})
        rows = part.to_record_batch()
        for name, column in zip(rows.schema.names, rows.columns, strict=True):
            if name == "time":
                column = column.cast("int64")
            columns.setdefault(name, []).extend(column.to_pylist())
    return entities


def test_rerun_opens_with_its_library_and_has_the_paths_of_the_map(recording: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is absent: pip install -r requirements-rerun.lock")
    entities = rerun_columns(exported(recording, tmp_path, "flight.rrd"))
    (tmp_path / "flight.rrd").unlink()
    features = geojson.loads(exported(recording, tmp_path, "now.geojson").read_text()).features
    newest = {(f.properties["uav"], f.properties["kind"]): f for f in features}
    assert "/uav/1/prediction/map" not in entities  # identifying: no prediction
    for uav in (0, 2):
        fixes = entities[f"/uav/{uav}/location"]
        assert len(fixes["time"]) > 10 * (SECONDS - 1) and min(fixes["time"]) >= (T - 1) * 1e9
        lon, lat, _ = newest[uav, "position"].geometry.coordinates
        assert fixes["GeoPoints:positions"][-1][0] == pytest.approx([lat, lon], abs=1e-5)  # at most 1 s apart
        lines = entities[f"/uav/{uav}/prediction/map"]
        last = int(np.argmax(lines["time"]))
        (line,) = lines["GeoLineStrings:line_strings"][last]
        path = newest[uav, "predicted_path"].geometry.coordinates
        assert np.array(line)[[0, -1]] == pytest.approx(np.array(path)[[0, -1], 1::-1], abs=1e-6)
        sizes = np.array(entities[f"/uav/{uav}/prediction/region"]["Ellipsoids3D:half_sizes"][last])
        assert sizes[-1] == pytest.approx(newest[uav, "prediction_region"].properties["half_axes_m"], abs=0.01)
        horizon = entities[f"/uav/{uav}/horizon_s"]["Scalars:scalars"][last]
        cleared = entities[f"/uav/{uav}/prediction"]  # the newest prediction ends at its horizon, and no earlier one
        assert cleared["Clear:is_recursive"] == [[True]]
        assert cleared["time"] == pytest.approx([lines["time"][last] + horizon[0] * 1e9], abs=1e6)
    assert len(entities["/alerts"]["TextLog:text"]) == 1


def test_a_rerun_file_without_its_package_is_refused_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("fleet.export.rerun_file.find_spec", lambda name: None)
    assert cli.main(["export", str(tmp_path / "x.rrd")]) == 2
    assert "found no package rerun-sdk" in capsys.readouterr().err and not list(tmp_path.iterdir())


# --- invalid content -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"path": Array.of(np.full((81, 3), np.nan))},
        {"path": Array.of(np.zeros((3, 3)))},
        {"ahead": Array.of(np.zeros(81))},
        {"origin": (2_000_000_000, 0, 0)},
    ],
    ids=["nan", "shape", "times", "origin"],
)
def test_an_invalid_prediction_is_left_out(changes: dict[str, Any]) -> None:
    bus, made = MemoryBus(), []
    bus.subscribe(Prediction, lambda message, _: made.append(message))
    PretendFleet(bus, 1).advance(T)  # type: ignore[arg-type]
    good: Prediction = made[0]
    assert predicted_path(good) is not None
    bad = msgspec.structs.replace(good, **changes)
    with pytest.raises(ValueError, match=r"uav-0: found .*; resend"):
        predicted_path(bad)
    assert summarise([bad])[0].features() == []
    without_end = msgspec.structs.replace(good, horizon_s=float("nan"))
    kinds = {feature.kind for feature in summarise([without_end])[0].features()}
    assert kinds == {"beyond_horizon"}  # nothing is claimed


def test_dates_outside_the_calendar_are_empty() -> None:
    assert date(T) == "2023-11-14T22:13:20.000Z" and {date(x) for x in (math.nan, math.inf, -1.0, 1e12)} == {""}


# --- live ------------------------------------------------------------------------------------------------------------


def test_live_messages_of_a_superseded_writer_are_left_out() -> None:
    bus, stop = MemoryBus(), threading.Event()
    source = LiveSource(bus)  # type: ignore[arg-type]
    fleet = PretendFleet(bus, 3)  # type: ignore[arg-type]
    fleet.advance(T)
    messages = source.messages(stop, 0.0)
    first = next(messages)
    assert isinstance(first, EXPORTED)
    prediction = fleet.uavs[0].prediction(T, 0.0)
    bus.publish(msgspec.structs.replace(prediction, t=T + 7), STAMP._replace(epoch=0))
    bus.publish(msgspec.structs.replace(prediction, t=T + 8), STAMP)
    stop.set()
    times = [message.t for message in messages if isinstance(message, Prediction)]
    assert T + 8 in times and T + 7 not in times and source.dropped == 0


def test_a_live_export_ends_with_ctrl_c_and_is_whole(tmp_path: Path) -> None:
    """As a process of its own, on a real router, with a fleet that flies."""
    address, stop, out = f"tcp/127.0.0.1:{unused_port()}", threading.Event(), tmp_path / "live.mcap"
    session = open_router(address)
    with connect(address) as bus:
        fleet = PretendFleet(bus, 2)

        def publish() -> None:
            while not stop.wait(0.1):
                fleet.advance(time.time())

        feeder = threading.Thread(target=publish)
        feeder.start()
        line = [sys.executable, "-m", "fleet.cli", "export", str(out), "--for", "0", "--router", address]
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(line, cwd=ROOT, env=env, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None and "collecting until Ctrl-C" in process.stderr.readline()
        partial = tmp_path / f".{out.name}.part"
        while not partial.exists() and process.poll() is None:
            stop.wait(0.1)
        stop.wait(3.0)  # of data: a slow machine collects fewer messages
        process.send_signal(signal.SIGINT)
        _, log = process.communicate(timeout=60)
        stop.set()
        feeder.join()
    session.close()
    assert process.returncode == 0 and "Traceback" not in log, log
    assert "LocationFix" in log and not partial.exists()
    with out.open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) > 5


def test_an_empty_recording_is_said_to_be_empty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nothing = tmp_path / "nothing.parauav"
    nothing.write_bytes(b"")
    for name in ("x.geojson", "x.kml", "x.mcap"):
        assert cli.main(["export", str(tmp_path / name), "--from", str(nothing)]) == 1
        assert "no aircraft in nothing.parauav" in capsys.readouterr().err
    assert geojson.loads((tmp_path / "x.geojson").read_text()).features == []
    assert make_reader(io.BytesIO((tmp_path / "x.mcap").read_bytes())).get_summary() is not None
