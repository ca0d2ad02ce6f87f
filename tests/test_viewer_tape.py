"""What is kept of one aircraft: full after a while, and counted."""

import numpy as np
import pytest
from pretend_feed import Clock, T, feed_of

from fleet.contract import Array, Prediction, State, Status
from viewer.store.forecast import Forecast
from viewer.store.received.datatime import DataTime
from viewer.timeline.recording import BARE_BYTES, KEPT_S, MAX_TOLD, ROOM, TOLD_S, Tape


@pytest.fixture
def clock() -> Clock:
    return Clock()


def told_at(t: float, horizon_s: float) -> Prediction:
    """Make a prediction of a straight minute."""
    ahead = np.arange(0.0, 60.0)
    path, tube = np.zeros((60, 3)), np.ones((60, 3))
    path[:, 0] = 20 * ahead
    told = {"ahead": Array.of(ahead), "path": Array.of(path), "tube": Array.of(tube)}
    return Prediction(
        uav=0, t=t, state=State.PREDICTING, horizon_s=horizon_s, method="dynamics", origin=(0, 0, 0), **told
    )


def test_what_is_kept_of_a_live_flight_is_full_after_ten_minutes_and_an_eighth(clock: Clock) -> None:
    feed, _, _ = feed_of(clock, 1)
    tape, vehicle, room, n = Tape(), feed.one(0), [], 0
    for k in range(1, 3_000):
        vehicle.t = T + k
        vehicle.time = DataTime(vehicle.t)
        vehicle.status = Status(uav=0, t=vehicle.t, mode=f"MODE {k // 5}")
        tape.take(vehicle, np.zeros((0, 5)), clock.now)
        n = max(n, len(tape))
        room.append(tape.nbytes())
        begin = max(vehicle.t - KEPT_S, T + 1)
        assert tape.t[0] <= begin and tape.stood_at(begin).mode == f"MODE {int(begin - T) // 5}"
    assert n <= 1.125 * KEPT_S + ROOM and len(tape.stood) == pytest.approx(KEPT_S / 5, abs=2)
    assert room[-1] == room[int(1.2 * KEPT_S)]


def test_what_is_kept_is_counted_as_it_comes_and_goes(clock: Clock) -> None:
    feed, _, _ = feed_of(clock, 1)
    tape, vehicle, most = Tape(), feed.one(0), 0

    def counted() -> int:
        told = (one.message for one in tape.told)
        return tape._t.nbytes + tape._x.nbytes + sum(len(m.path.data) + len(m.tube.data) + BARE_BYTES for m in told)

    for player, begin, n in ((-np.inf, 1, 200), (1.0, 200, MAX_TOLD + 200)):  # live, then played: of that, more is kept
        vehicle.player = player
        for k in range(begin, n):
            vehicle.t = T + 2 * TOLD_S * k
            vehicle.time = DataTime(vehicle.t)
            vehicle.forecast = Forecast(told_at(vehicle.t, 10.0 + k % 40), feed.place, clock.now)
            tape.take(vehicle, np.zeros((0, 5)), clock.now)
            assert tape.nbytes() == counted()
            most = max(most, len(tape.told))
    assert most > len(tape.told) > MAX_TOLD / 2
