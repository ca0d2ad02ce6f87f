"""Maps without a network: the bundled world, MBTiles and PMTiles, SRTM heights, and what is refused and how."""

import gzip
import io
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import Writer

from fleet.frames import Origin
from fleet.terrain.raster import MERCATOR, Raster, read_raster, to_mercator, to_utm
from tests.support import pretend_feed
from tests.support.pretend_feed import HOME, Clock, T, feed_of
from viewer.scene.map import tiles
from viewer.scene.map.tiles import TILE_PX, open_tiles
from viewer.scene.map.world import FILE, ground_lines, overview_html, world
from viewer.scene.terrain import TerrainLayer, spread
from viewer.store.place import UNIT_M, SceneFrame
from viewer.theme.palette import DARK, LIGHT

LAT, LON = HOME.lat_e7 * 1e-7, HOME.lon_e7 * 1e-7
ZOOMS = (13, 14)
Tiles = dict[tuple[int, int, int], bytes]


def picture(colour: tuple[int, ...], kind: str = "PNG", size: int = TILE_PX) -> bytes:
    content = io.BytesIO()
    Image.new("RGBA" if len(colour) == 4 else "RGB", (size, size), colour).save(content, kind)
    return content.getvalue()


def tile_at(zoom: int, lat: float = LAT, lon: float = LON) -> tuple[int, int]:
    x, y = to_mercator(np.array(lat), np.array(lon))
    return int(x * 2**zoom), int(y * 2**zoom)


def around_home(kind: str = "PNG") -> Tiles:
    """Give tiles around HOME: red at the coarsest zoom, green at the finest, and nothing north of it there."""
    found: Tiles = {}
    for zoom, colour in zip(ZOOMS, ((200, 10, 10), (10, 200, 10)), strict=True):
        x, y = tile_at(zoom)
        for i in range(-9, 10):
            for j in range(0 if zoom == ZOOMS[1] else -9, 10):
                found[zoom, x + i, y + j] = picture(colour, kind)
    return found


def mbtiles(path: Path, content: Tiles, **metadata: str) -> Path:
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE metadata (name text, value text)")
        base.execute("CREATE TABLE tiles (zoom_level int, tile_column int, tile_row int, tile_data blob)")
        base.executemany("INSERT INTO metadata VALUES (?, ?)", metadata.items())
        rows = ((z, x, 2**z - 1 - y, data) for (z, x, y), data in content.items())
        base.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)
    base.close()
    return path


def pmtiles(path: Path, content: Tiles, kind: TileType = TileType.PNG) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        for identifier, data in sorted((zxy_to_tileid(*zxy), data) for zxy, data in content.items()):
            writer.write_tile(identifier, data)
        zooms = sorted({z for z, _, _ in content})
        header = {"tile_compression": Compression.NONE, "tile_type": kind, "min_zoom": zooms[0], "max_zoom": zooms[-1]}
        writer.finalize(header, {})
    return path


# --- the bundled world ---


def test_the_bundled_world_is_small_and_says_where_it_comes_from() -> None:
    lines = world()
    steps = np.abs(np.diff(lines.segments, axis=1))
    assert FILE.stat().st_size <= 300_000 and len(lines.segments) > 100_000 and steps.max() < 60
    assert np.abs(lines.segments[..., 0]).max() <= 180 and lines.segments[..., 1].min() > -90
    source = FILE.with_name("world.txt").read_text()
    assert "Natural Earth" in source and "public domain" in source and "Not for navigation" in source


@pytest.mark.parametrize(
    ("lat", "lon", "border", "within_m"),
    [
        (47.5596, 7.5886, True, 8_000.0),  # Basel, where three countries meet
        (50.9513, 1.8587, False, 4_000.0),  # Calais, at the sea
        (-33.8915, 151.2767, False, 3_000.0),  # Bondi Beach
        (64.1466, -21.9426, False, 4_000.0),  # Reykjavik
        (49.0, -105.03, True, 1_500.0),  # the straight border along the 49th parallel
    ],
)
def test_coast_and_borders_lie_where_they_are(lat: float, lon: float, border: bool, within_m: float) -> None:
    coast, borders = ground_lines(SceneFrame(Origin(round(lat * 1e7), round(lon * 1e7), 0)))
    near, far = (borders, coast) if border else (coast, borders)
    distances = [distance_m(lines) for lines in (near, far)]
    assert distances[0].min() < within_m and (not len(far) or distances[1].min() > within_m)
    assert (near[..., 2] == 0).all() and np.abs(near).max() * UNIT_M < 100_000


def distance_m(lines: np.ndarray) -> np.ndarray:
    """Give the distance of the origin from each segment, (n, 2, 3) [10 m]."""
    start, step = lines[:, 0], lines[:, 1] - lines[:, 0]
    share = np.clip(-(start * step).sum(axis=1) / (step * step).sum(axis=1).clip(1e-9), 0, 1)
    return np.linalg.norm(start + share[:, None] * step, axis=1) * UNIT_M


def test_lines_go_on_across_the_180th_meridian() -> None:
    """Taveuni, Fiji, lies on both sides of it."""
    coast, _ = ground_lines(SceneFrame(Origin(-168_000_000, 1_799_900_000, 0)))
    assert (coast[..., 0] < -1).any() and (coast[..., 0] > 1).any()
    assert np.linalg.norm(np.diff(coast, axis=1), axis=-1).max() * UNIT_M < 50_000


FIJI = Origin(-168_000_000, 1_799_999_000, 0)  # 10.6 m west of the 180 degree meridian


def test_a_raster_goes_on_across_the_180th_meridian() -> None:
    """Heights that grow eastwards by 1 m per step of 0.01 degrees, in degrees and in the square of web maps."""
    lat, lon = np.full(3, -16.8), np.array([179.95, 180.0, -179.95])
    columns = np.arange(21.0)[None, :].repeat(3, axis=0)
    degrees = Raster("dem", columns, np.array([[0.01, 0, 179.9], [0, -0.1, -16.7]]))
    assert degrees.sample(lat, lon) == pytest.approx([5, 10, 15], abs=1e-3)
    west = Raster("dem", columns, np.array([[0.01, 0, -180.1], [0, -0.1, -16.7]]))
    assert west.sample(lat, lon) == pytest.approx([5, 10, 15], abs=1e-3)
    _, y = to_mercator(np.array(-16.8), np.array(0.0))
    tiles = Raster("map", columns, np.array([[0.01 / 360, 0, 179.9 / 360 + 0.5], [0, 1e-4, float(y) - 1e-4]]), MERCATOR)
    assert tiles.sample(lat, lon) == pytest.approx([5, 10, 15], abs=1e-3)
    x, _ = to_utm(np.array([-16.8, -16.8]), np.array([179.999, -179.999]), 60, north=False)
    assert np.diff(x) == pytest.approx(0.002 * 111_320 * np.cos(np.radians(16.8)), rel=2e-3)


def drawn_at(home: Origin, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """Fly six aircraft around a place: all points of tracks, routes and predictions in the scene, (n, 3) [10 m]."""
    monkeypatch.setattr(pretend_feed, "HOME", home)
    clock = Clock()
    feed, fleet, _ = feed_of(clock, 6)
    for k in range(1, 150):
        clock.now += 0.2
        fleet.advance(T + k / 5)
        feed.poll()
    frame = feed.scene_frame
    assert frame is not None
    parts = []
    for vehicle in feed.all():
        parts.append(feed.track(vehicle)[:, 1:4])
        items = [item for item in fleet.uavs[vehicle.uav].mission(T).items if item.lat_e7]
        parts.append(frame.from_geodetic(*np.array([(i.lat_e7, i.lon_e7, i.alt_m * 1e3) for i in items]).T))
        if vehicle.forecast is not None:
            parts.append(np.array([vehicle.forecast.position_at(ahead) for ahead in (0.0, 5.0, 20.0, 40.0)]))
    return np.concatenate(parts)


def test_tracks_routes_and_predictions_are_the_same_on_the_180th_meridian(monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere, across = (drawn_at(Origin(FIJI.lat_e7, lon, 0), monkeypatch) for lon in (85_455_940, FIJI.lon_e7))
    assert len(across) > 300 and across == pytest.approx(elsewhere, abs=0.005)  # 5 cm: rounded to 1e-7 degrees


@pytest.mark.parametrize("palette", [DARK, LIGHT], ids=["dark", "light"])
def test_the_overview_shows_coast_border_and_position_and_says_so(palette) -> None:
    html = overview_html(SceneFrame(HOME), palette)
    assert palette.coast in html and palette.border in html and "47.40° N, 8.55° E" in html
    assert 'role="img"' in html and 'aria-label="Coast and borders around 47.40° N, 8.55° E."' in html
    assert len(html) < 60_000 and html.count("M") > 10 and "nan" not in html
    at_sea = overview_html(SceneFrame(Origin(-300_000_000, -1_200_000_000, 0)), palette)
    assert "No coast or border within this range" in at_sea


# --- tiles ---


@pytest.mark.parametrize("write", [mbtiles, pmtiles])
@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP"])
def test_tiles_lie_where_they_belong_and_finer_ones_cover_coarse_ones(write: Callable, kind: str, tmp_path) -> None:
    file = write(tmp_path / "region", around_home(kind))
    mosaic = open_tiles(str(file)).around(LAT, LON)
    _, y = tile_at(ZOOMS[1])
    edge = np.degrees(np.arctan(np.sinh(np.pi * (1 - 2 * y / 2 ** ZOOMS[1]))))  # latitude of the tile's north edge
    here, north, far = mosaic.sample(np.array([edge - 0.002, edge + 0.002, LAT + 5]), np.full(3, LON))
    assert here.argmax() == 1 and north.argmax() == 0 and np.isnan(far).all()
    assert mosaic.damaged == 0 and mosaic.tiles > 50 and len(mosaic.levels) == 2


def test_transparent_parts_and_damaged_tiles_leave_the_rest(tmp_path) -> None:
    content, (x, y) = around_home(), tile_at(ZOOMS[1])
    content[ZOOMS[1], x, y] = picture((0, 0, 255, 0))
    content[ZOOMS[1], x + 1, y] = b"no picture"
    content[ZOOMS[1], x - 1, y] = picture((0, 0, 255), size=tiles.MAX_TILE_PX + 1)
    layer = TerrainLayer(None, None, open_tiles(str(mbtiles(tmp_path / "some.mbtiles", content))))
    page = MagicMock(client_id=1)
    layer.show(page, SceneFrame(HOME), DARK, 0.0)
    assert layer.sentence.startswith("some.mbtiles: found 2 damaged tiles of ") and layer.available
    assert page.scene.add_mesh_trimesh.call_count == 1


def test_tiles_are_drawn_around_home_and_imagery_covers_them(tmp_path) -> None:
    photo = tmp_path / "photo.png"
    photo.write_bytes(picture((0, 0, 250)))
    imagery = read_raster(f"{photo}@{LAT - 0.001},{LON - 0.001},{LAT + 0.001},{LON + 0.001}", colours=True)
    layer = TerrainLayer(None, imagery, open_tiles(str(pmtiles(tmp_path / "p.pmtiles", around_home()))))
    page = MagicMock(client_id=1)
    layer.show(page, SceneFrame(HOME), DARK, -3.0)
    ground = page.scene.add_mesh_trimesh.call_args.args[1]
    texture = np.asarray(ground.visual.material.baseColorTexture).astype(int)
    side = len(texture)
    assert texture[side // 2, side // 2].argmax() == 2  # the photo
    assert texture[int(0.75 * side), side // 2].argmax() == 1 and layer.sentence == ""
    assert np.allclose(ground.vertices[:, 2], -3.1) and np.ptp(ground.vertices[:, 0]) * UNIT_M > 10_000


def test_tiles_of_another_place_are_reported(tmp_path) -> None:
    layer = TerrainLayer(None, None, open_tiles(str(mbtiles(tmp_path / "far.mbtiles", around_home()))))
    layer.show(MagicMock(client_id=1), SceneFrame(HOME._replace(lat_e7=-338_000_000)), DARK, 0.0)
    assert layer.sentence.startswith("far.mbtiles: found no tiles within 15 km") and not layer.available


def bomb() -> bytes:
    """A PMTiles file whose root directory grows from kilobytes to 64 MB."""
    root = gzip.compress(bytes(64_000_000))
    numbers = struct.pack("<11Q", 127, len(root), 0, 0, 0, 0, 127, 0, 0, 0, 0)
    return b"PMTiles\3" + numbers + bytes([1, 2, 1, 2, 11, 14]) + bytes(25) + root


def endless(path: Path) -> Path:
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE metadata (name text, value text)")
        base.execute(
            "CREATE VIEW tiles AS WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n) "
            "SELECT i AS zoom_level, 0 AS tile_column, 0 AS tile_row, x'00' AS tile_data FROM n"
        )
    base.close()
    return path


def test_what_is_no_map_is_refused_in_one_sentence(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tiles, "MAX_SQL_STEPS", 5)
    whole = pmtiles(tmp_path / "whole.pmtiles", around_home()).read_bytes()
    files = {
        "text.mbtiles": (b"hello", "found no tile archive"),
        "empty.mbtiles": (b"", "found no tile archive"),
        "header.mbtiles": (b"SQLite format 3\0" + bytes(500), "header.mbtiles: found "),
        "old.pmtiles": (b"PMTiles\2" + whole[8:], "PMTiles version 2 instead of 3"),
        "cut.pmtiles": (whole[:200], "cut.pmtiles: found "),
        "short.pmtiles": (whole[:60], "short.pmtiles: found "),
        "bomb.pmtiles": (bomb(), "a directory above"),
        "brotli.pmtiles": (whole[:97] + b"\3" + whole[98:], "directories compressed with BROTLI"),
        "odd.pmtiles": (whole[:99] + b"\xee" + whole[100:], "odd.pmtiles: found "),
        "deep.pmtiles": (whole[:101] + b"\x63" + whole[102:], "zoom levels 13 to 99"),
    }
    for name, (data, words) in files.items():
        (tmp_path / name).write_bytes(data)
        files[name] = data, words
    mbtiles(tmp_path / "vector.mbtiles", around_home(), format="pbf")
    mbtiles(tmp_path / "none.mbtiles", {})
    endless(tmp_path / "endless.mbtiles")
    pmtiles(tmp_path / "vector.pmtiles", around_home(), TileType.MVT)
    expected = {name: words for name, (_, words) in files.items()}
    expected |= {"vector.mbtiles": "tiles of the format 'pbf'", "none.mbtiles": "found no tiles"}
    expected |= {"endless.mbtiles": "found interrupted", "vector.pmtiles": "tiles of the format MVT"}
    for name, words in expected.items():
        with pytest.raises(ValueError, match="expected raster tiles") as refused:
            open_tiles(str(tmp_path / name))
        text = str(refused.value)
        assert words in text and text.startswith(name) and "\n" not in text and len(text) < 300, text
    with pytest.raises(ValueError, match="--map: found no file"):
        open_tiles(str(tmp_path / "nosuch.mbtiles"))


def test_an_archive_that_breaks_later_is_reported_and_the_page_goes_on(tmp_path) -> None:
    file = mbtiles(tmp_path / "breaks.mbtiles", around_home())
    map_ = open_tiles(str(file))
    with sqlite3.connect(file) as base:
        base.execute("DROP TABLE tiles")
    base.close()
    layer, page = TerrainLayer(None, None, map_), MagicMock(client_id=1)
    layer.show(page, SceneFrame(HOME), DARK, 0.0)
    assert layer.sentence.startswith("breaks.mbtiles: found no such table") and page.scene.add_line_segments.called


# --- heights ---


def test_srtm_heights_are_read_by_the_name_of_the_file(tmp_path) -> None:
    values = np.repeat(np.arange(1201, dtype=">i2")[:, None], 1201, axis=1)
    values[600, 700] = -32768
    (tmp_path / "N47E008.hgt").write_bytes(values.tobytes())
    (tmp_path / "S34W071.HGT").write_bytes(values.tobytes())
    north = read_raster(str(tmp_path / "N47E008.hgt"), colours=False)
    assert float(north.sample(48.0, 8.5)) == 0 and float(north.sample(47.25, 8.5)) == pytest.approx(900)
    assert np.isnan(north.sample(47.5, 8 + 700 / 1200)) and np.isnan(north.sample(48.1, 8.5))
    south = read_raster(str(tmp_path / "S34W071.HGT"), colours=False)
    assert float(south.sample(-33.25, -70.5)) == pytest.approx(300)
    for name, size in (("N47E008.hgt", 100), ("hill.hgt", 2 * 1201**2)):
        (tmp_path / name).write_bytes(bytes(size))
        with pytest.raises(ValueError, match=f"{name}: found .*expected a name such as .*; rename it or download"):
            read_raster(str(tmp_path / name), colours=False)


def test_heights_under_scene_points_and_a_grid_that_is_dense_near_the_origin(tmp_path) -> None:
    values = np.full((1201, 1201), 700, ">i2")
    (tmp_path / "N47E008.hgt").write_bytes(values.tobytes())
    layer = TerrainLayer(read_raster(str(tmp_path / "N47E008.hgt"), colours=False), None)
    points = np.array([[0.0, 0.0, 5.0], [10.0, -20.0, 0.0], [9e3, 0.0, 0.0]])
    assert np.isnan(layer.heights(points)).all()  # before the scene has an origin
    layer.show(MagicMock(client_id=1), SceneFrame(HOME), DARK, 0.0)
    heights = layer.heights(points)
    assert heights[:2] == pytest.approx((700 - HOME.alt_mm * 1e-3) / UNIT_M, abs=1e-4) and np.isnan(heights[2])
    steps = np.diff(spread(-1500.0, 1500.0, 161))
    assert steps.sum() == pytest.approx(3000) and steps[80] < 6 and steps[0] > 40 and (steps > 0).all()
