"""The multirotor's twin on flights of other physics: it beats the turn-rate guess by far, and says what it is."""

import msgspec
import numpy as np
import pytest

from fleet.autopilots import copter, copter_legs
from fleet.contract import Mission, Params, Prediction, Sample, Status, TwinState
from fleet.frames import to_ned
from tests.support import hover
from tests.support.flights import predictions, published
from twin_worker.confidence.tube_and_horizon import AHEAD
from twin_worker.evaluation.replay import run_offline
from twin_worker.prediction.constant_turn import imm
from twin_worker.twin.step import Twin

SEED = 106


@pytest.fixture(scope="module")
def mission() -> hover.Flight:
    return hover.fly(SEED)


@pytest.fixture(scope="module")
def answered(mission) -> tuple[Twin, list[Prediction]]:
    twins: dict[int, Twin] = {}
    results = list(run_offline(mission.messages, twins))
    published(results)
    return twins[7], predictions(results)


def reported(flight: hover.Flight, made: Prediction) -> tuple[np.ndarray, np.ndarray]:
    """Times and positions as reported, in the frame of the prediction."""
    rows = [m.position for m in flight.messages if isinstance(m, Sample) and m.position is not None]
    x = np.concatenate([r.x.numpy() for r in rows]).astype(float)
    return np.concatenate([r.t.numpy() for r in rows]), to_ned(made.ned_origin(), *x.T)


def misses(flight: hover.Flight, made: list[Prediction], ahead: float) -> np.ndarray:
    t, p = reported(flight, made[0])
    at = [m for m in made if m.t + ahead < t[-1]]
    where = [np.array([np.interp(m.t + ahead, t, c) for c in p.T]) for m in at]
    return np.array([np.linalg.norm(m.path.numpy()[int(ahead)] - w) for m, w in zip(at, where, strict=True)])


def test_it_follows_its_route_by_its_own_law(mission, answered):
    twin, made = answered
    late = [p for p in made if p.t > mission.t[0] + 5.0]
    assert {p.method for p in late} == {"copter"} and {p.law for p in late} == {copter_legs.LAW}
    assert all(p.state is TwinState.PREDICTING and p.seq >= 1 for p in late)
    assert "kinematic twin: lag" in late[-1].sentence
    assert "no motor outputs yet" in twin.identification.verdict.sentence and twin.models.active_model is None


def test_it_stays_near_the_flight_for_a_minute(mission, answered):
    _, made = answered
    for ahead, most in ((10.0, 4.0), (30.0, 12.0), (60.0, 20.0)):
        assert np.median(misses(mission, made, ahead)) < most


def test_it_beats_the_guess_by_turn_rate(mission, answered):
    _, made = answered
    t, p = reported(mission, made[0])
    guess = []
    for one in (m for m in made if m.t + 30.0 < t[-1] and m.t > t[0] + 15.0):
        past = one.t - 0.5 * np.arange(24)[::-1]
        where = np.column_stack([np.interp(past, t, c) for c in p.T])
        path = imm(where, np.gradient(where, 0.5, axis=0), AHEAD)
        guess.append(np.linalg.norm(path[30] - [np.interp(one.t + 30.0, t, c) for c in p.T]))
    assert np.median(misses(mission, made, 30.0)) < 0.2 * np.median(guess)


def test_its_tube_is_its_own_and_honest(answered):
    twin, _ = answered
    held, n = twin.confidence.tracker.coverage
    assert n > 20 and held > 0.8
    assert twin.confidence.tracker.t10("copter")[2] > 20 and not twin.confidence.tracker.t10("paper")[2]


def test_it_learns_lag_and_speed_from_flight(answered):
    twin, _ = answered
    assert twin.models.multirotor.n_starts > 5 and twin.models.multirotor.mean_error < 3.0
    assert 0.9 <= twin.models.multirotor.speed_fraction <= 1.1 and 0.5 < twin.models.multirotor.wn < 3.0


def changed(flight: hover.Flight, until: float, **status) -> list:
    start = flight.messages[0].t
    heard = [m for m in flight.messages if m.t < start + until]
    return [msgspec.structs.replace(m, **status) if isinstance(m, Status) else m for m in heard]


def test_without_parameters_it_finds_its_speed_in_the_flight(mission):
    bare = [msgspec.structs.replace(m, values={}) if isinstance(m, Params) else m for m in mission.messages[:900]]
    made = predictions(run_offline(bare, {}))
    late = [p for p in made if p.t > mission.t[0] + 60.0]
    assert {p.method for p in late} == {"copter"} and "limits not received" in late[-1].sentence
    short = hover.Flight(mission.t, mission.p, bare, mission.items)
    assert np.median(misses(short, late, 10.0)) < 8.0


@pytest.mark.parametrize("mode", ["LOITER", "BRAKE", "POSHOLD"])
def test_told_to_hold_it_stops(mission, mode):
    heard = changed(mission, 25.0)
    last = heard[-1]
    twins: dict[int, Twin] = {}
    list(run_offline(heard, twins))
    (made,) = predictions(run_offline([Status(uav=7, t=last.t, mode=mode, armed=True, vehicle="multirotor")], twins))
    path = made.path.numpy()
    assert made.method == "copter" and f"{mode} holds" in made.sentence and made.seq == -1
    assert np.linalg.norm(path[-1] - path[0]) < 40.0 and np.linalg.norm(path[-1] - path[20]) < 0.1


def test_on_the_ground_by_hand_and_without_a_mission_it_is_a_guess(mission):
    for why, heard in (
        ("not armed", changed(mission, 12.0, armed=False)),
        ("STABILIZE follows no mission", changed(mission, 12.0, mode="STABILIZE")),
        ("no mission on board", [m for m in changed(mission, 12.0) if not isinstance(m, Mission)]),
    ):
        made = predictions(run_offline(heard, {}))
        assert {p.method for p in made} == {"imm"} and why in made[-1].sentence, why
        assert "turn rate only" in made[-1].sentence and made[-1].state is TwinState.WAITING


def test_a_return_to_launch_ends_at_home(mission):
    heard = changed(mission, 25.0)
    twins: dict[int, Twin] = {}
    list(run_offline(heard, twins))
    (made,) = predictions(
        run_offline([Status(uav=7, t=heard[-1].t, mode="RTL", armed=True, vehicle="multirotor")], twins)
    )
    assert made.method == "copter" and "returns to launch" in made.sentence
    path = made.path.numpy()
    assert np.linalg.norm(path[-1, :2]) < np.linalg.norm(path[0, :2])


def test_one_compiled_form_serves_all(answered):
    assert len(copter.follow.signatures) == 1
