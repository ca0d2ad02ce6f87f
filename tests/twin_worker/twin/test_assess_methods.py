"""What ours is compared with: exact where the world is as they suppose, absent where they know nothing."""

import numpy as np
import pytest

from fleet.contract import Message, Mission, Params, Status
from fleet.mission import unroll_route
from tests.support.flights import HERE, T0, item, messages, turn
from twin_worker.evaluation.baselines import BASELINES, BaselineInput
from twin_worker.twin.state.state import Twin, ingest
from twin_worker.twin.step import advance
from twin_worker.twin.steps.kinematic_prediction import PathForecast, recent_track
from twin_worker.twin.steps.rollouts import select_method
from twin_worker.twin.steps.route_lines import LineInputs, route_line

AHEAD = np.arange(0.0, 61.0)
VA = 20.0


def told(*more: Message, **how) -> BaselineInput:
    """Half a minute of a made-up flight as the methods see it; `more` was heard before."""
    twin = Twin.of(1)
    for message in (*more, *messages(turn(30.0, Va=VA, **how))):
        ingest(twin, message)
    for _ in range(8):  # the wind filter takes ten seconds a turn
        advance(twin, (), twin.telemetry.history.newest)
    flown = recent_track(twin, 40.0)
    assert flown is not None
    return BaselineInput(twin, flown, AHEAD)


def mission(*items) -> tuple[Message, ...]:
    status = Status(uav=1, t=T0, mode="AUTO", armed=True, autopilot="ardupilot", vehicle="fixed_wing")
    return status, Mission(uav=1, t=T0, items=(item(0), *items), seq=1, complete=True)


def truth(now: BaselineInput, north: float, east: float) -> np.ndarray:
    return now.position + np.outer(AHEAD, [north, east, 0.0])


def test_straight_flight_is_exact_for_all_that_hold_something():
    now = told(rate=0.0, psi=0.5, wind=(3.0, -2.0))
    wanted = truth(now, VA * np.cos(0.5) + 3.0, VA * np.sin(0.5) - 2.0)
    for name in ("cv", "ct"):
        path = BASELINES[name](now)
        assert path is not None and np.abs(path - wanted).max() < 1.0, name


def test_a_steady_turn_is_exact_at_a_constant_rate_only():
    now = told(rate=0.2)
    course = 2.0 + 0.2 * (now.track.t[-1] - T0)
    wanted = now.position[:2] + VA / 0.2 * np.column_stack(
        [np.sin(course + 0.2 * AHEAD) - np.sin(course), np.cos(course) - np.cos(course + 0.2 * AHEAD)]
    )
    ct, cv = BASELINES["ct"](now), BASELINES["cv"](now)
    assert ct is not None and np.abs(ct[:, :2] - wanted).max() < 5.0
    assert cv is not None and np.abs(cv[:, :2] - wanted).max() > 300.0


@pytest.mark.parametrize("name", ["route", "route_wind", "dynamics"])
def test_without_a_mission_there_is_no_route(name):
    assert BASELINES[name](told(rate=0.0)) is None


def test_the_route_is_followed_through_the_wind():
    """Due north with 5 m/s from behind, then east across it: 25 m/s there, sqrt(20² - 5²) here."""
    corner = 1500.0
    heard = mission(item(1, north=corner), item(2, north=corner, east=9000.0))
    now = told(*heard, rate=0.0, psi=0.0, wind=(5.0, 0.0))
    assert now.position[0] == pytest.approx(749.0, abs=3.0)
    path = BASELINES["route_wind"](now)
    assert path is not None
    after = 60.0 - (corner - now.position[0]) / 25.0
    assert path[10, :2] == pytest.approx([now.position[0] + 250.0, 0.0], abs=6.0)
    # 20 m/s reported at 600 m are 20.6 m/s of true airspeed in the standard atmosphere; no turn contradicts it
    assert path[60, :2] == pytest.approx([corner, after * np.sqrt(20.6**2 - 4.4**2)], abs=25.0)
    plain = BASELINES["route"](now)
    assert plain is not None and plain[60, 1] == pytest.approx(after * 25.0, abs=25.0)  # it knows no wind


def test_a_commanded_speed_is_flown_where_it_is_known():
    heard = (
        *mission(item(1, 178, param2=26.0), item(2, north=9000.0)),
        Params(uav=1, t=T0, values={"WP_RADIUS": 50.0}),
    )
    now = told(*heard, rate=0.0, psi=0.0)
    path = BASELINES["route_wind"](now)
    assert path is not None and path[60, 0] - now.position[0] == pytest.approx(
        60 * 26.0, rel=0.06
    )  # it speeds up first


# --- the line itself -------------------------------------------------------------------------------------------------


def drawn(*items, p=(0.0, 0.0, -100.0), past=None, seq: int = 1) -> np.ndarray:
    from fleet.autopilots import arduplane

    way = unroll_route((item(0), *items), seq=seq, origin=HERE, params={})
    here = np.array(p)
    past = here[None] if past is None else past
    return route_line(way, LineInputs(here, past, 20.0, arduplane.parameters({})[0], 3000.0))


def test_the_line_climbs_with_its_legs_and_begins_abreast():
    items = (item(1), item(2, north=1000.0), item(3, north=1000.0, east=1000.0, alt_m=200.0))
    points = drawn(*items, p=(300.0, 40.0, -100.0), seq=2)
    assert points[0, :2] == pytest.approx([300.0, 0.0], abs=5.0)
    half = points[np.argmin(np.abs(points[:, 0] - 1000.0) + np.abs(points[:, 1] - 500.0))]
    assert half[2] == pytest.approx(-150.0, abs=2.0)


def test_a_circle_is_flown_as_often_as_it_is_told_and_left_on_a_tangent():
    turns = item(1, 18, north=500.0, param1=2.0, param3=80.0)
    points = drawn(turns, item(2, north=500.0, east=5000.0), p=(0.0, 0.0, -100.0))
    out = points[:, :2] - [500.0, 0.0]
    on = np.abs(np.hypot(*out.T) - 80.0) < 1.0
    swept = np.unwrap(np.arctan2(out[on, 1], out[on, 0]))
    assert 2.0 <= (swept[-1] - swept[0]) / (2 * np.pi) <= 3.0  # clockwise: angles from north grow
    step = np.diff(points[:, :2], axis=0)
    course = np.unwrap(np.arctan2(step[:, 1], step[:, 0])[np.hypot(*step.T) > 0.1])
    assert np.abs(np.diff(course)).max() < 0.2  # no corner anywhere


def test_turns_already_flown_are_not_flown_again():
    angle = np.linspace(0.0, 3.0 * np.pi, 400)  # one and a half of two turns
    past = np.column_stack([500.0 + 80.0 * np.cos(angle), 80.0 * np.sin(angle), 0 * angle - 100.0])
    points = drawn(item(1, 18, north=500.0, param1=2.0, param3=80.0), item(2, north=5000.0), p=past[-1], past=past)
    on = np.abs(np.hypot(*(points[:, :2] - [500.0, 0.0]).T) - 80.0) < 1.0
    length = np.linalg.norm(np.diff(points[on, :2], axis=0), axis=1).sum()
    assert np.pi * 80.0 <= length <= 3.1 * np.pi * 80.0
    assert (points[:, 0] > 1500.0).any()


def test_a_loiter_for_good_never_leaves():
    points = drawn(item(1, 17, north=300.0, param3=-70.0), item(2, north=5000.0))
    assert points[:, 0].max() < 380.0 and len(points) > 500


@pytest.mark.parametrize(
    "items",
    [
        (item(1, 18, north=500.0, param1=1e9, param3=1e-3), item(2)),
        (item(1, 19, param1=1e12), item(2, north=50.0)),
        (item(1, north=4e6), item(2, 31, north=100.0, alt_m=9e4)),
        (item(1), item(2), item(3)),
        (item(1, 18, param1=0.0),),
    ],
)
def test_no_mission_makes_a_line_without_end_or_without_numbers(items):
    points = drawn(*items)
    assert 1 <= len(points) < 20_000 and np.isfinite(points).all()


def test_an_aircraft_that_says_not_which_item_it_flies_has_no_route():
    heard = mission(item(1, north=9000.0))
    unsaid = (heard[0], Mission(uav=1, t=T0, items=heard[1].items, seq=-1, complete=True))  # type: ignore[attr-defined]
    twin = Twin.of(1)
    laid = turn(30.0, rate=0.0, psi=0.0)
    del laid["leg"]
    for message in (*unsaid, *messages(laid)):
        ingest(twin, message)
    flown = recent_track(twin, 40.0)
    assert flown is not None and BASELINES["route"](BaselineInput(twin, flown, AHEAD)) is None


# --- the lines among the methods of the twin ----------------------------------------------------------------------


def scored(twin: Twin, **error: float) -> None:
    """Set the mean error of past predictions by method."""
    for name, value in error.items():
        twin.prediction.selector.mean_error[name], twin.prediction.selector.n_scored[name] = value, 9


@pytest.mark.parametrize(
    "error, chosen",
    [
        ({"greybox": 0.2, "route_wind": 0.1, "route_speed": 0.3}, "route_wind"),
        ({"greybox": 0.2, "route_wind": 0.3, "route_speed": 0.1}, "route_speed"),
        ({"greybox": 0.1, "route_wind": 0.09, "route_speed": 0.3}, "greybox"),  # not clearly better
        ({"greybox": 0.04}, "greybox"),
        ({"greybox": 0.1}, "route_wind"),  # by its prior, which is lower
    ],
)
def test_a_route_line_with_the_smaller_past_error_is_used(error, chosen):
    now = told(*mission(item(1, north=9000.0)), rate=0.0, psi=0.0)
    scored(now.twin, **error)
    t = float(now.track.t[-1])
    wrong = PathForecast(now.position + np.outer(AHEAD, [0.0, VA, 0.0]), "greybox", "law", 1, "east")
    forecast = select_method(now.twin, t, {"greybox": wrong}, now.track, AHEAD)
    assert forecast.method == chosen
    assert forecast.path is not None and (forecast.path[60, 0] > now.position[0] + 1000.0) == (chosen != "greybox")
    expected = {"greybox", "route_wind", "route_speed", "constant_turn", "constant_velocity"}
    assert expected == set(now.twin.prediction.selector.pending[-1][2])


def test_no_route_line_competes_without_a_route():
    now = told(rate=0.0)
    path = PathForecast(now.position + np.outer(AHEAD, [0.0, VA, 0.0]), "copter", "law", -1, "holds")
    assert select_method(now.twin, float(now.track.t[-1]), {"copter": path}, now.track, AHEAD).method == "copter"
    assert not now.twin.prediction.selector.pending
