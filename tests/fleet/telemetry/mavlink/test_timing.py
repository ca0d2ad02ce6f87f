"""Clocks under jitter, drift, restarts, wraps; and what is told of them: drift, delay, round trip, satellite time."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Status
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.mavlink.timing import DRIFT_NOISE, OFFSET_SIGMA_S, LinkTiming, OffsetFilter
from fleet.telemetry.tables import clock as c
from tests.support.talker import T0, Talker, of


def flight(seconds, drift=0.0, jitter_s=0.05, boot=100.0, seed=1):
    """True times and own times of messages, and when they arrive, in that order, over a link of at least 30 ms."""
    rng = np.random.default_rng(seed)
    true = T0 + np.arange(0, seconds, 0.04)
    return (
        true,
        boot + (true - T0) * (1 - drift),
        np.maximum.accumulate(true + 0.03 + rng.exponential(jitter_s, len(true))),
    )


@pytest.mark.parametrize("drift", [-2e-4, 0.0, 5e-5, 2e-4])
def test_jitter_and_drift_leave_a_few_milliseconds(drift):
    clocks = c.new_clocks()
    timing, told, error = LinkTiming(lambda: clocks), {}, []
    for k, (true, own, arrival) in enumerate(zip(*flight(1200.0, drift), strict=True)):
        t = c.message_time(clocks, c.BOOT, own, arrival)
        error.append(t - true - 0.03)  # the quickest way cannot be known
        told = timing.status_fields(arrival) if k % 25 == 0 else told
    late = np.abs(error[25 * 60 :])
    assert np.median(late) < 5e-3 and np.quantile(late, 0.99) < 12e-3
    assert told["clock_drift"] == pytest.approx(drift, abs=2e-5)
    true, _, arrival = flight(1200.0, drift)
    assert told["latency_s"] == pytest.approx((arrival - true)[-250:].mean() - 0.03, rel=0.3)


def test_the_worst_delay_is_taken_and_begins_anew():
    clocks = c.new_clocks()
    timing = LinkTiming(lambda: clocks)
    for k in range(100):
        c.message_time(clocks, c.BOOT, 50 + 0.1 * k, T0 + 0.1 * k + (0.7 if k == 60 else 0.0))
    assert timing.status_fields(T0 + 10)["latency_worst_s"] == pytest.approx(0.7, abs=5e-3)
    assert timing.status_fields(T0 + 11)["latency_worst_s"] == 0.0


def test_after_a_restart_and_over_a_wrap_time_goes_on_and_drift_is_learnt_anew():
    clocks = c.new_clocks()
    timing, times, told = LinkTiming(lambda: clocks), [], {}
    for first, boot in ((0.0, c.WRAP_BOOT_S - 300.0), (600.0, 2.0)):
        for k, (_, own, arrival) in enumerate(zip(*flight(600.0, 1e-4, boot=boot), strict=True)):
            t = c.message_time(clocks, c.BOOT, own % c.WRAP_BOOT_S, arrival + first)
            times += [] if np.isnan(t) else [(t, arrival + first)]
            told = timing.status_fields(arrival + first) if k % 25 == 0 else told
        assert told["clock_drift"] == pytest.approx(1e-4, abs=3e-5)
        assert c.jumps(clocks) == (first > 0)
    t, arrival = np.array(times).T
    assert (np.diff(t) > 0).mean() > 0.999  # while a clock is new, its offset may still step
    assert np.quantile(np.abs(t - arrival), 0.9) < 0.25


def test_satellites_and_a_question_and_answer_tell_the_absolute_delay():
    intake, plane = MavlinkReceiver(), Talker()
    for k in range(200):
        t, boot = T0 + 0.1 * k, 500 + 0.1 * k
        intake.receive(t, plane.heartbeat() if k % 10 == 0 else plane.attitude(boot), "air")
        if k % 10 == 5:  # satellite time says it was sent 0.2 s ago
            intake.receive(
                t, plane.pack(mav.MAVLink_system_time_message(round((t - 0.2) * 1e6), round(boot * 1e3))), "air"
            )
            intake.receive(t, plane.pack(mav.MAVLink_timesync_message(1, round((t - 0.3 - 0.001 * k) * 1e9))), "air")
            intake.receive(t, plane.pack(mav.MAVLink_timesync_message(0, 77)), "air")  # a question of its own
        status = of(Status, intake.flush(t))
    status = of(Status, intake.flush(T0 + 21))[-1]
    assert status.gps_offset_s == pytest.approx(0.2, abs=5e-3)
    assert 0.39 < status.round_trip_s < 0.42


def test_a_satellite_time_that_is_none_is_no_time():
    clocks = c.new_clocks()
    timing = LinkTiming(lambda: clocks)
    timing.add_gps_time(1.7e9, 5.0)  # before any time of its own
    c.message_time(clocks, c.BOOT, 5.0, T0)
    timing.add_gps_time(0.0, 5.0)
    timing.add_round_trip(T0 + 1, T0)
    told = timing.status_fields(T0)
    assert told["gps_offset_s"] is None is told["round_trip_s"] is told["clock_drift"]


def test_the_filter_of_offset_and_drift_is_that_of_filterpy():
    ours, theirs = OffsetFilter(5.0), KalmanFilter(dim_x=2, dim_z=1)
    theirs.x, theirs.P = ours.x.copy(), ours.P.copy()
    theirs.H, theirs.R = np.array([[1.0, 0.0]]), np.array([[OFFSET_SIGMA_S**2]])
    rng = np.random.default_rng(1)
    for k in range(200):
        dt, offset_s = float(rng.uniform(10, 90)), 5.0 + 3e-5 * k + 3e-3 * rng.standard_normal()
        noise = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * DRIFT_NOISE**2
        theirs.predict(F=np.array([[1.0, dt], [0.0, 1.0]]), Q=noise)
        theirs.update(offset_s)
        ours.update(dt, offset_s)
        assert (ours.x == theirs.x).all() and (ours.P == theirs.P).all()
