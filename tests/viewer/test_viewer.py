"""The viewer without a browser: colours, epochs, frames, the shape of doubt, hostile missions, words."""

import numpy as np
import pytest

from fleet.contract import (
    Alert,
    AlertKind,
    Array,
    Controller,
    FleetRow,
    FleetState,
    Item,
    Link,
    Mission,
    Model,
    Outcome,
    Prediction,
    Status,
    TwinState,
    Verdict,
)
from fleet.frames import Origin, body_to_ned, to_geodetic
from tests.support.pretend_feed import HOME, HOSTILE, STAMP, Clock, PretendUav, T, feed_of, fields
from viewer.panels.charts import axis_range, band
from viewer.panels.detail import figures_html, law_html, limitations, status_html
from viewer.panels.panels import event_list_html
from viewer.scene.camera import FOV, frame, within_reach
from viewer.scene.routes import mission_lines
from viewer.scene.scene import DASHES, cut_at_horizon
from viewer.scene.selection.pins import curtain, marked_look_aheads, rings, tube_faces
from viewer.server.view import FRAME_MARGIN, outgrown
from viewer.store.place import UNIT_M, SceneFrame, scene_quat
from viewer.text.words import summary_html, table
from viewer.theme.palette import _EXPOSURE, _IN, _OUT, DARK, LIGHT, line_colour, rgb
from viewer.theme.shapes import aircraft, diamond, rotorcraft


@pytest.fixture
def clock() -> Clock:
    return Clock()


# --- colours ---


def displayed_colour(vertex: np.ndarray) -> np.ndarray:
    """As the renderer shows a vertex colour: (..., 3) [0..255] -> (..., 3) sRGB [0..255]."""
    v = (np.asarray(vertex, float) / 255 / _EXPOSURE) @ _IN.T
    v = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
    c = np.clip(v @ _OUT.T, 0, 1)
    return 255 * np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("palette", [DARK, LIGHT], ids=["dark", "light"])
def test_a_line_is_shown_in_the_colour_asked_for(palette) -> None:
    reached = 0
    for name in (
        "predicting",
        "verified",
        "identifying",
        "lost",
        "mismatch",
        "horizon",
        "muted",
        "tube",
        "route",
        "ring",
    ):
        wanted = rgb(getattr(palette, name))
        vertex = line_colour(wanted)
        if vertex.min() > 0 and vertex.max() < 255:  # else the tone mapping cannot show it at all
            reached += 1
            assert np.abs(displayed_colour(vertex) - wanted).max() < 3, name
    assert reached >= 5


def test_without_the_inversion_a_line_would_be_washed_out() -> None:
    assert np.abs(displayed_colour(rgb("#56B4E9")) - [185, 214, 222]).max() <= 1  # as measured in the browser


# --- frames ---


def test_positions_land_where_they_should() -> None:
    place = SceneFrame(HOME)
    ned = np.array([[100.0, 250.0, -40.0], [-3000.0, 20.0, 5.0]])
    scene = place.from_geodetic(*to_geodetic(HOME, ned).T)
    assert np.allclose(scene * UNIT_M, [[250, 100, 40], [20, -3000, -5]], atol=0.02)


def test_a_path_from_another_origin_lands_on_the_same_spot() -> None:
    lat, lon, alt = to_geodetic(HOME, np.array([[900.0, -700.0, -120.0]]))[0]
    other, place = Origin(int(lat), int(lon), int(alt)), SceneFrame(HOME)
    ned = np.array([[10.0, 20.0, -30.0]])
    assert np.allclose(place.from_ned(other, ned), place.from_ned(HOME, ned + np.array([900, -700, -120])), atol=0.01)


@pytest.mark.parametrize(("phi", "theta", "psi"), [(0, 0, 0), (0.5, 0.2, 1.0), (-0.4, -0.3, 3.0), (0.1, 0.6, -2.0)])
def test_the_mesh_points_where_the_aircraft_points(phi: float, theta: float, psi: float) -> None:
    angles = (np.array([phi]), np.array([theta]), np.array([psi]))
    w, x, y, z = scene_quat(*angles)[0]
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    for mesh, body in (([1, 0, 0], [1, 0, 0]), ([0, 1, 0], [0, -1, 0]), ([0, 0, 1], [0, 0, -1])):
        n, e, d = body_to_ned(*angles, np.array([body], float))[0]
        assert np.allclose(turn @ mesh, [e, n, -d], atol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, 9.5e8, 4e8])
def test_a_place_off_this_earth_or_far_away_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="position"):
        SceneFrame(HOME).from_geodetic(np.array([bad]), np.array([8e7]), np.array([0.0]))


# --- shapes ---


@pytest.mark.parametrize("apart", [1_000.0, 5_000.0])
def test_however_far_apart_somebody_is_in_view(apart: float) -> None:
    points = np.array([[0.0, 0.0, 0.0], [apart, 0.0, 0.0]])
    assert len(within_reach(points, 2_000.0)) == (2 if apart < 2_000 else 1)


def test_the_picture_moves_only_when_a_path_has_outgrown_it() -> None:
    framed, spare = np.array([[0, 0, 0], [100.0, 0, 0]]), 0.4 * (FRAME_MARGIN - 1) * 100
    assert not outgrown(np.array([[-0.9 * spare, 0, 0], [100 + 0.9 * spare, 0, 0]]), framed)
    assert outgrown(np.array([[50, 1.1 * spare, 0]]), framed) and outgrown(np.array([[-1.1 * spare, 0, 0]]), framed)


def test_the_tube_is_as_wide_as_told() -> None:
    path = np.stack([np.linspace(0, 50, 21), np.zeros(21), np.full(21, 10.0)], axis=-1)
    axes = np.tile([3.0, 2.0, 0.5], (21, 1))
    hoops = rings(path, axes)
    assert np.allclose(np.ptp(hoops[:, :, 1], axis=1), 4.0)
    assert np.allclose(np.ptp(hoops[:, :, 2], axis=1), 1.0)
    assert tube_faces(21).max() == hoops.shape[0] * hoops.shape[1] - 1


def test_the_tube_stays_finite_where_the_path_stands_still_or_climbs_upright() -> None:
    still, upright = np.zeros((9, 3)), np.stack([np.zeros(9), np.zeros(9), np.arange(9.0)], axis=-1)
    stop = np.vstack([np.linspace([0, 0, 0], [5, 5, 0], 5), np.tile([5, 5, 0], (4, 1))])
    for path in (still, upright, stop, stop[::-1]):
        hoops = rings(path, np.ones((len(path), 3)))
        assert np.isfinite(hoops).all()
        assert np.allclose(np.linalg.norm(hoops - path[:, None], axis=2), 1.0)
        assert np.isfinite(curtain(path, -2.0)[0]).all()


def test_dashes_end_at_the_horizon_and_begin_at_the_aircraft() -> None:
    ahead = np.linspace(0, 40, 81)
    path = np.stack([ahead, 0 * ahead, 0 * ahead], axis=-1)
    cut = cut_at_horizon(ahead, path, 3.0, 17.0)
    assert cut.shape == (DASHES, 2, 3)
    assert cut[0, 0, 0] == pytest.approx(3.0) and cut[-1, 1, 0] == pytest.approx(17.0)
    spent = cut_at_horizon(ahead, path, 30.0, 17.0)  # the horizon has passed: nothing is claimed
    assert np.array_equal(spent[:, 0], spent[:, 1])


def test_time_marks_leave_room_before_the_horizon() -> None:
    assert marked_look_aheads(26.0) == [5, 10, 20]
    assert marked_look_aheads(4.0) == []


def test_the_camera_sees_every_point() -> None:
    points = np.random.default_rng(7).uniform(-90, 90, (200, 3)) * [1, 1, 0.2] + [400, -30, 10]
    for aspect in (0.7, 1.0, 1.8):
        eye, look_at = frame(points, aspect)
        ahead = (look_at - eye) / np.linalg.norm(look_at - eye)
        right = np.cross(ahead, [0, 0, 1.0]) / np.linalg.norm(np.cross(ahead, [0, 0, 1.0]))
        depth = (points - eye) @ ahead
        x = (points - eye) @ right / depth / np.tan(FOV / 2) / aspect
        y = (points - eye) @ np.cross(right, ahead) / depth / np.tan(FOV / 2)
        assert depth.min() > 0 and max(np.abs(x).max(), np.abs(y).max()) < 1.02
        assert max(np.abs(x).max(), np.abs(y).max()) > 0.85  # and not from the moon


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.ones((4, 3)), np.array([[0, 0, 0], [0, 0, 1e-9]])])
def test_the_camera_stands_off_however_little_there_is_to_see(points: np.ndarray) -> None:
    eye, look_at = frame(points, 1.5)
    assert np.isfinite([eye, look_at]).all() and np.linalg.norm(eye - points[0]) > 3


@pytest.mark.parametrize("shape", [aircraft, rotorcraft, diamond])
def test_every_shape_is_a_sound_mesh(shape) -> None:
    vertices, faces = shape()
    assert np.isfinite(vertices).all() and faces.min() == 0 and faces.max() == len(vertices) - 1
    assert 0.3 < np.ptp(vertices, axis=0).max() <= 2.6


def test_the_nose_is_in_front() -> None:
    vertices, _ = aircraft()
    assert vertices[:, 0].max() > -vertices[:, 0].min() * 0.9


# --- missions ---


def test_a_route_joins_its_items_at_their_heights() -> None:
    one = PretendUav(2)
    found = mission_lines(one.mission(T), SceneFrame(HOME), ground=-3.0)
    assert found.legs.shape == (8, 2, 3) and found.returns.shape == (1, 2, 3) and len(found.circles) == 48
    assert np.allclose(found.legs[0, 0, 2] * UNIT_M, -one.ned(-one.phase / one.rate)[2], atol=0.5)
    radii = np.linalg.norm(found.circles[:, 0, :2] - found.legs[-1, 1, :2], axis=1) * UNIT_M
    assert np.allclose(radii, 70, atol=0.5)


NAN, FAR = float("nan"), 900_000_000
HOSTILE_ITEMS = {
    "no items": (),
    "home only": (Item(seq=0, command=16, frame=0),),
    "nan altitude": (Item(seq=0, command=16, lat_e7=1, lon_e7=1, alt_m=NAN), Item(seq=1, command=22, alt_m=NAN)),
    "jump to itself": (Item(seq=0, command=177, param1=0), Item(seq=1, command=177, param1=NAN)),
    "jump loop": tuple(Item(seq=k, command=177, param1=1 - k, param2=-1) for k in range(2)),
    "no length": tuple(Item(seq=k, command=16, lat_e7=HOME.lat_e7, lon_e7=HOME.lon_e7) for k in range(4)),
    "other side": tuple(Item(seq=k, command=16, lat_e7=-k * FAR, lon_e7=2 * FAR) for k in range(4)),
    "huge": (Item(seq=0, command=19, lat_e7=2**62, lon_e7=-(2**62), alt_m=1e300, param3=1e300),),
    "wild radius": tuple(
        Item(seq=k, command=c, lat_e7=HOME.lat_e7, lon_e7=HOME.lon_e7, param2=r, param3=r)
        for k, (c, r) in enumerate([(17, NAN), (18, 1e9), (31, -80.0), (19, 0.0), (20, NAN), (999, 1.0)])
    ),
}


@pytest.mark.parametrize("items", HOSTILE_ITEMS.values(), ids=HOSTILE_ITEMS)
def test_a_hostile_mission_is_survived(items: tuple[Item, ...]) -> None:
    found = mission_lines(Mission(uav=0, t=T, items=items), SceneFrame(HOME), ground=0.0)
    for part in found:
        assert np.isfinite(part).all()
    assert all(part.shape[1:] == (2, 3) for part in found[:3])
    assert (np.linalg.norm(found.legs[:, 1] - found.legs[:, 0], axis=1) > 0).all()


# --- words ---


def test_what_comes_over_the_bus_is_escaped_everywhere(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 2, hostile=0)
    bus.publish(Alert(uav=0, t=T, kind=AlertKind.GROUND, sentence=HOSTILE))
    page = status_html(feed.vehicles[0], DARK, clock.now) + figures_html(feed.vehicles[0], clock.now)
    page += event_list_html(feed.vehicles[0].events, DARK) + summary_html(feed.all(), feed, DARK, clock.now)
    page += table(feed.all(), DARK, clock.now, total=2, pick="{}", selected=0)
    assert "<img" not in page and page.count("&lt;img") >= 6


def test_who_has_no_prediction_is_told_why(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 2)
    assert "needs a plausible model" in " ".join(limitations(feed.vehicles[1], clock.now))
    assert "window has 41 samples" in status_html(feed.vehicles[1], DARK, clock.now)
    bus.publish(Status(uav=1, t=T, link=Link.LOST, sentence="no heartbeat for 6 s"))
    clock.now += 6
    told = " ".join(limitations(feed.vehicles[1], clock.now))
    assert "No sample for 6 s" in told and "check the radio link" in told and "no heartbeat" not in told


def test_the_panel_says_measured_coverage(clock: Clock) -> None:
    feed, _, _ = feed_of(clock, 1)
    assert "90 % region: coverage 91 %, n = 412" in figures_html(feed.vehicles[0], clock.now)


def test_the_law_and_its_parameters_are_shown_by_how_each_is_known() -> None:
    shown = law_html(Controller(law="L<1>", received={"NAVL1_PERIOD": 17.0}, default={"TECS_TIME_CONST": 5.0}))
    assert "L&lt;1&gt;" in shown and "received from the autopilot" in shown and "NAVL1_PERIOD 17" in shown
    assert shown.index("assumed: the autopilot&#x27;s default" if "&#x27;" in shown else "assumed") < shown.index(
        "TECS"
    )
    assert "identified in flight" not in shown and law_html(None) == ""


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, 1e300])
def test_wild_numbers_in_good_messages_do_not_stop_the_page(clock: Clock, value: float) -> None:
    feed, _, bus = feed_of(clock, 2)
    one = PretendUav(0)
    told = {**fields(one.prediction(T + 1, 0.0)), "horizon_s": value, "coverage": value, "coast_s": value}
    bus.publish(Prediction(**told), STAMP)
    bus.publish(
        Prediction(**{**told, "t": T + 2, "prediction_region_half_axes": Array.of(np.full((81, 3), value), "<f8")}),
        STAMP,
    )
    verdict = Verdict(
        outcome=Outcome.DIVERGED, sentence="", fit={"u": value, "w": 50.0}, threshold=value, horizon_s=value
    )
    bus.publish(Model(uav=0, t=T + 2, method="paper", verdict=verdict), STAMP)
    row = FleetRow(uav=0, state=TwinState.VERIFIED, verdict="", horizon_s=value, t10_s=value, fit={"u": value}, epoch=1)
    bus.publish(FleetState(t=value, rows=(row,)), STAMP)
    vehicle = feed.vehicles[0]
    assert vehicle.model.verdict is not None and vehicle.row.epoch == 1 and vehicle.forecast.t == T + 2
    assert np.isfinite(vehicle.forecast.horizon_s) and np.isfinite(vehicle.forecast.tube).all()
    assert "UAV-000" in status_html(vehicle, DARK, clock.now) and "fit per state" in figures_html(vehicle, clock.now)
    assert "2 UAVs" in summary_html(feed.all(), feed, DARK, clock.now)
    assert "UAV-000" in table(feed.all(), DARK, clock.now, total=2, pick="{}", selected=0)
    assert all(np.isfinite(part).all() for part in band(vehicle, np.zeros((0, 30)), clock.now)[2:3])


def test_a_chart_keeps_its_scale_while_its_values_stay_within() -> None:
    wave = np.sin(np.linspace(0, 6, 50))
    assert axis_range(600 + 40 * wave) == axis_range(601 + 40.5 * wave)
    for y in (wave, wave * 0, 1e5 + wave, np.array([np.nan, 3.0])):
        low, high = axis_range(y)
        assert (
            low <= np.nanmin(y)
            and high > np.nanmax(y)
            and high - low < 3 * max(np.nanmax(y) - np.nanmin(y), 0.03 * abs(np.nanmax(y)), 0.01)
        )


def test_the_worst_and_shortest_stand_first(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 8)
    bus.publish(Alert(uav=4, t=T, kind=AlertKind.CONFLICT, sentence="x"))
    page = table(feed.all(), DARK, clock.now, total=8, pick="{}", selected=None)
    order = [int(part.split('"')[0]) for part in page.split('data-uav="')[1:]]
    assert set(order[:3]) == {2, 4, 6} and order[3:5] == [5, 1]  # two alerts and a mismatch first
    horizons = [
        feed.vehicles[uav].forecast.horizon_s
        for uav in order[4:]
        if feed.vehicles[uav].row.state is TwinState.PREDICTING
    ]
    assert horizons == sorted(horizons)
