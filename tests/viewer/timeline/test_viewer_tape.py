"""What is kept of one aircraft: full after a while, and counted."""

import numpy as np
import pytest

from fleet.contract import Array, Prediction, Status, TwinState
from tests.support.pretend_feed import Clock, T, feed_of
from viewer.store.forecast import ScenePrediction
from viewer.store.inbox import DataTime
from viewer.timeline.recording import (
    INITIAL_ROWS,
    MAX_PREDICTIONS,
    PREDICTION_BYTES,
    PREDICTION_STEP_S,
    RETENTION_S,
    UavRecording,
)


@pytest.fixture
def clock() -> Clock:
    return Clock()


def told_at(t: float, horizon_s: float) -> Prediction:
    """Make a prediction of a straight minute."""
    ahead = np.arange(0.0, 60.0)
    path, tube = np.zeros((60, 3)), np.ones((60, 3))
    path[:, 0] = 20 * ahead
    told = {"ahead": Array.of(ahead), "path": Array.of(path), "prediction_region_half_axes": Array.of(tube)}
    return Prediction(
        uav=0, t=t, state=TwinState.PREDICTING, horizon_s=horizon_s, method="dynamics", origin=(0, 0, 0), **told
    )


def test_what_is_kept_of_a_live_flight_is_full_after_ten_minutes_and_an_eighth(clock: Clock) -> None:
    feed, _, _ = feed_of(clock, 1)
    tape, vehicle, room, n = UavRecording(), feed.get(0), [], 0
    for k in range(1, 3_000):
        vehicle.t = T + k
        vehicle.time = DataTime(vehicle.t)
        vehicle.status = Status(uav=0, t=vehicle.t, mode=f"MODE {k // 5}")
        tape.record(vehicle, np.zeros((0, 5)), clock.now)
        n = max(n, len(tape))
        room.append(tape.nbytes())
        begin = max(vehicle.t - RETENTION_S, T + 1)
        assert tape.t[0] <= begin and tape.state_at(begin).mode == f"MODE {int(begin - T) // 5}"
    assert n <= 1.125 * RETENTION_S + INITIAL_ROWS and len(tape.states) == pytest.approx(RETENTION_S / 5, abs=2)
    assert room[-1] == room[int(1.2 * RETENTION_S)]


def test_what_is_kept_is_counted_as_it_comes_and_goes(clock: Clock) -> None:
    feed, _, _ = feed_of(clock, 1)
    tape, vehicle, most = UavRecording(), feed.get(0), 0

    def counted() -> int:
        told = (one.message for one in tape.predictions)
        return (
            tape._t.nbytes
            + tape._x.nbytes
            + sum(len(m.path.data) + len(m.prediction_region_half_axes.data) + PREDICTION_BYTES for m in told)
        )

    for player, begin, n in (
        (-np.inf, 1, 200),
        (1.0, 200, MAX_PREDICTIONS + 200),
    ):  # live, then played: of that, more is kept
        vehicle.replay_seen = player
        for k in range(begin, n):
            vehicle.t = T + 2 * PREDICTION_STEP_S * k
            vehicle.time = DataTime(vehicle.t)
            vehicle.forecast = ScenePrediction(told_at(vehicle.t, 10.0 + k % 40), feed.scene_frame, clock.now)
            tape.record(vehicle, np.zeros((0, 5)), clock.now)
            assert tape.nbytes() == counted()
            most = max(most, len(tape.predictions))
    assert most > len(tape.predictions) > MAX_PREDICTIONS / 2
