"""Modes without a mission: predicted from the mode change on; and the failsafe that follows a link loss."""

import copy
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from fleet.autopilots.control_law import eas2tas
from fleet.autopilots.failsafe import FailsafeStep
from fleet.contract import Event, Prediction, TwinState
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.mission import P_N, RADIUS
from tests.support.flights import ROUTE, drive, predictions, sample, status
from twin_worker.prediction.failsafe_route import FailsafePlan
from twin_worker.twin.state.routes import identified_radius, mode_change_time, present_route
from twin_worker.twin.step import Twin, advance

MODELS = (*ROUTE, "greybox")


def entered(twin: Twin, mode: str) -> Prediction:
    """The prediction that follows a mode change at once."""
    (made,) = predictions(drive(twin, [status(twin, mode=mode)]))
    return made


def path_of(made: Prediction) -> tuple[np.ndarray, np.ndarray]:
    return made.ahead.numpy(), made.path.numpy().astype(float)


def home_of(twin: Twin) -> np.ndarray:
    home = twin.home
    return to_ned(twin.telemetry.origin, *(np.array([x]) for x in (home.lat_e7, home.lon_e7, home.alt_mm)))[0]


def with_params(twin: Twin, **values: float) -> Twin:
    params = twin.onboard.params
    twin.onboard.set_params(msgspec.structs.replace(params, values=params.values | values))
    return twin


def radius_of(twin: Twin) -> float:
    return abs(twin.received_params.get("WP_LOITER_RAD", 60.0))


def test_loiter_circles_where_it_was_entered(winged):
    made = entered(winged, "LOITER")
    ahead, path = path_of(made)
    assert made.method in MODELS and made.seq == -1
    distance = np.linalg.norm(path[:, :2] - path[0, :2], axis=1)
    assert distance.max() < 4.0 * radius_of(winged)
    assert distance[ahead >= 80] == pytest.approx(radius_of(winged), abs=35.0)


def test_rtl_flies_home_and_circles_there_at_its_altitude(winged):
    with_params(winged, RTL_ALTITUDE=130.0, RTL_AUTOLAND=0.0)
    ahead, path = path_of(entered(winged, "RTL"))
    home = home_of(winged)
    late = path[ahead >= 140]
    assert np.linalg.norm(late[:, :2] - home[:2], axis=1) == pytest.approx(radius_of(winged), abs=35.0)
    assert home[2] - late[:, 2] == pytest.approx(130.0, abs=15.0)


def test_guided_flies_to_each_new_target(winged):
    entered(winged, "GUIDED")
    for k, offset in enumerate(((900.0, 300.0), (-800.0, 700.0)), start=1):
        t = winged.telemetry.history.newest + 0.2
        target = np.array([*offset, -140.0])
        rows = to_geodetic(winged.telemetry.origin, target)[None]
        results = [
            r for r in advance(winged, (sample(1, t, target=(np.array([t]), rows)),)) if isinstance(r, Prediction)
        ]
        ahead, path = path_of(results[-1])
        assert (results[-1].event is Event.TARGET) == (k > 1)
        late = path[ahead >= 150]
        assert np.linalg.norm(late[:, :2] - target[:2], axis=1) == pytest.approx(radius_of(winged), abs=40.0)


@pytest.mark.parametrize("bank", [-0.4, 0.4])
def test_the_crosstrack_error_of_a_guided_circle_tells_its_radius(winged, bank):
    origin, start = winged.telemetry.origin, winged.telemetry.history.newest + 0.2
    entered(winged, "GUIDED")
    assert np.isnan(identified_radius(winged))
    target = np.array([400.0, 100.0, -140.0])
    t = start + 0.2 * np.arange(60)
    r, angle = 75.0 + 20.0 * np.sin(0.1 * (t - start)), 0.3 * np.sign(bank) * (t - start)
    p = target + np.column_stack([r * np.cos(angle), r * np.sin(angle), 0.0 * t])
    commands = np.column_stack([np.full(60, bank), 0.0 * t, r - 70.0, 0.0 * t, 0.0 * t])
    centre = np.repeat(to_geodetic(origin, target)[None], 60, axis=0)
    rows = {"target": (t, centre), "position": (t, to_geodetic(origin, p)), "command": (t, commands)}
    advance(winged, (sample(1, t[-1], **rows),))
    widened = eas2tas(float(centre[0, 2]) * 1e-3) ** 2
    assert identified_radius(winged) == pytest.approx(np.sign(bank) * 70.0 / widened, abs=0.5)
    (circle,) = present_route(winged).legs
    assert circle[RADIUS] == identified_radius(winged)


def test_cruise_keeps_its_course(winged):
    ahead, path = path_of(entered(winged, "CRUISE"))
    v = winged.telemetry.history.rows_since("velocity", -np.inf)[1][-1]
    course = v[:2] / np.linalg.norm(v[:2])
    moved = path[ahead >= 60][:, :2] - path[0, :2]
    assert abs(moved[:, 0] * course[1] - moved[:, 1] * course[0]).max() < 60.0
    assert (moved @ course).min() > 800.0


def test_cruise_entered_in_a_turn_keeps_the_course_at_which_its_wings_were_level(winged):
    entered(winged, "CRUISE")
    history, before = winged.telemetry.history, winged.onboard.entry
    (t_p, positions), (_, velocities) = history.rows_since("position"), history.rows_since("velocity")
    t, v, here = float(t_p[-1]), velocities[-1].copy(), positions[-1].copy()
    origin = Origin(*(int(x) for x in here))
    turned = np.array([[np.cos(0.12), -np.sin(0.12), 0.0], [np.sin(0.12), np.cos(0.12), 0.0], [0.0, 0.0, 1.0]]) @ v
    for k in range(1, 8):
        at = t + 0.1 * k
        rows = to_geodetic(origin, 0.1 * k * turned)[None]
        advance(winged, (sample(1, at, position=(np.array([at]), rows), velocity=(np.array([at]), turned[None])),))
        assert winged.onboard.entry.locked == (at >= before.t + 0.5)
    entry = winged.onboard.entry
    assert entry.course == pytest.approx(np.arctan2(turned[1], turned[0])) and entry.t == before.t
    assert entry.position[2] == before.position[2]  # the height is that of the mode change
    moved = entry.ned(origin)[:2]
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(v[:2]) * (before.t + 0.55 - t), rel=0.15)
    assert winged.onboard.plan_changed_t == before.t + 0.5


def test_circle_holds_its_bank(twin):
    ahead, path = path_of(entered(with_params(twin, ROLL_LIMIT_DEG=60.0), "CIRCLE"))
    wind = twin.environment.wind.wind[:2]
    air = path[:, :2] - ahead[:, None] * wind  # a circle in the air
    one_lap = air[(ahead > 20) & (ahead < 80)]
    centre = 0.5 * (one_lap.max(axis=0) + one_lap.min(axis=0))
    radii = np.linalg.norm(one_lap - centre, axis=1)
    assert radii.std() < 0.15 * radii.mean() and 60.0 < radii.mean() < 250.0


def test_a_mode_flown_by_hand_is_a_turn_rate(winged):
    made = entered(winged, "FBWA")
    assert made.method == "imm" and "FBWA follows no mission" in made.sentence


def test_a_return_to_auto_is_predicted_at_once(winged):
    entered(winged, "LOITER")
    made = entered(winged, "AUTO")
    assert made.method in MODELS and made.seq >= 1


def test_an_unknown_home_is_said(winged):
    winged.onboard.set_mission(msgspec.structs.replace(winged.onboard.mission, items=()), winged.first_item)
    made = entered(winged, "RTL")
    assert made.method == "imm" and "home position unknown" in made.sentence


def px4_home(twin: Twin, north_m: float) -> tuple[int, int, int]:
    lat, lon, alt = to_geodetic(twin.telemetry.origin, np.array([north_m, 300.0, 100.0]))
    return int(lat), int(lon), int(alt)


def centre_of(twin: Twin) -> np.ndarray:
    return present_route(twin).legs[-1, P_N : P_N + 2]


def test_the_return_of_px4_ends_at_the_reported_home_which_may_come_late_and_move(winged):
    drive(winged, [status(winged, autopilot="px4", mode="MISSION")])
    drive(winged, [status(winged, autopilot="px4", mode="RTL")])
    assert winged.home is None and "home position unknown" in winged.no_route_reason()
    entered_t = winged.onboard.plan_changed_t
    drive(winged, [status(winged, autopilot="px4", mode="RTL", home=px4_home(winged, -900.0))])
    assert centre_of(winged) == pytest.approx([-900.0, 300.0], abs=0.5)
    assert winged.onboard.plan_changed_t == entered_t  # the return began before its home was known
    drive(winged, [status(winged, autopilot="px4", mode="RTL", home=px4_home(winged, -900.5))])
    assert winged.onboard.plan_changed_t == entered_t  # less than a new route
    drive(winged, [status(winged, autopilot="px4", mode="RTL", home=px4_home(winged, 700.0))])
    assert centre_of(winged) == pytest.approx([700.0, 300.0], abs=0.5)
    assert winged.onboard.plan_changed_t == winged.onboard.status.t


def test_the_state_does_not_alternate_before_the_first_model(heard):
    twin, states = Twin.of(1), []
    for message in heard[:350]:
        advance(twin, (message,))
        states.append(twin.prediction.state)
    assert TwinState.PREDICTING in states
    assert sum(a is not b for a, b in pairwise(states)) <= 3


def test_a_flight_that_does_not_follow_the_route_of_its_mode_is_a_turn_rate(winged):
    now = winged.telemetry.history.newest
    entered(winged, "LOITER")
    away = to_geodetic(winged.telemetry.origin, np.array([3000.0, -9000.0, -140.0]))
    entry = msgspec.structs.replace(winged.onboard.entry, t=now - 40.0)
    winged.onboard.enter_mode(entry)  # as if it had flown there for 40 s, but it has flown its mission
    winged.onboard.set_target(tuple(float(x) for x in away))
    winged.onboard.plan_changed(now - 40.0)
    winged.prediction.expire()
    made = predictions(advance(winged, (), now + 1.2))[-1]
    assert made.method == "imm" and "does not follow the route of its mode" in made.sentence


# --- link loss -------------------------------------------------------------------------------------------------------

RADIO = {"THR_FAILSAFE": 1.0, "FS_LONG_TIMEOUT": 5.0, "RC_FS_TIMEOUT": 1.0, "RTL_AUTOLAND": 0.0, "FS_GCS_ENABL": 0.0}


def lost(twin: Twin) -> Prediction:
    """The first prediction after telemetry has stopped."""
    now, made = twin.telemetry.history.newest, []
    while not any(p.coast_s > 0 for p in made) and now < twin.telemetry.history.newest + 12.0:
        now += 1.0
        made += [r for r in advance(twin, (), now) if isinstance(r, Prediction)]
    return made[-1]


def test_a_lost_link_is_followed_by_the_return_that_the_parameters_describe(winged):
    with_params(winged, **RADIO, FS_SHORT_ACTN=0.0, FS_LONG_ACTN=1.0)
    made = lost(winged)
    ahead, path = path_of(made)
    assert "RTL 6.2 s after the loss (FS_LONG_ACTN 1)" in made.sentence and "every radio link" in made.sentence
    late = path[ahead >= 150]
    assert np.linalg.norm((late - home_of(winged))[:, :2], axis=1) == pytest.approx(radius_of(winged), abs=40.0)


def test_the_mission_that_a_failsafe_ends_is_an_alternative(winged):
    with_params(winged, **RADIO, FS_SHORT_ACTN=0.0, FS_LONG_ACTN=0.0)
    ahead, mission = path_of(lost(copy.deepcopy(winged)))
    with_params(winged, FS_LONG_ACTN=1.0)
    made = lost(winged)
    (other,) = made.alternatives
    path, near = other.path.numpy(), ahead < 60
    assert other.probability == 0.5 and "continues the mission" in other.sentence and path.shape == made.path.shape
    assert np.linalg.norm(path[near] - mission[near], axis=1).max() < 10.0
    assert np.linalg.norm(path - made.path.numpy(), axis=1)[ahead > 60].max() > 100.0


def test_a_lost_link_without_failsafe_continues_the_mission(winged):
    with_params(winged, **RADIO, FS_SHORT_ACTN=0.0, FS_LONG_ACTN=0.0)
    made = lost(winged)
    assert not made.alternatives
    assert "failsafe: AUTO continues by the parameters" in made.sentence and made.seq >= 1


def test_parameters_that_were_not_received_are_said(winged):
    names = ("FS_LONG_ACTN", "FS_GCS_ENABL")
    params = winged.onboard.params
    left = {name: value for name, value in params.values.items() if name not in names}
    winged.onboard.set_params(msgspec.structs.replace(params, values=left))
    assert "failsafe parameters not received" in lost(winged).sentence


def test_a_hand_flown_aircraft_circles_and_returns_after_the_loss(twin):
    with_params(twin, **RADIO, FS_SHORT_ACTN=0.0, FS_LONG_ACTN=0.0)
    entered(twin, "FBWA")
    made = lost(twin)
    assert made.method in MODELS and "CIRCLE 1.2 s" in made.sentence and "RTL 6.2 s" in made.sentence


@pytest.mark.parametrize(("action", "mode"), [(2.0, "FBWA"), (4.0, "FBWB")])
def test_wings_level_failsafes_fly_straight(twin, action, mode):
    with_params(twin, **RADIO | {"FS_SHORT_ACTN": action, "FS_LONG_ACTN": 0.0, "FS_LONG_TIMEOUT": 200.0})
    made = lost(twin)
    ahead, path = path_of(made)
    assert f"{mode} 1.2 s" in made.sentence
    steps = np.diff(path[(ahead > 20) & (ahead < 50), :2], axis=0)
    course = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    assert abs(course - course[0]).max() < 0.15
    sink = path[ahead <= 40][-1, 2] - path[0, 2]
    assert (sink > 25.0) if mode == "FBWA" else (abs(sink) < 25.0)


# --- the change itself -----------------------------------------------------------------------------------------------


def with_command(twin: Twin, ahead_s: float, *errors: tuple[float, float]) -> float:
    """Report crosstrack and height errors every 0.2 s; return the time of the last."""
    t = twin.telemetry.history.newest + ahead_s + 0.2 * np.arange(len(errors))
    rows = np.array([(0.1, 0.05, crosstrack, height, 0.0) for crosstrack, height in errors])
    position = np.repeat(twin.telemetry.history.rows("position")[1][-1:], len(t), axis=0)
    velocity = np.repeat(twin.telemetry.history.rows("velocity")[1][-1:], len(t), axis=0)
    advance(twin, (sample(1, t[-1], command=(t, rows), position=(t, position), velocity=(t, velocity)),))
    return float(t[-1])


@pytest.mark.parametrize("errors", [(320.0, 0.0), (0.0, 45.0)])
def test_a_mode_begins_where_the_reported_path_errors_jump(winged, errors):
    now = with_command(winged, 0.2, *[(1.0, 0.5)] * 4, errors, errors, errors)
    assert mode_change_time(winged, now) == pytest.approx(now - 0.5, abs=0.01)
    entered(winged, "LOITER")
    assert winged.onboard.entry.t == winged.onboard.plan_changed_t == pytest.approx(now - 0.5, abs=0.01)


def test_without_a_jump_a_mode_begins_at_its_report(winged):
    now = with_command(winged, 0.2, *[(4.0 * k, 0.3 * k) for k in range(7)])  # as fast as it flies
    assert mode_change_time(winged, now) == now


def test_without_path_errors_a_mode_begins_where_the_commanded_bank_moves_as_never_before(winged):
    start = winged.telemetry.history.newest + 0.2
    t = start + 0.1 * np.arange(120)
    banks = 0.1 * np.sin(0.5 * (t - start))
    nothing = np.full(len(t), np.nan)
    banks[t > start + 11.25] += np.clip(3.0 * (t[t > start + 11.25] - start - 11.2), 0.0, 0.6)
    velocity = np.repeat(winged.telemetry.history.rows("velocity")[1][-1:], len(t), axis=0)
    rows = np.column_stack([banks, 0.0 * t, nothing, nothing, nothing])
    empty = Twin.of(2)
    advance(empty, (sample(2, t[-1], command=(t, rows), velocity=(t, velocity)),))
    assert mode_change_time(empty, t[-1]) == pytest.approx(start + 11.25, abs=0.051)
    rows[:, 0] = 0.1 * np.sin(0.5 * (t - start))
    quiet = Twin.of(2)
    advance(quiet, (sample(2, t[-1], command=(t, rows), velocity=(t, velocity)),))
    assert mode_change_time(quiet, t[-1]) == t[-1]


def with_target(twin: Twin, t: float, north_m: float) -> None:
    rows = to_geodetic(twin.telemetry.origin, np.array([north_m, -700.0, -140.0]))[None]
    advance(twin, (sample(1, t, target=(np.array([t]), rows)),))


def test_the_first_target_belongs_to_the_mode_change_and_the_next_is_a_new_route(winged):
    now = winged.telemetry.history.newest
    with_target(winged, now, -500.0)  # of the mode before
    with_target(winged, now + 0.1, -500.0)
    entered(winged, "GUIDED")
    changed_t, memory = winged.onboard.plan_changed_t, winged.onboard.controller_memory
    with_target(winged, now + 0.2, -500.0)
    assert winged.onboard.target is None  # it may have been sent before the change
    with_target(winged, now + 0.4, 900.0)
    assert winged.onboard.target is not None
    assert (winged.onboard.plan_changed_t, winged.onboard.controller_memory) == (changed_t, memory)
    with_target(winged, now + 1.4, -900.0)
    assert winged.onboard.plan_changed_t == pytest.approx(now + 1.4)


@pytest.mark.parametrize("n_before", [1, 2])
def test_a_target_that_is_repeated_after_the_change_is_that_of_the_new_mode_too(winged, n_before):
    now = winged.telemetry.history.newest
    for k in range(n_before):
        with_target(winged, now + 0.1 * k, -500.0)
    entered(winged, "RTL")
    with_target(winged, now + 0.2, -500.0)
    assert (winged.onboard.target is None) == (n_before == 2)
    with_target(winged, now + 0.6, -500.0)
    assert centre_of(winged) == pytest.approx([-500.0, -700.0], abs=0.5)


def test_the_controller_continues_its_speed_and_height_state(winged):
    advance(winged, (), winged.telemetry.history.newest + 1.0)
    states = tuple(winged.prediction.controller_states)
    t, law, _ = states[-1]
    assert law == "arduplane" and t == pytest.approx(winged.telemetry.history.newest, abs=2.5)
    entered(winged, "LOITER")
    known, memory = winged.onboard.controller_memory
    assert known == law and np.isfinite(memory).all(), np.flatnonzero(~np.isfinite(memory))
    assert memory in [one[2] for one in states]
    winged.onboard.plan_changed(winged.onboard.plan_changed_t)
    assert winged.onboard.controller_memory == ("", ())


def test_on_the_way_to_a_circle_its_sign_is_that_of_the_parameter(winged):
    with_params(winged, WP_LOITER_RAD=70.0)
    origin, start = winged.telemetry.origin, winged.telemetry.history.newest + 0.2
    entered(winged, "GUIDED")
    target, t = np.array([400.0, 100.0, -140.0]), start + 0.2 * np.arange(60)
    r = 500.0 - 20.0 * (t - start)
    p = target + np.column_stack([r, 0.0 * t, 0.0 * t])
    commands = np.column_stack([np.full(60, -0.02), 0.0 * t, r - 70.0, 0.0 * t, 0.0 * t])  # banks left, nearly straight
    centre = np.repeat(to_geodetic(origin, target)[None], 60, axis=0)
    advance(
        winged, (sample(1, t[-1], target=(t, centre), position=(t, to_geodetic(origin, p)), command=(t, commands)),)
    )
    assert identified_radius(winged) > 0.0


def test_a_failsafe_counts_from_the_newest_telemetry_and_not_from_the_start_of_the_rollout():
    step = FailsafeStep(6.2, "RTL", "FS_LONG_ACTN 1")
    plan = FailsafePlan((step,), lambda mode, p, course: None, lost_t=1000.0)
    assert plan.steps_from(999.5)[0].after_s == pytest.approx(6.7)
    assert plan.steps_from(1000.0) == (step,)


@pytest.mark.parametrize("long", [0.0, 1.0])
def test_predictions_of_the_route_before_a_failsafe_are_not_scored_on_it(winged, long):
    with_params(winged, **RADIO, FS_SHORT_ACTN=0.0, FS_LONG_ACTN=long)
    advance(winged, (), winged.telemetry.history.newest + 1.0)
    assert winged.confidence.tracker.has_open
    lost(winged)
    assert winged.confidence.tracker.has_open == (long == 0.0)


def test_the_horizon_ends_where_a_failsafe_begins_whose_path_is_not_known(winged):
    with_params(winged, **RADIO, FS_SHORT_ACTN=0.0, FS_LONG_ACTN=5.0)  # AUTOLAND
    made = lost(winged)
    assert "whose path is not predicted" in made.sentence and not made.horizon_open
    end = made.coast_s + made.horizon_s
    assert end == pytest.approx(6.2, abs=0.2) or made.horizon_s == 0.0 or (made.method == "greybox" and end < 6.2)
