"""Geofence areas on the map: closed outlines on the ground, at the heights of the terrain where these are known."""

import numpy as np

from fleet.terrain.areas import Area
from tests.support.pretend_feed import HOME
from viewer.scene.routes import EDGE_PARTS, area_lines
from viewer.store.place import UNIT_M, SceneFrame

CORNERS = ((0, 0), (0, 40_000), (20_000, 40_000))
FIELD = Area("field", tuple((HOME.lat_e7 + n, HOME.lon_e7 + e) for n, e in CORNERS), exclusion=True)


def unknown(points: np.ndarray) -> np.ndarray:
    return np.full(len(points), np.nan)


def test_an_outline_is_closed_and_lies_on_the_ground() -> None:
    lines = area_lines(FIELD, SceneFrame(HOME), unknown, -2.0)
    assert lines.shape == (3 * EDGE_PARTS, 2, 3) and np.array_equal(lines[1:, 0], lines[:-1, 1])
    assert np.array_equal(lines[0, 0], lines[-1, 1]) and (lines[..., 2] == -2.0).all()
    corners = lines[::EDGE_PARTS, 0]
    north = np.radians(20_000e-7) * 6_367_000 / UNIT_M
    assert np.allclose(corners[:, 1], [0.0, 0.0, north], rtol=0.01) and corners[1, 0] > 0.0 == corners[0, 0]


def test_it_follows_the_terrain_where_that_is_known() -> None:
    def slope(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 0] < 10.0, 0.1 * points[:, 0], np.nan)

    lines = area_lines(FIELD, SceneFrame(HOME), slope, -2.0)
    near = lines[..., 0] < 10.0
    assert np.allclose(lines[..., 2][near], 0.1 * lines[..., 0][near]) and (lines[..., 2][~near] == -2.0).all()


def test_a_circle_is_round() -> None:
    circle = FIELD._replace(vertices=FIELD.vertices[:1], radius=80.0)
    lines = area_lines(circle, SceneFrame(HOME), unknown, 0.0)
    assert np.allclose(np.hypot(*lines[..., :2].reshape(-1, 2).T) * UNIT_M, 80.0, atol=0.5)
