"""Areas of fence items and GeoJSON files: what is read, what is refused, and how far points are inside."""

import json
from math import inf
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.contract import Item
from fleet.frames import Origin
from fleet.terrain.areas import MAX_VERTICES, Area, read_areas, read_fence_items

HERE = Origin(470_000_000, 80_000_000, 500_000)
SQUARE = [[8.0, 47.0], [8.01, 47.0], [8.01, 47.01], [8.0, 47.01]]


def place(n: float, e: float) -> tuple[int, int]:
    """Return latitude and longitude of a position relative to `HERE` [m]."""
    return HERE.lat_e7 + round(n / 6_366_000 * 180 / np.pi * 1e7), HERE.lon_e7 + round(
        e / 4_359_000 * 180 / np.pi * 1e7
    )


def polygon(corners: list[tuple[float, float]], **more: float) -> Area:
    return Area("square", tuple(place(n, e) for n, e in corners), exclusion=False, **more)


def at(n: float, e: float, height: float = 600.0) -> np.ndarray:
    return np.array([[n, e, 500.0 - height]])


BOX = [(-100.0, -200.0), (-100.0, 200.0), (100.0, 200.0), (100.0, -200.0)]


@given(st.floats(-300, 300), st.floats(-400, 400))
def test_the_depth_in_a_box_is_the_distance_to_its_edge(n: float, e: float) -> None:
    inside = min(100.0 - abs(n), 200.0 - abs(e))
    outside = np.hypot(max(abs(n) - 100.0, 0.0), max(abs(e) - 200.0, 0.0))
    expected = inside if inside >= 0 else -outside
    assert polygon(BOX).depth(at(n, e), HERE)[0] == pytest.approx(expected, abs=1.0)


def test_a_concave_polygon_has_an_outside_between_its_arms() -> None:
    letter_u = [
        (0.0, 0.0),
        (0.0, 300.0),
        (300.0, 300.0),
        (300.0, 200.0),
        (100.0, 200.0),
        (100.0, 100.0),
        (300.0, 100.0),
        (300.0, 0.0),
    ]
    area = polygon(letter_u)
    assert area.depth(at(50.0, 150.0), HERE)[0] > 0 > area.depth(at(200.0, 150.0), HERE)[0]


def test_a_circle_and_heights() -> None:
    circle = Area("circle", (place(50.0, 0.0),), exclusion=True, radius=80.0, floor=550.0, ceiling=650.0)
    assert circle.depth(at(50.0, 30.0), HERE)[0] == pytest.approx(50.0, abs=0.5)
    assert circle.depth(at(50.0, 30.0, 651.0), HERE)[0] == circle.depth(at(50.0, 30.0, 549.0), HERE)[0] == -inf
    assert np.hypot(*(circle.outline(HERE) - (50.0, 0.0)).T) == pytest.approx(80.0, abs=0.5)


def test_points_of_any_shape_have_depths() -> None:
    points = np.random.default_rng(0).normal(0.0, 200.0, (5, 7, 3))
    depth = polygon(BOX).depth(points, HERE)
    assert depth.shape == (5, 7) and depth[2, 3] == polygon(BOX).depth(points[2, 3], HERE)


# --- fence items -----------------------------------------------------------------------------------------------------


def vertices(command: int, n: int, seq: int = 0) -> list[Item]:
    return [Item(seq=seq + k, command=command, param1=float(n), lat_e7=k, lon_e7=k * k) for k in range(n)]


def test_polygons_and_circles_of_a_fence_are_told_apart() -> None:
    circle = Item(seq=7, command=5004, param1=50.0, lat_e7=9, lon_e7=9)
    home = Item(seq=8, command=5000)
    areas, sentence = read_fence_items((*vertices(5001, 4), *vertices(5002, 3, 4), circle, home))
    assert not sentence and [(a.name, a.exclusion, len(a.vertices)) for a in areas] == [
        ("polygon of 4 points", False, 4),
        ("polygon of 3 points", True, 3),
        ("circle of 50 m", True, 1),
    ]


def test_two_polygons_of_one_kind_are_two() -> None:
    areas, sentence = read_fence_items((*vertices(5001, 4), *vertices(5001, 5, 4)))
    assert not sentence and [len(area.vertices) for area in areas] == [4, 5]


@pytest.mark.parametrize(
    ("items", "words"),
    [
        (vertices(5001, 4)[:3], "item 0 begins a polygon of 4 points, found 3"),
        (vertices(5001, 2), "item 0 begins a polygon of 2 points"),
        ([Item(seq=3, command=5003, param1=-1.0)], "item 3 has a radius of -1 m"),
        ([Item(seq=3, command=5003, param1=1e30)], "item 3 has a radius"),
        ([Item(seq=0, command=5001, param1=1e30)], "item 0 begins a polygon"),
        ([Item(seq=0, command=5001, param1=float("nan"))], "item 0 begins a polygon of nan points"),
        ([Item(seq=2, command=5004, param1=9.0, lat_e7=2**62)], "item 2 has no position on earth"),
        ([Item(seq=k, command=5002, param1=3.0, lon_e7=k * 2**40) for k in range(3)], "begins a polygon of 3 points"),
    ],
)
def test_damaged_fence_items_are_said(items: list[Item], words: str) -> None:
    areas, sentence = read_fence_items(tuple(items))
    assert not areas and words in sentence and sentence.endswith("upload it again")


# --- GeoJSON ---------------------------------------------------------------------------------------------------------


def written(tmp_path: Path, *features: dict) -> Path:
    path = tmp_path / "areas.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def feature(coordinates: list, kind: str = "Polygon", **properties: object) -> dict:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def test_areas_are_read(tmp_path: Path) -> None:
    first = feature([[*SQUARE, SQUARE[0]]], name="airfield", ceiling_m=900.0)
    second = feature([[SQUARE], [SQUARE]], "MultiPolygon", fence="inclusion")
    areas = read_areas(written(tmp_path, first, second))
    assert [(a.name, a.exclusion, a.floor, a.ceiling) for a in areas] == [
        ("airfield", True, -inf, 900.0),
        ("area 2", False, -inf, inf),
        ("area 2", False, -inf, inf),
    ]
    assert areas[0].vertices == tuple((round(lat * 1e7), round(lon * 1e7)) for lon, lat in SQUARE)


def test_the_example_of_the_documentation_is_read(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs" / "getting-started.md").read_text()
    lines = page[page.index('    {"type": "FeatureCollection"') :].splitlines()[:2]
    path = tmp_path / "areas.geojson"
    path.write_text("".join(lines))
    (village,) = read_areas(path)
    assert village.exclusion and village.ceiling == 700.0 and len(village.vertices) == 3


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (feature([SQUARE, SQUARE]), "feature 1: found 2 rings"),
        (feature([SQUARE[:2]]), "feature 1: found 2 vertices, expected 3 at least"),
        (feature([[[8.0, 91.0], *SQUARE]]), "feature 1: found a vertex [8.0, 91.0]"),
        (feature([[["x", 4.0], *SQUARE]]), "feature 1: found a vertex"),
        (feature(SQUARE[0], "Point"), "feature 1: found a Point"),
        (feature([SQUARE], floor_m=10.0, ceiling_m=10.0), "feature 1: found floor_m 10 and ceiling_m 10"),
        (feature([SQUARE], fence="maybe"), "expected a GeoJSON FeatureCollection"),
        ({"type": "Feature"}, "expected a GeoJSON FeatureCollection"),
        (feature([[[8.0, 47.0 + 1e-7 * k] for k in range(MAX_VERTICES + 1)]]), "more than 50000 vertices"),
    ],
)
def test_what_is_no_area_is_refused(tmp_path: Path, content: dict, words: str) -> None:
    with pytest.raises(ValueError, match=r"areas\.geojson") as error:
        read_areas(written(tmp_path, content))
    assert words in str(error.value)


@pytest.mark.parametrize("content", [b"", b"[" * 100_000, b"\xff\xfe", b'{"type":"FeatureCollection","features":[]}'])
def test_a_hostile_file_is_one_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "areas.geojson"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"areas\.geojson: found"):
        read_areas(path)
