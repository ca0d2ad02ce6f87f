"""Predictions between two rollouts: extrapolated from the newest position, widened by age, scored, never stale."""

import copy

import msgspec
import numpy as np
import pytest

from fleet.contract import Array, Prediction, Sample
from fleet.frames import Origin, to_geodetic
from tests.support import flights as f
from twin_worker.confidence.tube_and_horizon import AHEAD
from twin_worker.prediction.closed_loop import MIN_ROLLOUT_S
from twin_worker.telemetry.velocity import corrected_velocity
from twin_worker.twin.state.budget import LIVE_SCHEDULE, LONGEST_PERIOD_S, Schedule
from twin_worker.twin.step import Twin, advance
from twin_worker.twin.steps.extrapolate import (
    MAX_OVERDUE_AGE_S,
    MAX_ROLLOUT_AGE_S,
    continue_path,
    departure,
    extrapolate,
    widen_tube,
)


def on(twin: Twin, seconds: float, off: np.ndarray) -> None:
    """Let the aircraft be so far off the path that was foreseen."""
    base = twin.prediction.last_rollout
    path = [np.interp(seconds, base.ahead.numpy(), column) for column in base.path.numpy().T]
    lat_lon_alt = to_geodetic(twin.telemetry.origin, np.array([np.array(path) + off]))
    t = base.t + seconds
    twin.telemetry.history.add(Sample(uav=1, t=t, position=f.rows([t], lat_lon_alt)))


def remaining_share(ahead: np.ndarray) -> np.ndarray:
    """Share of an offset along, across and down that is left, (n, 3)."""
    share = (1.0 + ahead / 4.0) * np.exp(-ahead / 4.0)
    return np.stack([np.ones(len(ahead)), share, share], axis=-1)


def test_a_renewed_prediction_begins_where_the_aircraft_is_and_comes_back_to_the_path(twin: Twin) -> None:
    twin.prediction.last_rollout = twin.prediction.latest
    off = np.array([3.0, -4.0, 1.0])
    on(twin, 2.5, off)
    (made,) = extrapolate(twin)
    base = twin.prediction.last_rollout
    assert made is twin.prediction.latest and made.t == pytest.approx(base.t + 2.5)
    far = made.ahead.numpy()[-1]
    times = np.arange(0.0, base.ahead.numpy()[-1], 0.01)
    foreseen = np.column_stack([np.interp(times, base.ahead.numpy(), c) for c in base.path.numpy().T])
    distance = np.linalg.norm(made.path.numpy()[:, None] - foreseen, axis=2)
    leads = times[distance.argmin(axis=1)] - 2.5 - made.ahead.numpy()
    assert made.path.numpy()[0] - foreseen[250] == pytest.approx(off, abs=0.05) and distance.min(axis=1)[0] > 1.0
    assert (distance.min(axis=1)[made.ahead.numpy() > 30.0] < 0.3).all()  # on the path again
    assert np.ptp(leads[5:-5]) < 0.1 and leads[20] == pytest.approx(leads[0], abs=0.1)  # earlier or later, for good
    assert base.ahead.numpy()[-1] - 2.5 - 5.0 < far <= base.ahead.numpy()[-1] - 2.5
    assert made.prediction_region_half_axes.shape == made.path.shape == (len(made.ahead.numpy()), 3)


def continued(path: np.ndarray, position: list[float], velocity: list[float]) -> tuple[np.ndarray, bool]:
    """A path of one row a second, continued at 2 s."""
    ahead, out = np.arange(float(len(path))), np.empty((len(path) - 10, 3), np.float32)
    keeps_along = continue_path(ahead, path.astype(np.float32), 2.0, np.array(position), np.array(velocity), out)  # type: ignore[call-arg]
    return out.astype(float), bool(keeps_along)


STRAIGHT = np.outer(np.arange(100.0), [20.0, 0.0, 0.0])


def test_a_faster_aircraft_keeps_its_lead_and_returns_to_the_predicted_speed() -> None:
    out, keeps_along = continued(STRAIGHT, [45.0, 0.0, 0.0], [22.0, 0.0, 0.0])
    assert keeps_along
    speed = np.diff(out[:, 0])
    assert speed[0] == pytest.approx(22.0, abs=0.2) and speed[8] == pytest.approx(20.0 + 2.0 / np.e, abs=0.2)
    assert out[-1, 0] - (40.0 + 20.0 * (len(out) - 1)) == pytest.approx(5.0 + 2.0 * 8.0, abs=0.1)


def test_an_offset_across_and_down_is_critically_damped() -> None:
    out, _ = continued(STRAIGHT, [40.0, 3.0, -2.0], [20.0, 1.0, 0.0])
    tau = np.arange(len(out))
    assert out[:, 1] == pytest.approx((3.0 + (1.0 + 3.0 / 4.0) * tau) * np.exp(-tau / 4.0), abs=1e-3)
    assert out[:, 2] == pytest.approx((-2.0 - 2.0 / 4.0 * tau) * np.exp(-tau / 4.0), abs=1e-3)


def test_without_a_velocity_that_of_the_path_counts() -> None:
    unknown, _ = continued(STRAIGHT, [45.0, 3.0, 0.0], [np.nan] * 3)
    known, _ = continued(STRAIGHT, [45.0, 3.0, 0.0], [20.0, 0.0, 0.0])
    assert unknown == pytest.approx(known, abs=1e-3)


def test_a_path_without_direction_has_no_lead() -> None:
    out, keeps_along = continued(np.tile([1.0, 2.0, 3.0], (100, 1)), [4.0, 2.0, 3.0], [0.5, 0.0, 0.0])
    assert not keeps_along and out[0] == pytest.approx([4.0, 2.0, 3.0]) and out[-1] == pytest.approx([1.0, 2.0, 3.0])


@pytest.mark.parametrize("error", [0.0, 3.0])
def test_a_reported_velocity_is_corrected_by_the_displacement(error: float) -> None:
    """In a turn of 0.1 rad/s: the correction is that of the estimator, without the lag of a mean."""
    t = np.arange(0.0, 2.05, 0.1)
    p = 200.0 * np.stack([np.sin(0.1 * t), 1.0 - np.cos(0.1 * t), 0.0 * t], axis=-1)
    v = 20.0 * np.stack([np.cos(0.1 * t), np.sin(0.1 * t), 0.0 * t], axis=-1)
    found = corrected_velocity(t, p, t, v + np.array([error, 0.0, 0.0]))
    assert found == pytest.approx(v[-1], abs=0.01)


def test_a_velocity_is_unknown_without_recent_rows() -> None:
    t, rows = np.arange(0.0, 2.05, 0.1), np.zeros((21, 3))
    for of_positions, of_velocities in ((t[:0], t), (t, t[:0]), (t, t[-1:]), (t[-3:], t), (t + 9.0, t)):
        found = corrected_velocity(of_positions, rows[: len(of_positions)], of_velocities, rows[: len(of_velocities)])
        assert np.isnan(found).all()


def test_a_renewed_prediction_is_as_wide_as_the_age_of_its_rollout_demands(twin: Twin) -> None:
    """Half-axes of a rollout whose error is a random walk: c sqrt(look-ahead), and so much more for what fades."""
    base = twin.prediction.latest
    ahead = base.ahead.numpy().astype(float)
    grown = Array.of(np.outer(np.sqrt(ahead) + 0.1, [3.0, 2.0, 1.0]))
    twin.prediction.last_rollout = msgspec.structs.replace(base, prediction_region_half_axes=grown, horizon_s=30.0)
    for age in (2.0, 5.0, 9.0):
        on(twin, age, np.zeros(3))
        (made,) = extrapolate(twin)
        at, half = made.ahead.numpy().astype(float), made.prediction_region_half_axes.numpy() / [3.0, 2.0, 1.0]
        share = remaining_share(at)
        wanted = np.sqrt((np.sqrt(at + age) + 0.1) ** 2 - (np.sqrt(age) + 0.1) ** 2 * share.T * (2.0 - share.T)).T
        wanted = np.maximum(wanted, np.sqrt(at)[:, None] + 0.1)
        assert half == pytest.approx(wanted, rel=0.02, abs=0.02)  # straight between look-aheads
        assert (half[at >= 5.0, 1:] > np.sqrt(at[at >= 5.0])[:, None] + 0.1).all()
        assert made.rollout_age_s == pytest.approx(age) and made.horizon_s == pytest.approx(30.0 - age)


def test_errors_of_a_random_walk_are_held_as_often_by_renewed_tubes_as_by_new_ones() -> None:
    rng, n, age = np.random.default_rng(7), 4000, 6
    walk = np.cumsum(rng.standard_normal((n, len(AHEAD[:61]), 3)), axis=1)
    half = np.outer(np.sqrt(np.arange(61.0) + 1.0), np.full(3, 2.114))  # of 0.9 in all three at once
    tube = np.empty((50, 3), np.float32)
    widen_tube(AHEAD[:61], half, float(age), True, tube)
    error = walk[:, age : age + 50] - remaining_share(AHEAD[:50]) * walk[:, [age]]
    held = (np.abs(error) <= tube).all(axis=2).mean(axis=0)
    as_new = (np.abs(error) <= half[:50]).all(axis=2).mean(axis=0)
    assert held[1:] == pytest.approx(np.full(49, 0.9), abs=0.1) and (held[1:] > 0.88).all()
    assert as_new[20:].min() < 0.88 < held[20:].min()


def test_renewed_predictions_are_scored_and_their_coverage_is_published(heard: tuple, twin: Twin) -> None:
    twin.config = msgspec.structs.replace(twin.config, schedule=Schedule(predict=5.0, identify=1000.0, renew=0.5))
    twin.identification.timer.restart(twin.telemetry.data_t)
    rest = f.shifted([m for m in heard if isinstance(m, Sample) and m.t > heard[-1].t - 40.0], 40.0, 1e9)
    made = [m for message in rest for m in advance(twin, (message,)) if isinstance(m, Prediction)]
    coverage, n = twin.confidence.tracker.extrapolated_coverage
    assert 4 <= n <= 9 and 0.0 <= coverage <= 1.0
    assert (made[-1].coverage_propagated, made[-1].coverage_propagated_n) == pytest.approx((coverage, n))
    ages = [m.rollout_age_s for m in made]
    assert 6 <= ages.count(0.0) <= 10 and max(ages) > 4.0


def test_a_departure_is_measured_in_half_axes_at_five_seconds(twin: Twin) -> None:
    base = twin.prediction.latest
    straight = np.outer(base.ahead.numpy(), [20.0, 0.0, 0.0])
    half_axes = np.tile([10.0, 5.0, 2.0], (len(straight), 1))
    twin.prediction.last_rollout = msgspec.structs.replace(
        base, path=Array.of(straight), prediction_region_half_axes=Array.of(half_axes)
    )
    for off, wanted in (([0.0, 0.0, 0.0], 0.0), ([1.0, 0.0, 0.0], 0.1), ([0.0, 1.0, 0.0], 0.2), ([1.0, 1.0, 1.0], 0.5)):
        one = copy.deepcopy(twin)
        on(one, 2.0, np.array(off))
        assert departure(one) == pytest.approx(wanted, abs=0.02)
    other_item = copy.deepcopy(twin)
    leg_t, leg = other_item.telemetry.history.rows_since("leg")
    t = float(leg_t[-1]) + 0.1  # of the rollout: the first report of an item after it is of the next one
    other_item.prediction.last_rollout = msgspec.structs.replace(twin.prediction.last_rollout, t=t)
    next_item = f.rows([t + 0.1], [[float(leg[-1, 0]) + 1.0]])
    other_item.telemetry.history.add(Sample(uav=1, t=t + 0.1, leg=next_item))
    on(other_item, 2.0, np.zeros(3))
    assert departure(other_item) == np.inf
    twin.prediction.last_rollout = None
    assert departure(twin) == np.inf


def test_heavy_work_is_put_off_while_it_would_change_little_and_never_for_long(heard: tuple, twin: Twin) -> None:
    rest = f.shifted([m for m in heard if isinstance(m, Sample) and m.t > heard[-1].t - 40.0], 40.0, 1e9)
    counts = {}
    for schedule in (Schedule(), LIVE_SCHEDULE):
        one = copy.deepcopy(twin)
        one.config = msgspec.structs.replace(one.config, schedule=schedule)
        made, identified, longest = [], set(), 0.0
        for message in rest:
            made += [m for m in advance(one, (message,)) if isinstance(m, Prediction)]
            identified.add(one.identification.timer.last)
            longest = max(longest, one.telemetry.last_step_t - one.identification.timer.last)
        gaps = np.diff([m.t for m in made])
        assert len(made) > 36 and gaps.max() < 1.6
        assert max(m.rollout_age_s for m in made) < LONGEST_PERIOD_S + 1.0 and longest < LONGEST_PERIOD_S + 1.0
        counts[schedule.departure] = sum(m.rollout_age_s == 0.0 for m in made), len(identified)
    (every, live), (rollouts, identified_live) = counts[0.0], counts[LIVE_SCHEDULE.departure]
    assert rollouts < 0.6 * every and 3 <= identified_live < live


def test_an_event_makes_a_rollout_due_at_once(heard: tuple, twin: Twin) -> None:
    twin.config = msgspec.structs.replace(twin.config, schedule=LIVE_SCHEDULE)
    rest = f.shifted([m for m in heard if isinstance(m, Sample) and m.t > heard[-1].t - 40.0], 40.0, 1e9)
    until = next(k for k, m in enumerate(rest) if m.t > rest[0].t + 20.0)
    for message in rest[:until]:
        advance(twin, (message,))
    twin.prediction.predict_timer.expire()  # as an event does
    made = [m for m in advance(twin, rest[until : until + 1]) if isinstance(m, Prediction)]
    assert [m.rollout_age_s for m in made] == [0.0]


def test_a_renewal_after_the_origin_has_moved_is_in_the_frame_of_its_path(twin: Twin) -> None:
    twin.prediction.last_rollout = twin.prediction.latest
    on(twin, 2.0, np.array([3.0, -4.0, 1.0]))
    (before,) = extrapolate(copy.deepcopy(twin))
    far = to_geodetic(twin.telemetry.origin, np.array([51e3, 0.0, 0.0]))
    twin.telemetry.origin = Origin(*map(int, far))
    (made,) = extrapolate(twin)
    assert made.origin == before.origin == twin.prediction.last_rollout.origin
    assert made.path.numpy() == pytest.approx(before.path.numpy(), abs=0.1)
    assert (
        twin.confidence.tracker.extrapolated_coverage[1] == 0 and not twin.confidence.tracker._extrapolated
    )  # scored in the twin's own frame alone


def test_nothing_is_renewed_that_is_old_void_or_lost(twin: Twin) -> None:
    twin.prediction.last_rollout = twin.prediction.latest
    fresh = copy.deepcopy(twin)
    on(fresh, 1.0, np.zeros(3))
    assert extrapolate(fresh)
    for part, name, value in (
        ("prediction", "last_rollout", None),
        ("telemetry", "link_lost", True),
        ("prediction", "position_lost", True),
        ("telemetry", "origin", None),
    ):
        odd = copy.deepcopy(fresh)
        setattr(getattr(odd, part), name, value)
        assert extrapolate(odd) == []
    on(twin, MAX_ROLLOUT_AGE_S + 0.5, np.zeros(3))
    assert extrapolate(twin), "the next is due and waits"
    twin.prediction.predict_timer.restart(twin.prediction.last_rollout.t + MAX_ROLLOUT_AGE_S)
    assert extrapolate(twin) == []
    twin.prediction.predict_timer.restart(twin.prediction.last_rollout.t)
    on(twin, MAX_OVERDUE_AGE_S + 0.5, np.zeros(3))
    assert extrapolate(twin) == []
    short = copy.deepcopy(fresh)
    few = {
        name: Array.of(getattr(short.prediction.last_rollout, name).numpy()[:2])
        for name in ("ahead", "path", "prediction_region_half_axes")
    }
    short.prediction.last_rollout = msgspec.structs.replace(short.prediction.last_rollout, **few)
    assert extrapolate(short) == []


def test_the_shortest_flight_ahead_is_renewed_as_long_as_any(twin: Twin) -> None:
    n = int(np.searchsorted(twin.prediction.latest.ahead.numpy(), MIN_ROLLOUT_S)) + 1
    few = {
        name: Array.of(getattr(twin.prediction.latest, name).numpy()[:n])
        for name in ("ahead", "path", "prediction_region_half_axes")
    }
    twin.prediction.last_rollout = msgspec.structs.replace(twin.prediction.latest, **few)
    for seconds in (0.5, 5.0, MAX_ROLLOUT_AGE_S - 0.5):
        on(twin, seconds, np.zeros(3))
        (made,) = extrapolate(twin)
        assert made.ahead.numpy()[-1] > MIN_ROLLOUT_S - seconds - 5.0
