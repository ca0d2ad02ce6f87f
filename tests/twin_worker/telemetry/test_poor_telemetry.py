"""Telemetry of 1 to 4 Hz, a frozen airspeed, no airspeed at all: what a twin still makes of it."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from fleet.airframes.airframe import servo_map
from fleet.contract import Prediction
from fleet.telemetry.recording.recordings import replay_messages
from fleet.window import MAX_GAP_S, Window, longest_gap
from tests.support import flights as f
from tests.support.decimated import decimate
from tests.support.flights import HERE, HZ, T0
from twin_worker.evaluation.replay import run_offline
from twin_worker.telemetry.resample import preprocess
from twin_worker.twin.state.state import ingest
from twin_worker.twin.step import Twin

AMPLITUDE, OMEGA = 0.5, 1.2  # rolling: phi = A sin(w s) [rad, rad/s]


def rolling(hz: float, seconds: float = 40.0) -> f.Laid:
    """A flight that rolls from side to side, with attitude and servos at a low rate."""
    laid = f.turn(seconds, rate=0.0)
    t = T0 + np.arange(0.0, seconds, 1.0 / hz)
    phi, p = AMPLITUDE * np.sin(OMEGA * (t - T0)), AMPLITUDE * OMEGA * np.cos(OMEGA * (t - T0))
    still = np.zeros(len(t))
    laid["attitude"] = t, np.column_stack([phi, still, still + 2.0, p, still, still])
    laid["servo"] = t, np.full((len(t), 8), 1500.0)
    return laid


def window(laid: f.Laid) -> Window | None:
    history = f.remembered(f.messages(laid))
    return preprocess(history, HERE, servo_map({}), np.zeros(3), until=history.newest, seconds=30.0)


@pytest.mark.parametrize(("hz", "error"), [(4.0, 0.001), (2.0, 0.01), (1.0, 0.05)])
def test_a_low_rate_is_no_gap_and_measured_rates_tell_what_is_between(hz: float, error: float) -> None:
    got = window(rolling(hz))
    assert got is not None and got.ok.all()
    s = got.t - T0
    phi, p = got.columns(("phi", "p")).T
    straight = np.interp(s, np.arange(0.0, 40.0, 1.0 / hz), AMPLITUDE * np.sin(OMEGA * np.arange(0.0, 40.0, 1.0 / hz)))
    truth = AMPLITUDE * np.sin(OMEGA * s)
    assert np.abs(phi - truth).max() < error < np.abs(straight - truth).max()
    assert np.abs(p - AMPLITUDE * OMEGA * np.cos(OMEGA * s)).max() < 8 * error


def test_without_measured_rates_angles_are_interpolated_alone() -> None:
    laid = rolling(2.0)
    t, x = laid["attitude"]
    laid["attitude"] = t, np.column_stack([x[:, :3], 0.0 * x[:, 3:]])
    got = window(laid)
    assert got is not None
    assert np.abs(got.columns(("phi",))[:, 0] - AMPLITUDE * np.sin(OMEGA * (got.t - T0))).max() < 0.05


def test_one_lost_row_of_1_hz_is_filled_and_two_are_a_gap() -> None:
    assert (longest_gap(0.5, 0.04), longest_gap(0.5, 0.5), longest_gap(0.5, 1.0)) == (0.5, 1.25, MAX_GAP_S)
    one = window(f.without(rolling(1.0), "attitude", 19.5, 20.5))
    two = window(f.without(rolling(1.0), "attitude", 19.5, 21.5))
    assert one is not None and one.ok.all()
    assert two is not None
    missing = (two.t > T0 + 19.05) & (two.t < T0 + 21.95)
    assert not two.ok[missing].any() and two.ok[two.t < T0 + 18.9].all()


def with_air(Va: np.ndarray | float, *, wind: bool = False) -> Twin:
    """A twin that has received a turn in wind, with these airspeeds and perhaps the autopilot's wind."""
    laid = f.turn(40.0, wind=(5.0, -3.0))
    t, air = laid["air"]
    laid["air"] = t, np.column_stack([np.zeros(len(t)) + Va, air[:, 1:]])
    if wind:
        t_w = T0 + np.arange(0.0, 40.0, 0.5)
        laid["wind"] = t_w, np.tile([5.0, -3.0], (len(t_w), 1))
    twin = Twin.of(1)
    for message in f.messages(laid):
        ingest(twin, message)
        twin.environment.update_wind(twin.telemetry.history)
    return twin


def test_a_constant_airspeed_is_no_airspeed() -> None:
    frozen, varying = with_air(14.0), with_air(20.0 + 1e-3 * np.sin(np.arange(400.0)))
    assert not frozen.telemetry.history.rows("air")[1][:, 0].any()
    assert frozen.telemetry.frozen_airspeed == 14.0
    assert np.abs(varying.telemetry.history.rows("air")[1][:, 0] - 20.0).max() < 0.01
    assert varying.environment.wind.wind[:2] == pytest.approx((5.0, -3.0), abs=0.5)


def test_an_airspeed_that_thaws_is_used_again() -> None:
    n = int(40.0 * HZ["air"])
    Va = np.where(np.arange(n) < n // 2, 14.0, 20.0 + 1e-3 * np.sin(np.arange(n)))
    twin = with_air(Va)
    _, air = twin.telemetry.history.rows("air")
    assert not air[: n // 2 - 1, 0].any() and air[n // 2 + 1 :, 0].min() > 19.9
    assert np.isnan(twin.telemetry.frozen_airspeed)


@pytest.mark.parametrize("Va", [0.0, 14.0])
def test_without_airspeed_the_wind_is_the_autopilots(Va: float) -> None:
    twin = with_air(Va, wind=True)
    assert twin.environment.wind.wind[:2] == pytest.approx((5.0, -3.0), abs=0.01)
    seen = twin.window(20.0)
    assert seen is not None and np.median(seen.columns(("u",))) == pytest.approx(20.0, abs=0.2)


def test_with_airspeed_the_wind_is_the_filters() -> None:
    twin = with_air(20.0 + 1e-3 * np.sin(np.arange(400.0)), wind=True)
    assert twin.environment.reported_wind_t < T0 + 3.0 and twin.environment.wind.sigma < 2.0


@pytest.mark.parametrize("hz", [1.0, 2.0])
def test_a_recorded_flight_at_a_low_rate_is_predicted_by_an_identified_model(
    hz: float, recordings: Path, tmp_path: Path
) -> None:
    slow = decimate(recordings / "sitl-more" / "n1.tlog.xz", hz, tmp_path / "slow.tlog", until_s=240.0)
    heard = list(replay_messages(slow))
    made = [m for m in run_offline(heard, {}) if isinstance(m, Prediction) and m.t > heard[0].t + 200.0]
    methods = Counter(m.method for m in made)
    identified = sum(methods[name] for name in ("dynamics", "hybrid", "both"))
    assert len(made) > 30 and identified > 0.8 * len(made), methods
