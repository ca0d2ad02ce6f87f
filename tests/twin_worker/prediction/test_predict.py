"""Flying ahead on a linear model whose answer is known, and every reason not to."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fleet.autopilots import arduplane
from fleet.autopilots.modes import ModeEntry, make_leg
from fleet.frames import to_geodetic
from fleet.mission import VA_C, WAYPOINT, Route
from fleet.window import Window
from tests.support import flights as f
from tests.support.flights import DT, HERE, SPEED, T0, item, truth
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.numerics.interpolation import zero_order_hold
from twin_worker.prediction import closed_loop
from twin_worker.prediction.closed_loop import InitialCondition, fly_ahead, synchronise_controller
from twin_worker.prediction.replay_window import AutopilotConfig, PredictionContext

AHEAD = np.arange(0.0, 31.0)
FLOWN_S = 30.0
PARAMS = arduplane.DEFAULTS | {"AIRSPEED_CRUISE": SPEED, "TRIM_ARSPD_CM": 100 * SPEED}
NORTH = (item(0), item(1, north=5000.0), item(2, north=9000.0))


def level() -> Window:
    """Half a minute due north, 100 m up, in trim."""
    n = round(FLOWN_S / DT)
    t = T0 + DT * np.arange(n)
    x, u = np.zeros((n, 9)), np.zeros((n, 4))
    x[:, 0], x[:, 2], u[:, 3] = SPEED, 1.0, 0.5
    v = np.tile([SPEED, 0.0, 0.0], (n, 1))
    p = v * (t - T0)[:, None] + [0.0, 0.0, -100.0]
    return Window(t, x, u, p, v, np.ones(n, bool), np.zeros(n, bool))


def situation(
    items=NORTH, *, window: Window | None = None, params=PARAMS, since=-np.inf, seq=1, lost=()
) -> PredictionContext:
    laid = f.turn(FLOWN_S, rate=0.0, psi=0.0, bank=0.0, Va=float(np.hypot(SPEED, 1.0)))
    laid["leg"] = (laid["leg"][0], np.full((len(laid["leg"][0]), 1), float(seq)))
    laid = {name: pair for name, pair in laid.items() if name not in lost}
    history = f.remembered(f.messages(laid))
    return PredictionContext(window or level(), history, AutopilotConfig(items, params, since), WindFilter(), HERE)


def test_held_by_hand():
    t, x = np.array([1.0, 2.0, 5.0]), np.array([[1.0], [2.0], [5.0]])
    got = zero_order_hold(t, x, np.array([0.5, 1.0, 1.9, 2.0, 3.0, 3.1, 5.0]), max_age=1.0)[:, 0]
    assert np.array_equal(got, [np.nan, 1.0, 1.0, 2.0, 2.0, np.nan, 5.0], equal_nan=True)
    assert np.isnan(zero_order_hold(np.empty(0), np.empty((0, 2)), t, 1.0)).all()


def test_a_straight_leg_is_flown_straight():
    got = fly_ahead(situation(), truth(), AHEAD)
    assert got.path is not None and got.sentence == "" and got.seq == 1
    end = level().p[-1]
    assert np.allclose(got.path[0], end)
    assert np.allclose(got.path[:, 0], end[0] + SPEED * AHEAD, rtol=0.02, atol=10.0)
    assert np.abs(got.path[:, 1]).max() < 2.0
    assert np.abs(got.path[:, 2] + 100.0).max() < 10.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_turns_where_the_route_turns(side):
    corner = level().p[-1, 0] + 150.0
    route = (item(0), item(1, north=corner), item(2, north=corner, east=side * 3000.0))
    path = fly_ahead(situation(route), truth(), AHEAD).path
    assert path is not None
    assert side * path[-1, 1] > 150.0 and abs(path[-1, 0] - corner) < 120.0


def test_it_starts_on_the_item_the_aircraft_reports():
    assert fly_ahead(situation(seq=2), truth(), AHEAD).seq == 2


def test_an_envelope_exit_is_a_sentence_not_a_path():
    got = fly_ahead(situation(), truth(grow=0.02), AHEAD)
    assert got.path is None
    assert "envelope" in got.sentence and "s ahead" in got.sentence


def test_beyond_a_minute_a_path_ends_where_its_envelope_does(monkeypatch):
    far = np.concatenate([np.arange(0.0, 61.0), np.arange(64.0, 181.0, 4.0)])

    def left_after(seconds: float):
        whole = closed_loop.simulate
        monkeypatch.setattr(closed_loop, "simulate", lambda *flight: min(whole(*flight), int(seconds / flight[-2])))
        got = fly_ahead(situation(), truth(), far)
        monkeypatch.undo()
        return got

    path = left_after(90.0).path
    assert path is not None and np.isfinite(path[far < 89.0]).all() and np.isnan(path[far > 90.0]).all()
    assert left_after(50.0).path is None


def test_a_model_of_no_numbers_gives_no_path():
    lon, lat = truth()
    got = fly_ahead(situation(), (replace(lon, D=np.full_like(lon.D, np.nan)), lat), AHEAD)
    assert got.path is None and got.sentence


@pytest.mark.parametrize(("command", "word"), [(22, "take-off"), (21, "landing")])
def test_take_off_and_landing_are_refused(command, word):
    route = (item(0), item(1, command, north=5000.0), item(2, north=9000.0))
    got = fly_ahead(situation(route), truth(), AHEAD)
    assert got.path is None and got.sentence.startswith(word)


def test_a_landing_ahead_ends_the_flight_where_it_touches_down():
    end = level().p[-1, 0]
    route = (item(0), item(1, north=end + 100.0), item(2, 21, north=end + 400.0, alt_m=60.0))
    path = fly_ahead(situation(route), truth(), AHEAD).path
    assert path is not None
    assert path[-1, 0] == pytest.approx(end + 400.0, abs=5.0) and np.ptp(path[-5:], axis=0).max() == 0.0
    assert path[12, 0] == pytest.approx(end + 12 * SPEED, abs=15.0)  # until then it flies


def test_without_mission_current_it_says_so():
    got = fly_ahead(situation(lost=("leg",)), truth(), AHEAD)
    assert got.path is None and "MISSION_CURRENT" in got.sentence


def test_missing_parameters_are_counted_and_named():
    got = fly_ahead(situation(params={}), truth(), AHEAD)
    assert got.path is not None and "not received, defaults assumed" in got.sentence
    assert int(got.sentence.split()[0]) > 10
    assert fly_ahead(situation(params=PARAMS), truth(), AHEAD).sentence == ""


def test_commands_and_airspeed_may_be_missing():
    got = fly_ahead(situation(lost=("command", "air")), truth(), AHEAD)
    assert got.path is not None and np.isfinite(got.path).all()


def test_a_new_route_is_flown_from_the_present_state():
    late = T0 + FLOWN_S
    for since in (late - 7.0, late - 3.0, late, late + 0.5):
        got = fly_ahead(situation(since=since), truth(), AHEAD)
        assert got.path is not None and np.isfinite(got.path).all()
    got = fly_ahead(situation(since=late + 30.0), truth(), AHEAD)
    assert got.path is None and "the route changed after" in got.sentence


def test_only_unbroken_flight_counts():
    window = level()
    window.ok[-50] = False
    got = fly_ahead(situation(window=window), truth(), AHEAD)
    assert got.path is None and "wait" in got.sentence
    window = level()
    window.ok[200] = False
    assert fly_ahead(situation(window=window), truth(), AHEAD).path is not None


def test_a_coasting_twin_looks_further():
    near, far = (fly_ahead(situation(), truth(), AHEAD + by).path for by in (0.0, 10.0))
    assert near is not None and far is not None
    assert np.allclose(near[10:], far[:-10], atol=1e-6)


@pytest.mark.parametrize(
    "items",
    [
        (),
        (item(0),),
        (item(0), item(1, 177, param1=1.0, param2=-1.0)),
        (item(0), item(1, 177, param1=2.0, param2=-1.0), item(2, 177, param1=1.0, param2=-1.0)),
        (item(0), item(1, 177, param1=float("nan"), param2=float("inf"))),
        (item(0), item(1, north=100.0), item(2, north=100.0), item(3, north=100.0)),
        (item(0), item(1, north=float("1e6"), alt_m=float("nan"))),
        (item(0), item(1, 18, north=300.0, param1=float("inf"), param3=float("nan"))),
        (item(0), item(1, 178, param2=1e30), item(2, north=900.0)),
        (item(7), item(3), item(900, 16, north=50.0)),
    ],
)
@pytest.mark.parametrize("seq", [0, 1, 99, -1, 65535])
def test_hostile_missions_give_a_path_of_numbers_or_a_sentence(items, seq):
    got = fly_ahead(situation(items, seq=seq), truth(), AHEAD)
    assert got.path is None or np.isfinite(got.path).all()
    assert got.path is not None or got.sentence


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e30, 1e30, 0.0, -1.0])
def test_absurd_parameters_give_a_path_of_numbers_or_a_sentence(value):
    got = fly_ahead(situation(params=dict.fromkeys(PARAMS, value)), truth(), AHEAD)
    assert got.path is None or np.isfinite(got.path).all()
    assert got.path is not None or got.sentence


@pytest.mark.parametrize(("ago_s", "flies_mission_speed"), [(60.0, True), (3.0, False)])
def test_the_speed_flown_before_a_change_of_mode_is_not_that_of_px4_after_it(ago_s, flies_mission_speed):
    """A mission at 20 m/s, and a return at cruise: PX4 flies each at its own speed at once."""
    here = level()
    speed = f.item(2, 178)
    mission = (item(0, north=5000.0), msgspec.structs.replace(speed, seq=1, param2=SPEED), item(2, north=9000.0))
    home = Route(HERE, np.array([make_leg(WAYPOINT, np.array([9000.0, 0.0, -100.0]))]), np.full(3, np.nan))
    now = situation(mission, window=here, lost=("command",))  # PX4 reports no airspeed error
    position = tuple(float(x) for x in to_geodetic(HERE, here.p[-1]))
    entry = ModeEntry(float(here.t[-1]) - ago_s, position, 0.0)
    cruise = {"FW_AIRSPD_TRIM": SPEED - 4.0, "FW_AIRSPD_MIN": 10.0, "FW_AIRSPD_MAX": 30.0}
    changed = replace(now.onboard, autopilot="px4", law="px4", params=cruise, entry=entry, mode_route=home)
    initial = synchronise_controller(replace(now, onboard=changed))
    assert isinstance(initial, InitialCondition)
    legs = initial.synchronised[2]
    assert legs[0, VA_C] == (SPEED if flies_mission_speed else 0.0)
