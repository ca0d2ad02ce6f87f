"""The measure tool and the altitude profile ahead: numbers, picking, texts, without a browser."""

from unittest.mock import MagicMock

import numpy as np
import pytest

from fleet.contract import Prediction
from tests.support.pretend_feed import HOME, PretendUav, T
from viewer.panels.charts import profile_heading
from viewer.scene.labels import CameraView
from viewer.scene.measure import Anchor, Measure, measure, measurement_text, pick
from viewer.scene.routes import NOTHING, mission_lines, route_ahead
from viewer.server.view import unknown_heights
from viewer.store.forecast import ScenePrediction
from viewer.store.place import UNIT_M, SceneFrame
from viewer.store.profile import STEPS, Surface, altitude_profile
from viewer.text.units import AVIATION, METRIC
from viewer.theme.palette import DARK

VIEW = CameraView(np.array([0.0, -100.0, 50.0]), np.zeros(3), np.radians(50), 1.6)
FLAT = Surface(unknown_heights, 0.0, 488.0)
DOWN = np.array([0.0, 100.0, -50.0])

# --- measuring ---


@pytest.mark.parametrize(
    ("east", "north", "up", "text"),
    [
        (300.0, 300.0, 120.0, "424 m, bearing 045°, altitude +120 m"),
        (-3000.0, 0.0, -0.2, "3.00 km, bearing 270°, altitude ±0 m"),
        (0.0, -250.0, -30.0, "250 m, bearing 180°, altitude −30 m"),
        (-0.5, 100.0, 0.0, "100 m, bearing 000°, altitude ±0 m"),  # rounds to north, not to 360
        (0.0, 0.0, 80.0, "0 m, altitude +80 m"),
    ],
)
def test_distance_bearing_and_altitude_difference(east: float, north: float, up: float, text: str) -> None:
    a = np.array([5.0, -3.0, 20.0])
    result = measure(a, a + np.array([east, north, up]) / UNIT_M)
    assert measurement_text(result, METRIC) == text
    assert result.slant_m == pytest.approx(np.linalg.norm([east, north, up]))
    back = measure(a + np.array([east, north, up]) / UNIT_M, a)
    assert back.climb_m == pytest.approx(-up) and back.distance_m == pytest.approx(result.distance_m)


def test_aviation_units_in_a_measurement() -> None:
    result = measure(np.zeros(3), np.array([0.0, 370.4, 30.48]))
    assert measurement_text(result, AVIATION) == "2.00 NM, bearing 000°, altitude +1,000 ft"
    assert AVIATION.distance_text(100.0) == "328 ft" and METRIC.distance_text(np.nan) == "–"


def test_a_ray_picks_an_aircraft_before_the_ground_and_nothing_in_the_sky() -> None:
    aircraft = Anchor("UAV-007", np.array([0.0, 0.0, 0.1]), 7)
    ray = VIEW.position, DOWN
    assert pick(ray, [aircraft], VIEW, unknown_heights, -5.0) is aircraft
    aside = Anchor("UAV-008", np.array([20.0, 0.0, 0.0]), 8)
    behind = Anchor("UAV-009", VIEW.position - DOWN, 9)
    ground = pick(ray, [aside, behind], VIEW, unknown_heights, -5.0)
    assert ground is not None and ground.uav is None and ground.at == pytest.approx([0, 10.0, -5.0], abs=1e-6)
    assert pick((VIEW.position, -DOWN), [aside], VIEW, unknown_heights, -5.0) is None
    assert pick((VIEW.position, np.zeros(3)), [], VIEW, unknown_heights, -5.0) is None


def test_a_ray_meets_the_first_slope_of_the_terrain() -> None:
    def ridge(points: np.ndarray) -> np.ndarray:
        return 30.0 - np.abs(points[:, 1] + 40.0)

    point = pick((VIEW.position, DOWN), [], VIEW, ridge, 0.0)
    assert point is not None and point.at == pytest.approx([0.0, -140 / 3, 70 / 3], abs=0.05)  # not the level behind it


def test_the_tool_says_what_to_do_and_a_moving_aircraft_takes_its_point_along() -> None:
    tool, at = Measure(MagicMock(), DARK), np.array([1.0, 2.0, 30.0])
    assert tool.html(METRIC) == "" and not tool.active
    tool.toggle()
    assert "press the first point" in tool.html(METRIC) and 'role="status"' in tool.html(METRIC)
    tool.add(None)
    assert "No ground or aircraft there" in tool.html(METRIC)
    tool.add(Anchor("UAV-<b>", at, 3))
    assert "From UAV-&lt;b&gt;: press the second point" in tool.html(METRIC)
    tool.add(Anchor("ground", np.zeros(3)))
    moved = at + np.array([10.0, 0.0, 0.0])
    tool.draw({3: moved}.get, 0.0, 2.0, METRIC)
    assert tool.tags[0].text == measurement_text(measure(moved, np.zeros(3)), METRIC)
    assert "line of sight" in tool.html(METRIC)
    tool.draw({}.get, 0.0, 2.0, METRIC)  # it is gone: its last position stays
    assert tool.tags[0].at == pytest.approx(moved / 2)
    tool.add(Anchor("item 4", at))
    assert "From item 4" in tool.html(METRIC)
    tool.toggle()
    tool.draw({}.get, 0.0, 2.0, METRIC)
    assert tool.tags == [] and tool.html(METRIC) == ""


# --- the profile ---


def forecast_of(uav: int = 0) -> ScenePrediction:
    message = PretendUav(uav).prediction(T, 0.0)
    assert isinstance(message, Prediction)
    return ScenePrediction(message, SceneFrame(HOME), 0.0)


def test_the_way_ahead_leads_once_round_the_mission() -> None:
    route = mission_lines(PretendUav(0).mission(T), SceneFrame(HOME), 0.0)
    at = np.array([1.0, 2.0, 3.0])
    way = route_ahead(route, 3, at)
    assert way[0] == pytest.approx(at) and way[1] == pytest.approx(route.points[3])  # item 3, after home
    assert way[-1] == pytest.approx(route.points[3]) and len(way) == 1 + 7 + 3
    assert len(route_ahead(route, -1, at)) == len(route_ahead(NOTHING, 3, at)) == 1


def test_profile_of_route_region_and_level_of_home() -> None:
    forecast, way = forecast_of(), np.array([[0, 0, 10.0], [100, 0, 10.0], [100, 300, 40.0]])
    profile = altitude_profile(way, forecast, (0.0, 20.0), FLAT)
    assert profile is not None and not profile.is_terrain and len(profile.distance_m) == STEPS
    assert (profile.ground_m == 488.0).all() and (np.diff(profile.distance_m) > 0).all()
    assert profile.route_m[0] == pytest.approx(588.0)
    at_corner = np.interp(1000.0, profile.distance_m, profile.route_m)
    assert at_corner == pytest.approx(588.0, abs=3)
    inside = np.isfinite(profile.predicted_m)
    path = forecast.position_at(np.linspace(0, 20, 60))
    flown = UNIT_M * np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum()
    assert profile.distance_m[inside].max() == pytest.approx(flown, abs=profile.distance_m[1])
    assert (profile.low_m[inside] <= profile.predicted_m[inside]).all()
    assert (profile.predicted_m[inside] <= profile.high_m[inside]).all()
    assert profile.distance_m[-1] == pytest.approx(min(4000.0, max(2000.0, 6 * flown)), rel=0.01)


def test_profile_on_terrain_says_where_the_region_is_lowest_above_it() -> None:
    forecast = forecast_of()

    def hill(points: np.ndarray) -> np.ndarray:
        middle = forecast.position_at(np.array([10.0]))[0]
        return 8.0 - np.linalg.norm(points[:, :2] - middle[:2], axis=1) / 10.0

    profile = altitude_profile(forecast.position_at(np.zeros(1)), forecast, (0.0, 20.0), Surface(hill, 0.0, 488.0))
    assert profile is not None and profile.is_terrain and np.isnan(profile.route_m).all()
    clearance, distance = profile.clearance_m or (np.nan, np.nan)
    assert profile.ground_m.max() == pytest.approx(568.0, abs=2)
    assert clearance == pytest.approx(np.nanmin(profile.low_m - profile.ground_m)) and 50 < distance < 350
    html = profile_heading(profile, (("ground", "#111111"), ("low", "#222222")), METRIC)
    assert "ground" in html and "low" not in html.replace("below", "") and "Prediction region at least" in html
    without = profile_heading(profile._replace(is_terrain=False), (("ground", "#111111"),), AVIATION)
    assert "level of home (no terrain file)" in without and " ft" in without


def test_no_way_ahead_has_no_profile_and_a_route_alone_has_one() -> None:
    still = np.zeros((1, 3))
    assert altitude_profile(still, None, (0.0, 0.0), FLAT) is None
    assert altitude_profile(np.zeros((2, 3)), None, (0.0, 0.0), FLAT) is None
    profile = altitude_profile(np.array([[0, 0, 5.0], [50, 0, 5.0]]), forecast_of(), (3.0, 3.0), FLAT)
    assert profile is not None and np.isnan(profile.predicted_m).all() and profile.clearance_m is None
    html = profile_heading(profile, (), METRIC)
    assert "Prediction region" not in html
