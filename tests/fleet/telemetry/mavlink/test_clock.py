import numpy as np
import pytest

from fleet.telemetry.tables import clock as c
from fleet.telemetry.tables.clock import BOOT, NONE, USEC, USEC32, WRAP_BOOT_S, WRAP_USEC_S
from tests.support.talker import T0


class Clock:
    """One clock, as a test would ask it."""

    def __init__(self, wrap_s=0.0):
        self.state = c.new_clock(wrap_s)

    def fleet(self, raw_s, arrival):
        t = c.fleet_time(self.state, raw_s, arrival, -np.inf)
        return None if np.isnan(t) else t

    @property
    def jumps(self):
        return self.state[c.JUMPS]


class Clocks:
    """The clocks of one aircraft."""

    def __init__(self):
        self.states = c.new_clocks()

    def fleet(self, tick, raw_s, arrival):
        return c.message_time(self.states, tick, raw_s, arrival)

    @property
    def jumps(self):
        return c.jumps(self.states)


def test_the_fastest_message_tells_the_offset():
    rng = np.random.default_rng(1)
    clock, boot = Clock(), 100.0
    for _ in range(2000):
        boot += 0.04
        t = clock.fleet(boot, T0 + boot + 0.01 + rng.exponential(0.05))
    assert t == pytest.approx(T0 + boot + 0.01, abs=5e-3)
    assert clock.jumps == 0


def test_drift_is_followed():
    clock, t = Clock(), 0.0
    for step in range(10_000):
        true = step * 0.1
        t = clock.fleet(true * (1 - 100e-6), T0 + true)
    assert t == pytest.approx(T0 + true, abs=5e-3)  # 0.1 s would have built up


def test_32_bits_wrap_without_a_jump():
    for wrap in (WRAP_BOOT_S, WRAP_USEC_S):
        clock = Clock(wrap)
        times = [clock.fleet((wrap - 5 + s * 0.1) % wrap, T0 + s * 0.1) for s in range(100)]
        assert np.diff(times) == pytest.approx(0.1, abs=1e-3)
        assert clock.jumps == 0


@pytest.mark.parametrize("jump", [-50.0, -1e4, 40.0, 1e6])
def test_a_jump_is_counted_once_and_time_goes_on(jump):
    clock, times = Clock(), []
    for step in range(400):
        boot = 2e4 + step * 0.05 + (jump if step >= 200 else 0.0)
        times.append(clock.fleet(boot, T0 + step * 0.05))
    assert clock.jumps == 1
    kept = [t for t in times if t is not None]
    assert len(kept) >= 398
    assert (np.diff(kept) > 0).all()
    assert kept[-1] == pytest.approx(T0 + 399 * 0.05, abs=0.05)


def test_one_late_message_is_no_jump():
    clock = Clock()
    for step in range(100):
        clock.fleet(50 + step * 0.05, T0 + step * 0.05)
    assert clock.fleet(40.0, T0 + 5.0) is None
    assert clock.fleet(55.0, T0 + 5.0) == pytest.approx(T0 + 5.0, abs=1e-2)
    assert clock.jumps == 0


def test_a_stalled_radio_is_no_jump():
    clock = Clock()
    for step in range(100):
        clock.fleet(step * 0.05, T0 + step * 0.05)
    late = [clock.fleet(5 + step * 0.05, T0 + 10.0 + step * 1e-3) for step in range(100)]
    assert np.diff(late) == pytest.approx(0.05, abs=1e-3)
    assert clock.jumps == 0


def test_usec_counts_from_boot_or_from_1970_and_is_cut_to_32_bits():
    clocks = Clocks()
    boot = 3 * WRAP_USEC_S + 100
    t = clocks.fleet(BOOT, boot, T0)
    assert clocks.fleet(USEC32, (boot + 0.02) % WRAP_USEC_S, T0 + 0.02) == pytest.approx(t + 0.02)
    assert clocks.fleet(USEC, boot + 0.03, T0 + 0.03) == pytest.approx(t + 0.03)
    unix = 1.6e9
    times = [clocks.fleet(USEC, unix + s * 0.1, T0 + 1 + s * 0.1) for s in range(50)]
    assert np.diff(times) == pytest.approx(0.1, abs=1e-6)
    assert times[0] == pytest.approx(T0 + 1)
    assert clocks.jumps == 0


def test_a_message_without_time_takes_the_newest():
    clocks = Clocks()
    assert clocks.fleet(NONE, 0.0, T0) == T0
    t = clocks.fleet(BOOT, 9.0, T0 + 0.1)
    assert clocks.fleet(NONE, 0.0, T0 + 0.13) == pytest.approx(t + 0.03)
    assert clocks.fleet(NONE, 0.0, T0 + 60.0) == pytest.approx(t + 0.5)


@pytest.mark.parametrize("pause", [2.0, 10.0, 30.0])
def test_a_clock_that_stood_still_is_anchored_anew_once_and_only_forward(pause):
    clock, rng, times, arrivals = Clock(), np.random.default_rng(2), [], []
    for step in range(4000):
        arrivals.append(T0 + step * 0.05 + (pause if step >= 1000 else 0.0) + rng.exponential(0.03))
        times.append(clock.fleet(step * 0.05, max(arrivals)))
    steps = np.diff(times) - 0.05
    assert (steps > -0.05).all() and (steps > 0.5).sum() == 1
    at = int(np.argmax(steps))
    assert 10.0 < arrivals[at] - arrivals[1000] < 31.0  # the least delay of half a minute is what tells
    assert steps[at] == pytest.approx(pause, abs=0.2) == clock.state[c.ADVANCE]
    assert times[-1] == pytest.approx(arrivals[-1], abs=0.2) and clock.jumps == 0


@pytest.mark.parametrize("speed", [0.5, 0.8, 0.97])
def test_a_clock_slower_than_real_time_is_never_half_a_minute_behind(speed):
    clock = Clock()
    behind = np.array([T0 + s * 0.05 / speed - clock.fleet(s * 0.05, T0 + s * 0.05 / speed) for s in range(8000)])
    assert behind.max() < (1 - speed) * 32.0 + 2.0 and behind.min() > -0.1
    assert 1 <= (np.diff(behind) < -0.5).sum() <= 400.0 / speed / 30.0 and clock.jumps == 0  # one in half a minute


def test_a_slow_radio_and_a_delay_that_passes_anchor_nothing():
    clock, rng, arrival = Clock(), np.random.default_rng(3), T0
    for step in range(4000):
        late = 1.0 + rng.exponential(0.5) + (3.0 if 1000 <= step < 1240 else 0.0)
        arrival = max(arrival, T0 + step * 0.05 + late)
        clock.fleet(step * 0.05, arrival)
    assert clock.state[c.ADVANCE] == 0.0 and clock.jumps == 0
