"""The ground from files: where a raster lies, heights and contours in the scene, what is refused and how."""

from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from fleet.terrain.raster import KEYS, NO_DATA, SCALE, TIEPOINT, read_raster, to_utm
from tests.support.pretend_feed import HOME
from viewer.scene.terrain import MAX_CONTOURS, HeightGrid, TerrainLayer, contours
from viewer.store.place import UNIT_M, SceneFrame
from viewer.theme.palette import DARK

LAT, LON = HOME.lat_e7 * 1e-7, HOME.lon_e7 * 1e-7


def geotiff(path: Path, values: np.ndarray, corner: tuple[float, float], step: float, **keys: int) -> Path:
    """Write one as others do: scale, tie point of the north-western corner, keys."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, kind, value in (
        (SCALE, 12, (step, step, 0.0)),
        (TIEPOINT, 12, (0.0, 0.0, 0.0, *corner, 0.0)),
        (KEYS, 3, (1, 1, 0, len(keys), *(n for k, v in keys.items() for n in (int(k[1:]), 0, 1, v)))),
    ):
        tags.tagtype[tag] = kind
        tags[tag] = value
    tags.tagtype[NO_DATA], tags[NO_DATA] = 2, "-9999"
    Image.fromarray(values).save(path, tiffinfo=tags, compression="tiff_lzw")
    return path


def hill(n: int = 200, step: float = 2e-4) -> tuple[np.ndarray, tuple[float, float]]:
    """Give heights that rise one metre a row southwards from 500 m, round HOME, with a hole."""
    values = np.repeat(500.0 + np.arange(n, dtype=np.float32)[:, None], n, axis=1)
    values[:5, :5] = -9999
    return values, (LON - n / 2 * step, LAT + n / 2 * step)


@pytest.fixture
def degrees(tmp_path: Path) -> str:
    values, corner = hill()
    return str(geotiff(tmp_path / "dem.tif", values, corner, 2e-4, k1024=2, k1025=1, k2048=4326))


# --- where it lies ---


@pytest.mark.parametrize(
    ("lat", "lon", "zone", "north", "easting", "northing"),
    [
        (43.642567, -79.387139, 17, True, 630084.30, 4833438.55),  # CN Tower, as published with the definition of UTM
        (0.0, 3.0, 31, True, 500_000.0, 0.0),
        (-33.8568, 151.2153, 56, False, 334_900.0, 6_252_200.0),  # Sydney Opera House, to 100 m
    ],
)
def test_a_place_in_metres_of_its_zone(lat, lon, zone, north, easting, northing) -> None:
    e, n = to_utm(np.array(lat), np.array(lon), zone, north=north)
    slack = 100 if zone == 56 else 1.0
    assert abs(float(e) - easting) < slack and abs(float(n) - northing) < slack


def test_heights_are_found_where_they_lie_and_nowhere_else(degrees: str) -> None:
    raster = read_raster(degrees, colours=False)
    assert float(raster.sample(LAT - 1e-4, LON)) == pytest.approx(600.0, abs=0.01)  # the middle of row 100
    assert float(raster.sample(LAT + 0.01, LON)) == pytest.approx(549.5, abs=0.01)
    assert np.isnan(raster.sample(np.array([LAT + 0.5, LAT]), np.array([LON, LON + 0.5]))).all()
    assert np.isnan(raster.sample(LAT + 0.0199, LON - 0.0199))  # no data


def test_the_same_hill_in_utm_lies_in_the_same_place(tmp_path: Path) -> None:
    e, n = (float(x) for x in to_utm(np.array(LAT), np.array(LON), 32, north=True))
    values = np.repeat(500.0 + np.arange(200, dtype=np.float32)[:, None], 200, axis=1)
    path = geotiff(tmp_path / "utm.tif", values, (e - 1000, n + 1000), 10.0, k1024=1, k1025=1, k3072=32632)
    raster = read_raster(str(path), colours=False)
    assert float(raster.sample(LAT, LON)) == pytest.approx(599.5, abs=0.1)


@pytest.mark.parametrize("way", ["bounds", "world"])
def test_a_picture_with_bounds_or_a_world_file(tmp_path: Path, way: str) -> None:
    pixels = np.zeros((100, 200, 3), np.uint8)
    pixels[:50, :, 0], pixels[50:, :, 2] = 200, 90
    path = tmp_path / "aerial@2020.png"
    Image.fromarray(pixels).save(path)
    text = str(path)
    if way == "bounds":
        text += f"@{LAT - 0.01},{LON - 0.02},{LAT + 0.01},{LON + 0.02}"
    else:
        path.with_suffix(".pgw").write_text(f"0.0002\n0\n0\n-0.0002\n{LON - 0.0199}\n{LAT + 0.0099}\n")
    raster = read_raster(text, colours=True)
    assert raster.sample(LAT + 0.005, LON)[0] == 200 and raster.sample(LAT - 0.005, LON + 0.019)[2] == 90
    assert np.isnan(raster.sample(LAT + 0.0101, LON)).all()


# --- what is refused ---


def test_what_is_no_raster_is_refused_in_one_sentence(tmp_path: Path, degrees: str) -> None:
    junk, png, other = tmp_path / "junk.tif", tmp_path / "plain.png", tmp_path / "lambert.tif"
    junk.write_bytes(b"II*\0" + bytes(range(200)))
    Image.fromarray(np.zeros((9, 9), np.uint8)).save(png)
    geotiff(other, hill()[0], (6e5, 2e5), 25.0, k1024=1, k3072=2056)
    cut = tmp_path / "cut.tif"
    cut.write_bytes(Path(degrees).read_bytes()[:3_000])
    for text, words in (
        (str(junk), "junk.tif: found "),
        (str(png), "plain.png: found no georeference"),
        (f"{png}@9,1,3,4", "found bounds 9,1,3,4"),
        (str(other), "found projection EPSG:2056"),
        (str(cut), "cut.tif: found "),
    ):
        with pytest.raises(ValueError, match="expected") as refused:
            read_raster(text, colours=False)
        assert words in str(refused.value) and "\n" not in str(refused.value)
    colour = tmp_path / "rgb.png"
    Image.fromarray(np.zeros((9, 9, 3), np.uint8)).save(colour)
    with pytest.raises(ValueError, match="expected one band of metres"):
        read_raster(f"{colour}@1,2,3,4", colours=False)
    with pytest.raises(ValueError, match="check the path"):
        read_raster(str(tmp_path / "none.tif"), colours=False)


# --- in the scene ---


def client(number: int) -> MagicMock:
    return MagicMock(client_id=number)


def test_the_ground_is_laid_once_and_shown_once_on_every_page(degrees: str) -> None:
    land, place = TerrainLayer(read_raster(degrees, colours=False), None), SceneFrame(HOME)
    pages = client(1), client(2)
    for page in (*pages, *pages):
        land.show(page, None, DARK, 0.0)
        land.show(page, place, DARK, 0.0)
    for page in pages:
        name, ground = page.scene.add_mesh_trimesh.call_args.args
        assert page.scene.add_mesh_trimesh.call_count == 1 and name == "/terrain/ground"
    z = ground.vertices[np.unique(ground.faces)][:, 2] * UNIT_M + HOME.alt_mm * 1e-3
    assert 500 <= z.min() < 506 and 692 < z.max() <= 700  # and no hole at -9999
    x, y = ground.vertices[:, :2].T * UNIT_M
    assert np.ptp(x) == pytest.approx(0.04 * 111_200 * np.cos(np.radians(LAT)), rel=0.1)
    south, north = ground.vertices[y < -1500][:, 2], ground.vertices[y > 1500][:, 2]
    assert np.median(south) > np.median(north) and land.sentence == ""


def test_a_picture_without_heights_lies_flat_and_one_of_elsewhere_is_said(tmp_path: Path, degrees: str) -> None:
    path = tmp_path / "aerial.png"
    Image.fromarray(np.full((40, 40, 3), 128, np.uint8)).save(path)
    picture = read_raster(f"{path}@{LAT - 0.01},{LON - 0.01},{LAT + 0.01},{LON + 0.01}", colours=True)
    page = client(1)
    TerrainLayer(None, picture).show(page, SceneFrame(HOME), DARK, -7.0)
    assert np.allclose(page.scene.add_mesh_trimesh.call_args.args[1].vertices[:, 2], -7.1)
    abroad = TerrainLayer(read_raster(degrees, colours=False), picture)
    abroad.show(client(2), SceneFrame(HOME._replace(lat_e7=-338_000_000)), DARK, 0.0)
    assert abroad.sentence.startswith("dem.tif and aerial.png: found no data within 15 km")


def test_contours_lie_at_whole_steps_and_are_few() -> None:
    n = 60
    e = np.linspace(-50, 50, n)
    up = np.exp(-(e[:, None] ** 2 + e**2) / 800) * 30.0
    up[:4, :4] = np.nan
    lines = contours(HeightGrid(e, e, up))
    levels = np.unique(np.round((lines[..., 2] - 0.05) * UNIT_M, 3))
    assert np.allclose(levels % 20, 0) and 4 < len(levels) <= MAX_CONTOURS
    assert np.isfinite(lines).all()
    where = lines.reshape(-1, 3)[::50]
    true = np.exp(-(where[:, 0] ** 2 + where[:, 1] ** 2) / 800) * 30.0
    assert np.abs(true - where[:, 2]).max() < 0.3
