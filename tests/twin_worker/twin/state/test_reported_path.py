"""GUIDED along a path that an onboard computer commands: only bearing and crosstrack error tell where it leads."""

import numpy as np
import pytest

from fleet.contract import Link, Status
from fleet.frames import G, to_geodetic
from fleet.mission import P_N
from tests.support.flights import HERE, T0, messages, predictions, turn
from twin_worker.prediction.autopilot_parameters import fixed_wing_controller
from twin_worker.twin.state.reported_path import reported_path
from twin_worker.twin.state.state import Twin
from twin_worker.twin.step import advance

VA, LEFT = 20.0, 6.0  # m/s; m left of the path
PERIOD, DAMPING = 14.0, 0.9


def flown(rate: float, *, mode: str = "GUIDED", at_target: bool = False, seconds: float = 30.0) -> Twin:
    """A turn or a straight flight, left of a path of the same course, and what the autopilot reports of it."""
    laid = turn(seconds, rate=rate, psi=1.0, Va=VA, bank=np.arctan(rate * VA / G))
    t, _ = laid["position"]
    course = 1.0 + rate * (t - T0)
    nu = np.arcsin(LEFT * np.pi / (DAMPING * PERIOD * VA))
    phi_c = np.arctan(4 * DAMPING * np.pi * VA * np.sin(nu) / (PERIOD * G))
    command = np.column_stack([np.full((len(t), 2), [phi_c, 0.0]), np.full(len(t), LEFT), np.zeros((len(t), 2))])
    far = (
        np.array([400.0, 9000.0, -100.0]) if not at_target else np.array([5e4 * np.cos(1.0), 5e4 * np.sin(1.0), -100.0])
    )
    lat, lon, alt = to_geodetic(HERE, far)
    laid |= {
        "command": (t, command),
        "bearing": (t, course[:, None]),
        "target": (t, np.tile([float(lat), float(lon), float(alt)], (len(t), 1))),
    }
    twin = Twin.of(1)
    status = Status(uav=1, t=T0, link=Link.LIVE, mode=mode, armed=True, autopilot="ardupilot", vehicle="fixed_wing")
    for message in (status, *messages(laid)):
        list(advance(twin, (message,)))
    return twin


def test_a_straight_path_lies_right_of_an_aircraft_with_positive_crosstrack_error():
    twin = flown(0.0)
    path = reported_path(twin)
    assert path is not None and len(path.route.legs) == 1
    along = path.route.legs[0, P_N : P_N + 2] - path.route.start[:2]
    assert np.arctan2(along[1], along[0]) == pytest.approx(1.0, abs=0.01)
    recent = twin.telemetry.history.rows_since("position", 0.0)[1][-1]
    lat, lon, _ = to_geodetic(path.route.origin, path.route.start)
    assert np.hypot(lat - recent[0], lon - recent[1]) > 100  # 1e-7 deg: the path is metres away
    assert path.law["NAVL1_PERIOD"] / path.law["NAVL1_DAMPING"] == pytest.approx(PERIOD / DAMPING, rel=0.15)
    assert "NAVL1_PERIOD" in fixed_wing_controller({}, path.law, law="arduplane").values


def test_a_course_that_turns_continues_as_an_arc():
    path = reported_path(flown(0.2))
    assert path is not None and len(path.route.legs) > 5
    points = np.vstack([path.route.start, path.route.legs[:-1, P_N : P_N + 3]])[:, :2]
    headings = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    assert np.diff(headings) == pytest.approx(np.full(len(headings) - 1, np.radians(15.0)), abs=1e-6)
    chord = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert chord == pytest.approx(2 * (VA / 0.2) * np.sin(np.radians(7.5)), rel=0.05)


def test_a_path_that_returned_to_where_it_was_repeats_its_circuit():
    twin = flown(0.2, seconds=45.0)
    path = reported_path(twin)
    assert path is not None and path.repeats
    points = path.route.legs[:-1, P_N : P_N + 2]
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    assert np.linalg.norm(points - centre, axis=1) == pytest.approx(VA / 0.2 - LEFT, rel=0.06)  # right of a right turn
    latest = predictions(advance(twin, (), twin.telemetry.history.newest + 1.0))[-1:] or [twin.prediction.latest]
    ahead, positions = latest[0].ahead.numpy(), latest[0].path.numpy().astype(float)[:, :2]
    one_lap = int(np.searchsorted(ahead, 2 * np.pi / 0.2))
    assert np.linalg.norm(positions[one_lap] - positions[0]) < 40.0
    assert np.linalg.norm(positions[one_lap // 2] - positions[0]) > 150.0  # the other side of the circle


def test_a_path_that_crosses_itself_in_another_direction_does_not_repeat():
    assert not reported_path(flown(0.0)).repeats
    assert not reported_path(flown(0.2, seconds=25.0)).repeats


def test_a_path_that_is_not_known_ends_in_the_area_flown_so_far():
    twin = flown(0.2, seconds=25.0)
    path = reported_path(twin)
    assert path is not None
    latest = predictions(advance(twin, (), twin.telemetry.history.newest + 1.0))[-1:] or [twin.prediction.latest]
    positions = latest[0].path.numpy().astype(float)[:, :2]
    assert np.linalg.norm(positions[-1] - path.centre) < 0.5 * path.spread


def test_flight_to_the_reported_target_and_other_modes_have_no_such_path():
    assert reported_path(flown(0.0, at_target=True)) is None
    assert reported_path(flown(0.0, mode="AUTO")) is None


def test_the_prediction_follows_the_path_instead_of_the_turn_rate():
    twin = flown(0.0)
    made = predictions(advance(twin, (), twin.telemetry.history.newest + 1.0))
    latest = made[-1] if made else twin.prediction.latest
    assert latest is not None and latest.method == "greybox" and "reported course" in latest.sentence
    ahead, path = latest.ahead.numpy(), latest.path.numpy().astype(float)
    k = int(np.searchsorted(ahead, 5.0))
    right = (path[k] - path[0])[:2] @ np.array([-np.sin(1.0), np.cos(1.0)])
    assert right == pytest.approx(LEFT, abs=2.0)  # onto the path
    travelled = np.linalg.norm(path[[k, int(np.searchsorted(ahead, 60.0))], :2] - path[0, :2], axis=1)
    assert travelled[1] < 0.8 * travelled[0] / ahead[k] * 60.0  # what follows is not known, and may turn
