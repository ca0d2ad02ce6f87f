"""Telemetry to a window: sorted, interpolated exactly, gaps marked and never invented, memory bounded."""

import numpy as np
import pytest

from fleet.airframes.airframe import servo_map
from fleet.contract import Array, Rows, Sample
from fleet.telemetry.tables.row import MAX_MAGNITUDE
from tests.support import flights as f
from tests.support.flights import T0
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.resample import _median_gap, _unwrap_angles, interpolate_samples, lagrange, preprocess

PLAIN = servo_map({})
CALM = np.zeros(3)


def window(laid, wind=CALM, until: float | None = None, seconds: float = 20.0):
    history = f.remembered(f.messages(laid))
    return preprocess(history, f.HERE, PLAIN, wind, until=history.newest if until is None else until, seconds=seconds)


# --- History ---------------------------------------------------------------------------------------------------------


def test_rows_come_out_sorted_once_and_finite():
    history = TelemetryHistory()
    history.add(f.sample(leg=([T0 + 2.0, T0 + 3.0], [[2.0], [3.0]])))
    history.add(f.sample(leg=([T0, T0 + 1.0, T0 + 2.0], [[0.0], [np.nan], [9.0]])))
    history.add(f.sample(leg=([T0 + 4.0, np.nan], [[4.0], [5.0]])))
    t, x = history.rows("leg")
    assert (t - T0).tolist() == [0.0, 2.0, 3.0, 4.0]
    assert x[:, 0].tolist() == [0.0, 2.0, 3.0, 4.0]  # the first heard of two rows at one time stays


def test_every_kind_has_room_for_what_the_dialects_believe():
    history = TelemetryHistory()
    for name, highest in MAX_MAGNITUDE.items():
        history.add(f.sample(**{name: ([T0], [highest])}))
        assert history.rows(name)[1].tolist() == [list(highest)], name


def test_rows_since():
    history = TelemetryHistory()
    history.add(f.sample(leg=(T0 + np.arange(10.0), np.arange(10.0)[:, None])))
    assert history.rows("leg", T0 + 6.5)[1][:, 0].tolist() == [7.0, 8.0, 9.0]
    assert history.rows("leg", T0 + 99.0)[0].shape == (0,)
    assert history.rows("air", T0)[1].shape == (0, f.columns("air"))


def test_a_late_row_at_the_end_of_a_message_hides_nothing():
    history = TelemetryHistory()
    history.add(f.sample(leg=([T0 + 50.0, T0 + 1.0], [[50.0], [1.0]])))
    assert history.rows("leg", T0 + 40.0)[1][:, 0].tolist() == [50.0]
    assert history.newest == T0 + 50.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_time_that_is_no_time_does_not_become_the_newest(bad):
    history = TelemetryHistory()
    history.add(f.sample(leg=([T0], [[1.0]])))
    history.add(f.sample(leg=([T0 + 1.0, bad], [[2.0], [3.0]])))
    assert history.newest == T0 + 1.0
    assert history.rows("leg", T0 + 0.5)[1][:, 0].tolist() == [2.0]


def test_lying_shapes_are_counted_and_dropped():
    good = f.rows([T0], [[20.0, 0.5, 0.0]])
    lies = (
        Rows(t=Array("<f8", (2,), b"\0" * 8), x=good.x),  # bytes
        Rows(t=Array.of([T0, T0], "<f8"), x=good.x),  # rows
        f.rows([T0], [[1.0, 2.0]]),  # columns
        f.rows([T0, T0, T0], [1.0, 2.0, 3.0]),  # dimensions
        f.rows(np.empty(0), np.empty((0, 3))),  # nothing
        Rows(t=good.t, x=Array("<c8", (1, 3), b"\0" * 24)),  # no dtype of ours
    )
    history = TelemetryHistory()
    assert [history.add(Sample(uav=1, t=T0, air=lie)) for lie in lies] == [1] * len(lies)
    assert not len(history.rows("air")[0]) and history.newest == -np.inf
    assert history.add(Sample(uav=1, t=T0, air=lies[2], attitude=lies[2], leg=f.rows([T0], [[1.0]]))) == 2
    assert len(history.rows("leg")[0]) == 1  # what fits is kept


def test_memory_is_bounded_and_joins_lose_nothing_young():
    history = TelemetryHistory(keep_s=20.0)
    held = []
    for k in range(3000):
        history.add(f.sample(leg=([T0 + 0.1 * k], [[k]])))
        held.append(len(history.rows("leg")[0]))
    assert max(held) <= 20.0 / 0.1 + 60
    assert history.rows("leg", T0 + 280.0)[1][:, 0].tolist() == list(range(2800, 3000))


def test_clear_forgets():
    history = f.remembered(f.messages(f.turn(3.0)))
    history.clear()
    assert history.newest == -np.inf
    assert not len(history.rows("attitude")[0])


# --- interpolation ---------------------------------------------------------------------------------------------------


def test_lagrange_is_exact_for_cubics():
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0, 10, 40))
    grid = np.linspace(t[0], t[-1], 333)
    cubics = rng.standard_normal((4, 3))
    y, want = np.polynomial.polynomial.polyval(t, cubics).T, np.polynomial.polynomial.polyval(grid, cubics).T
    assert np.allclose(lagrange(t, y, grid), want, rtol=1e-9, atol=1e-6)
    assert np.allclose(lagrange(t, y, t), y)  # and passes through the samples


def test_lagrange_of_few_samples_is_straight():
    t, y = np.array([0.0, 1.0, 2.0]), np.array([[0.0], [2.0], [2.0]])
    assert lagrange(t, y, np.array([0.5, 1.5]))[:, 0].tolist() == [1.0, 2.0]


def test_fill_marks_lost_and_never_fills_the_long_gap():
    t = np.concatenate([np.arange(0, 1.95, 0.1), np.arange(2.3, 3.95, 0.1), np.arange(6.0, 8, 0.1)])
    grid = np.arange(0.01, 7.85, 0.04)
    y, ok, lost = interpolate_samples(t, np.sin(t)[:, None], grid, 0.5)
    short, long = (grid > 1.9) & (grid < 2.3), (grid > 3.9) & (grid < 6.0)
    assert ok[short].all() and lost[short].all()
    assert not ok[long].any() and ok[~long].all()
    assert not lost[long].any() and not lost[~(short | long)].any()
    assert np.abs(y[ok, 0] - np.sin(grid[ok])).max() < 0.02


@pytest.mark.parametrize("n", [4, 5, 40, 301])
def test_median_gap_and_unwrapped_angles_are_those_of_numpy(n):
    rng = np.random.default_rng(n)
    t = np.cumsum(rng.choice([0.04, 0.1, 0.11, 0.7], n))
    assert _median_gap(t, np.empty(n - 1)) == np.median(np.diff(t))
    x = np.cumsum(rng.uniform(-4.0, 4.0, (n, 6)), axis=0)
    x[1, 0] = x[0, 0] + np.pi  # the ambiguous step
    out = np.empty_like(x)
    _unwrap_angles(x, out)
    assert np.array_equal(out, np.hstack([np.unwrap(x[:, :3], axis=0), x[:, 3:]]))


def test_fill_does_not_reach_beyond_the_ends():
    t = np.arange(2, 4, 0.1)
    grid = np.arange(0, 6, 0.04)
    _, ok, _ = interpolate_samples(t, np.ones((len(t), 1)), grid, 0.5)
    assert not ok[(grid < 1.8) | (grid > 4.1)].any() and ok[(grid > 2.0) & (grid < 3.8)].all()
    assert not interpolate_samples(t[:3], np.ones((3, 1)), grid, 0.5)[1].any()


# --- the window ------------------------------------------------------------------------------------------------------


def test_a_known_turn_in_wind_comes_out_as_flown():
    wind = (4.0, -3.0)
    got = window(f.turn(25.0, rate=0.3, wind=wind), np.array([*wind, 0.0]))
    s = got.t - T0
    assert got.ok.all() and not got.filled.any()
    assert got.seconds == pytest.approx(20.0, abs=0.2) and got.dt == pytest.approx(0.04, abs=1e-6)
    assert np.allclose(got.columns(("u", "v", "w")), [20.0, 0.0, 0.0], atol=0.02)
    assert np.allclose(got.columns(("r", "phi", "theta")), [0.3, 0.3, 0.0], atol=1e-6)
    psi = got.columns(("psi",))[:, 0]
    turned = psi - (2.0 + 0.3 * s)
    assert np.ptp(turned) < 1e-6 and abs(turned[0]) % (2 * np.pi) < 1e-6  # seven radians, no step at +-pi
    want = 20 / 0.3 * np.column_stack([np.sin(psi) - np.sin(2.0), np.cos(2.0) - np.cos(psi)])
    assert np.allclose(got.p[:, :2], want + np.outer(s, wind), atol=0.1)
    assert np.allclose(got.p[:, 2], -100.0, atol=0.01)


@pytest.mark.parametrize("kind", ["attitude", "velocity", "position", "servo"])
def test_lost_samples_are_filled_and_counted_long_gaps_marked(kind):
    lossy = window(f.without(f.turn(25.0), kind, 10.0, 10.3))
    inside = (lossy.t - T0 > 10.05) & (lossy.t - T0 < 10.25)
    assert lossy.ok.all() and lossy.filled[inside].all()
    assert lossy.filled.mean() < 0.05
    assert np.allclose(lossy.columns(("u", "v")), [20.0, 0.0], atol=0.1)  # filled with what was flown
    broken = window(f.without(f.turn(25.0), kind, 10.0, 13.0))
    inside = (broken.t - T0 > 10.05) & (broken.t - T0 < 12.95)
    far = (broken.t - T0 < 9.9) | (broken.t - T0 > 13.2)
    assert not broken.ok[inside].any() and broken.ok[far].all()


def test_a_late_start_and_a_missing_kind():
    laid = f.without(f.turn(25.0), "velocity", -1.0, 15.0)
    assert window(laid).t[0] >= T0 + 15.0
    assert window(f.without(f.turn(25.0), "servo", 0.2, 30.0)) is None
    assert window(f.turn(1.0)) is None


def test_the_window_never_passes_the_data():
    assert window(f.turn(25.0), until=T0 + 500.0) is None
    got = window(f.turn(25.0), until=T0 + 12.0, seconds=5.0)
    assert got.t[-1] <= T0 + 12.0 and got.seconds == pytest.approx(5.0, abs=0.2)


def test_rows_newer_than_their_message_are_refused():
    history = TelemetryHistory()
    assert history.add(f.sample(t=T0, leg=([T0, T0 + 1e6], [[1], [2]]))) == 1
    assert history.newest == T0
