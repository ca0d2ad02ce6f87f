"""Ways around an area: they keep the distance, lie on the side that was asked for, and leave the rest as it is."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from fleet.frames import Origin
from fleet.terrain.areas import Area
from twin_worker.proposals.detour import Detour, way_around

SQUARE = np.array([[900.0, -100.0], [900.0, 100.0], [1100.0, 100.0], [1100.0, -100.0]])  # north, east
ROUTE = np.array([[0.0, 0.0], [2000.0, 0.0], [2000.0, 2000.0]])
ORIGIN = Origin(470_000_000, 80_000_000, 0)


def flown(route: np.ndarray, detour: Detour) -> np.ndarray:
    """Return points every metre along the changed route."""
    points = np.vstack([route[: detour.first + 1], detour.corners, route[detour.last :]])
    lines = [a + np.linspace(0, 1, max(int(np.hypot(*(b - a))), 2))[:, None] * (b - a) for a, b in pairwise(points)]
    return np.concatenate(lines)


def nearest(points: np.ndarray, outline: np.ndarray) -> float:
    """Return the smallest distance to the outline, negative inside, by way of latitudes and longitudes [m]."""
    from fleet.frames import to_geodetic

    ned = np.column_stack([outline, np.zeros(len(outline))])
    lat, lon, _ = to_geodetic(ORIGIN, ned).T
    area = Area("area", tuple(zip(lat.astype(int).tolist(), lon.astype(int).tolist(), strict=True)), exclusion=True)
    return -float(area.depth(np.column_stack([points, np.zeros(len(points))]), ORIGIN).max())


@pytest.mark.parametrize(("right", "side"), [(True, 1.0), (False, -1.0)])
def test_an_area_on_the_way_is_passed_on_the_side_asked_for(right: bool, side: float) -> None:
    detour = way_around(ROUTE, SQUARE, 50.0, right=right)
    assert detour is not None and (detour.first, detour.last) == (0, 1) and 1 <= len(detour.corners) <= 4
    assert (detour.corners[:, 1] * side > 100.0).all() and (np.diff(detour.corners[:, 0]) > 0).all()  # right is east
    assert 49.0 < nearest(flown(ROUTE, detour), SQUARE) < 120.0


def test_items_within_the_distance_are_left_out() -> None:
    route = np.array([[0.0, 0.0], [800.0, 0.0], [1000.0, 20.0], [1120.0, 0.0], [3000.0, 0.0]])
    detour = way_around(route, SQUARE, 60.0, right=True)
    assert detour is not None and (detour.first, detour.last) == (1, 4)
    assert nearest(flown(route, detour), SQUARE) > 59.0


@pytest.mark.parametrize(
    "route",
    [
        [[0.0, 500.0], [2000.0, 500.0]],  # passes clear of it
        [[1000.0, 0.0], [2000.0, 0.0]],  # begins inside
        [[0.0, 0.0], [1000.0, 0.0]],  # ends inside
    ],
)
def test_where_there_is_no_way_around_there_is_none(route: list[list[float]]) -> None:
    assert way_around(np.array(route), SQUARE, 50.0, right=True) is None


POINT = st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000))


@example(route=[(0.0, 0.0), (2.225e-313, -2.0)], corners=[(0.0, 0.0), (0.0, 6.0), (6.0, 0.0)], margin=10.0, right=False)
@given(
    st.lists(POINT, min_size=2, max_size=6), st.lists(POINT, min_size=3, max_size=7), st.floats(10, 200), st.booleans()
)
def test_no_detour_comes_nearer_than_asked(route: list, corners: list, margin: float, right: bool) -> None:
    points, outline = np.array(route), np.array(corners) / 5.0
    assume(np.linalg.matrix_rank(outline - outline[0], tol=1.0) == 2)
    assume((np.hypot(*np.diff(points, axis=0).T) > 1.0).all())
    detour = way_around(points, outline, margin, right=right)
    if detour is None:
        return
    changed = np.vstack([points[: detour.first + 1], detour.corners, points[detour.last : detour.last + 1]])
    part = flown(changed, Detour(len(changed) - 1, len(changed), np.empty((0, 2))))
    assert nearest(part, outline) > margin - 1.5
