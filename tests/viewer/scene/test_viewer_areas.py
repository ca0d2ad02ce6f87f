"""Geofence areas on the map: closed outlines on the ground, at the heights of the terrain where these are known."""

from types import SimpleNamespace

import numpy as np

from fleet.contract import Item
from fleet.terrain.areas import CIRCLE_OUT, Area
from tests.support.pretend_feed import HOME
from viewer.scene.routes import EDGE_PARTS, area_lines
from viewer.scene.scene import Scene
from viewer.store.place import UNIT_M, SceneFrame
from viewer.theme.palette import DARK

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


class Node:
    """A node that counts how often it is drawn."""

    def __init__(self) -> None:
        self.drawn = 0
        self.colors = np.zeros(0)

    def __setattr__(self, name: str, value: object) -> None:
        super().__setattr__(name, value)
        if name == "points":
            self.drawn += 1


def test_areas_and_fences_are_drawn_once_and_again_when_they_change() -> None:
    node = Node()
    viser_scene = SimpleNamespace(add_line_segments=lambda *_, **__: node)
    scene = Scene.__new__(Scene)
    scene._scene, scene._palette, scene._areas, scene._drawn_areas = viser_scene, DARK, None, ()
    scene.ground = SimpleNamespace(height=0.0)
    frame, areas, fence = SceneFrame(HOME), (FIELD,), tuple(circle_item(k) for k in range(2))
    scene.draw_areas((), (), frame, unknown)
    assert scene._areas is None and not node.drawn
    for _ in range(3):
        scene.draw_areas(areas, (fence,), frame, unknown)
    assert node.drawn == 1 and node.points.shape[0] == (3 + 2 * 72) * EDGE_PARTS
    scene.draw_areas(areas, (), frame, unknown)
    assert node.drawn == 2 and node.points.shape[0] == 3 * EDGE_PARTS


def circle_item(seq: int) -> Item:
    return Item(seq=seq, command=CIRCLE_OUT, param1=50.0 + seq, lat_e7=HOME.lat_e7, lon_e7=HOME.lon_e7)
