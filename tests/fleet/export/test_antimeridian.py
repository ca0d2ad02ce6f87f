"""A fleet on the 180 degree meridian: files of other tools, cut where they cross it."""

from itertools import pairwise

import geojson
import numpy as np
import pytest

from fleet.contract import Prediction
from fleet.export.features import summarise
from fleet.export.geometry import coordinates, cut_at_antimeridian, cut_line, ellipse
from fleet.export.map_files import geojson_text, kml_text
from fleet.export.message_source import EXPORTED
from fleet.frames import Origin, to_ned
from tests.support import pretend_feed
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import PretendFleet, T

TAVEUNI = Origin(-168_000_000, 1_799_999_000, 20_000)  # 10.6 m west of the meridian
SECONDS = 20


@pytest.fixture
def crossing(monkeypatch: pytest.MonkeyPatch) -> list:
    """Messages of four aircraft that fly from one side to the other."""
    monkeypatch.setattr(pretend_feed, "HOME", TAVEUNI)
    bus, messages = MemoryBus(), []
    bus.publish = lambda message, *_: messages.append(message)  # type: ignore[method-assign,assignment]
    fleet = PretendFleet(bus, 4)  # type: ignore[arg-type]
    for k in range(2 * SECONDS):
        fleet.advance(T + k / 2)
    return [message for message in messages if isinstance(message, EXPORTED)]


def lengths_m(line: list) -> np.ndarray:
    """Return the length of each segment of a line in longitude, latitude [deg], altitude [m]."""
    lon, lat, alt = np.array(line).T
    return np.linalg.norm(np.diff(to_ned(TAVEUNI, lat * 1e7, lon * 1e7, alt * 1e3), axis=0), axis=1)


def test_lines_and_regions_are_cut_at_the_meridian_and_nothing_is_lost(crossing: list) -> None:
    features = [feature for flight in summarise(crossing).values() for feature in flight.features()]
    collection = geojson.loads(geojson_text(features))
    assert collection.is_valid, collection.errors()
    kinds = {feature.geometry.type for feature in collection.features}
    assert kinds >= {"MultiLineString", "MultiPolygon"}
    for whole, feature in zip(features, collection.features, strict=True):
        geometry = feature.geometry
        if geometry.type in ("LineString", "MultiLineString"):
            parts = [geometry.coordinates] if geometry.type == "LineString" else geometry.coordinates
            assert all(np.ptp([point[0] for point in part]) < 1 for part in parts)
            assert sum(lengths_m(part).sum() for part in parts) == pytest.approx(
                lengths_m(whole.coordinates).sum(),
                abs=0.2,  # rounded to 1e-7 degrees
            )
            for before, after in pairwise(parts):
                assert abs(before[-1][0]) == 180 == abs(after[0][0]) and before[-1][1:] == after[0][1:]
    text = kml_text(features)
    assert "MultiGeometry" in text and "nan" not in text


@pytest.mark.parametrize("radius_m", [30.0, 300.0])
def test_the_parts_of_an_ellipse_have_its_area(radius_m: float) -> None:
    ring = coordinates(TAVEUNI, ellipse(np.zeros(3), np.array([radius_m, radius_m / 2, 1.0]), 0.7))
    kind, parts = cut_at_antimeridian("Polygon", [ring])
    assert kind == "MultiPolygon" and len(parts) == 2
    areas = []
    for (part,) in parts:
        lon, lat, alt = np.array(part).T
        n, e, _ = to_ned(TAVEUNI, lat * 1e7, lon * 1e7, alt * 1e3).T
        areas.append(np.sum(e[:-1] * n[1:] - e[1:] * n[:-1]) / 2)  # counter-clockwise: positive
        assert part[0] == part[-1] and np.ptp(lon) < 1
    assert min(areas) > 0
    angle = np.linspace(0, 2 * np.pi, 33)  # the polygon of `ellipse`, not the smooth curve
    assert sum(areas) == pytest.approx(radius_m**2 / 2 * np.sum(np.sin(np.diff(angle))) / 2, rel=1e-2)


def test_what_does_not_cross_stays_as_it_is() -> None:
    line = [[179.9, 0.0, 1.0], [179.99, 0.1, 1.0]]
    assert cut_at_antimeridian("LineString", line) == ("LineString", line)
    assert cut_at_antimeridian("Point", [180.0, 0.0, 0.0]) == ("Point", [180.0, 0.0, 0.0])
    assert cut_line([[179.0, 0.0], [180.0, 1.0], [-179.0, 2.0]]) == [
        [[179.0, 0.0], [180.0, 1.0]],
        [[-180.0, 1.0], [-179.0, 2.0]],
    ]
    assert cut_at_antimeridian("LineString", [[-179.0, 0.0], [179.0, 2.0]]) == (
        "MultiLineString",
        [[[-179.0, 0.0], [-180.0, 1.0]], [[180.0, 1.0], [179.0, 2.0]]],
    )


def test_predictions_start_at_the_aircraft_on_both_sides(crossing: list) -> None:
    """The position reported last before a prediction is where its path begins, whichever side it is on."""
    predictions = [message for message in crossing if isinstance(message, Prediction)]
    longitudes = {np.sign(coordinates(m.ned_origin(), m.path.numpy()[:1])[0][0]) for m in predictions}
    assert longitudes == {-1.0, 1.0}
