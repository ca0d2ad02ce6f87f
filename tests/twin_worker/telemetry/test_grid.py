"""One grid for one aircraft's life: laid piece by piece it is what one look at everything would lay."""

from itertools import pairwise

import numpy as np
import pytest

from fleet.airframes.airframe import servo_map
from fleet.contract import Sample
from fleet.frames import Origin
from fleet.window import Window
from tests.support import flights as f
from tests.support.flights import HERE, T0
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.resample import DT, Resampler, preprocess

PLAIN, CALM = servo_map({}), np.zeros(3)
LATE_S = 1.5  # rows this late are still laid


def stream(seed: int, seconds: float = 60.0, *, late: float = 0.0, gaps: int = 0) -> list[Sample]:
    """A turn with noise, in messages of random length; some lost, some stretches lost, some rows late."""
    rng = np.random.default_rng(seed)
    laid = f.turn(seconds, rate=0.35, wind=(3.0, -1.0))
    for name in ("attitude", "velocity", "position", "servo"):
        t, x = laid[name]
        noisy = x + rng.standard_normal(x.shape) * (0.01 if name == "attitude" else 0.2)
        keep = rng.random(len(t)) > 0.05
        for _ in range(gaps):
            start = rng.uniform(5.0, seconds - 5.0)
            keep &= (t - T0 < start) | (t - T0 > start + rng.uniform(0.3, 4.0))
        laid[name] = t[keep], noisy[keep]
    out, cuts = [], np.concatenate([[T0], T0 + np.cumsum(rng.uniform(0.05, 0.9, int(3 * seconds)))])
    held = {name: rng.uniform(0.0, late, len(t)) if late else np.zeros(len(t)) for name, (t, _) in laid.items()}
    for a, b in pairwise(cuts):
        kinds = {}
        for name, (t, x) in laid.items():
            now = (t + held[name] >= a) & (t + held[name] < b)
            if now.any():
                kinds[name] = t[now], x[now]
        if kinds:
            out.append(f.sample(1, float(b), **kinds))
    return out


def look(grid: Resampler, history: TelemetryHistory, seconds: float = 30.0, wind: np.ndarray = CALM) -> Window | None:
    return grid.window(history, HERE, PLAIN, wind, until=history.newest, seconds=seconds)


def once(history: TelemetryHistory, seconds: float = 30.0, wind: np.ndarray = CALM) -> Window | None:
    return preprocess(history, HERE, PLAIN, wind, until=history.newest, seconds=seconds)


def same(piecewise: Window, whole: Window, skip: float = 8.0) -> None:
    """Compare where both lay; next to its first rows the one look has fewer neighbours to go by."""
    assert piecewise.t[-1] == whole.t[-1] and abs(piecewise.t[0] - whole.t[0]) < skip
    n = round((whole.seconds - skip) / DT)
    a, b = piecewise.part(len(piecewise) - n, len(piecewise)), whole.part(len(whole) - n, len(whole))
    assert np.array_equal(a.t, b.t)
    assert (a.ok != b.ok).sum() <= 2  # a row that lies on the very sample that ends a gap may count to either
    good = a.ok & b.ok
    turns = (a.x[:, 6:] - b.x[:, 6:])[good] / (2 * np.pi)
    assert np.allclose(turns, np.rint(turns[:1]), atol=1e-6)  # the same up to whole turns, all along
    for one, other in ((a.x[:, :6], b.x[:, :6]), (a.p, b.p), (a.v, b.v), (a.u, b.u)):
        miss = np.abs(one[good] - other[good]).max(axis=1)
        assert (miss > 1e-6).sum() <= 6 and miss.max() < 0.2  # just behind a gap a cubic may look across it or not


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("late", "gaps"), [(0.0, 0), (0.0, 2), (1.0, 0), (0.9, 2)])
def test_piece_by_piece_is_all_at_once(seed, late, gaps):
    history, grid, compared = TelemetryHistory(), Resampler(), 0
    for k, message in enumerate(stream(seed, late=late, gaps=gaps)):
        history.add(message)
        got = look(grid, history) if k % 3 == seed % 3 else None
        if got is not None and got.seconds > 20.0 and k % 4 == 0:
            whole = once(history, 45.0)
            assert whole is not None
            same(got, whole.part(len(whole) - len(got), len(whole)) if len(whole) > len(got) else whole)
            compared += 1
    assert compared >= 3


def test_rows_within_a_second_and_a_half_are_laid_later_ones_never():
    for late, laid in ((LATE_S - 0.3, True), (2 * LATE_S, False)):
        history, grid = TelemetryHistory(), Resampler()
        quick = f.turn(30.0)
        servo_t, servo = quick["servo"]
        slow = (servo_t > T0 + 15.0) & (servo_t < T0 + 15.4)
        quick["servo"] = servo_t[~slow], servo[~slow]
        for message in f.messages(quick):
            history.add(message)
            if T0 + 15.0 + late <= message.t < T0 + 15.1 + late:
                history.add(f.sample(1, message.t, servo=(servo_t[slow], servo[slow] + 100.0)))
            look(grid, history)
        got = look(grid, history)
        inside = (got.t > T0 + 15.1) & (got.t < T0 + 15.3)
        assert (got.u[inside, 0] > 0.1).all() if laid else np.abs(got.u[inside, 0]).max() < 1e-9


def test_angles_go_on_over_many_turns():
    history, grid = TelemetryHistory(), Resampler()
    for message in f.messages(f.turn(120.0, rate=0.5)):
        history.add(message)
        got = look(grid, history, 100.0)
    psi = got.columns(("psi",))[:, 0]
    assert np.allclose(np.diff(psi), 0.5 * DT, atol=1e-4) and np.ptp(psi) == pytest.approx(50.0, abs=0.5)


def test_what_is_laid_does_not_hang_on_the_wind_or_the_servos_of_its_time():
    history, grid = TelemetryHistory(), Resampler()
    for message in f.messages(f.turn(40.0, wind=(4.0, -3.0))):
        history.add(message)
        look(grid, history, wind=np.array([9.0, 9.0, 0.0]))
    got = look(grid, history, wind=np.array([4.0, -3.0, 0.0]))
    assert np.allclose(got.columns(("u", "v", "w")), [20.0, 0.0, 0.0], atol=0.05)
    turned = grid.window(history, HERE, servo_map({"SERVO1_REVERSED": 1.0}), CALM, until=history.newest, seconds=30.0)
    assert np.allclose(turned.u[:, 1:], got.u[:, 1:], atol=1e-9)


def test_another_origin_begins_anew():
    history, grid = TelemetryHistory(), Resampler()
    for message in f.messages(f.turn(40.0)):
        history.add(message)
        look(grid, history)
    north = Origin(HERE.lat_e7 + 10_000, HERE.lon_e7, HERE.alt_mm)
    got = grid.window(history, north, PLAIN, CALM, until=history.newest, seconds=30.0)
    assert np.allclose((look(grid, history).p - got.p)[:, 0], 111.0, atol=2.0)


def test_it_keeps_so_much_and_no_more():
    history, grid = TelemetryHistory(), Resampler(keep_s=20.0)
    for message in f.messages(f.turn(60.0)):
        history.add(message)
        got = look(grid, history, 1e6)
        assert got is None or got.seconds <= 20.0 + LATE_S + 0.5
    assert got.seconds > 19.0


def test_a_short_look_is_the_end_of_a_long_one():
    history, grid = TelemetryHistory(), Resampler()
    for message in stream(5):
        history.add(message)
        look(grid, history)
    short, long = look(grid, history, 10.0), look(grid, history, 30.0)
    assert np.array_equal(short.x, long.x[-len(short) :]) and np.array_equal(short.t, long.t[-len(short) :])
    assert short.seconds == pytest.approx(10.0, abs=0.1)


def test_a_kind_that_falls_silent_ends_the_window_there_and_it_goes_on_when_it_speaks():
    history, grid = TelemetryHistory(), Resampler()
    laid = f.without(f.turn(60.0), "velocity", 30.0, 45.0)
    ends = []
    for message in f.messages(laid):
        history.add(message)
        got = look(grid, history)
        ends.append(0.0 if got is None else got.t[-1] - T0)
    assert (np.diff(ends) >= -1e-6).all() and min(abs(np.array(ends) - 30.0)) < 0.2
    assert got.t[-1] - T0 > 59.5
    silent = (got.t > T0 + 31.0) & (got.t < T0 + 44.0)
    assert silent.any() and not got.ok[silent].any() and got.ok[got.t > T0 + 46.0].all()


def test_forgetting_begins_anew_even_in_the_past():
    history, grid = TelemetryHistory(), Resampler()
    for message in f.messages(f.turn(30.0)):
        history.add(message)
        look(grid, history)
    grid.clear()
    history.clear()
    early = {name: (t - 500.0, x) for name, (t, x) in f.turn(30.0).items()}
    end = max(t[-1] for t, _ in early.values())
    history.add(f.sample(1, end, **early))
    got = look(grid, history, 20.0)
    assert got is not None and got.t[-1] < T0 and got.ok.all()
