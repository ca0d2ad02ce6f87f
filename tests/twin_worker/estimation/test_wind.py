"""The wind triangle solved backwards: a circle tells wind, airspeed scale and heading bias."""

from math import cos, sin

import numpy as np
import pytest

from fleet.frames import rotation
from twin_worker.estimation.wind_filter import WindFilter, reported_direction

WIND = np.array([5.0, -3.0])
VA, RATE = 20.0, 0.2


def flown(seconds: float, *, rate=RATE, scale=1.0, bias=0.0, noise=0.5, spikes=0, seed=0) -> WindFilter:
    """Feed five rows a second of a circle in wind; `rate` 0 flies straight on."""
    rng = np.random.default_rng(seed)
    filt = WindFilter()
    for k in range(int(5 * seconds)):
        psi = rate * k / 5
        air = scale * VA * np.array([cos(psi + bias), sin(psi + bias)])
        ground = np.array([*(air + WIND + noise * rng.standard_normal(2)), 0.0])
        if spikes and k > 100 and k % spikes == 0:
            ground[:2] += 80.0
        filt.update(k / 5, ground, VA, psi)
    return filt


@pytest.mark.parametrize("scale", [1.0, 1.08, 0.94])
def test_a_circle_tells_wind_and_airspeed_scale(scale):
    filt = flown(120.0, scale=scale)
    assert np.allclose(filt.wind, [*WIND, 0.0], atol=0.3)
    assert filt.scale == pytest.approx(scale, abs=0.015)
    assert filt.heading_bias == pytest.approx(0.0, abs=0.015)


def test_a_circle_tells_the_heading_bias():
    assert flown(120.0, bias=0.08).heading_bias == pytest.approx(0.08, abs=0.015)


def test_a_drifting_heading_is_no_wind():
    filt, reported = WindFilter(), []
    rng = np.random.default_rng(3)
    for k in range(600):
        psi, drift = RATE * k / 5, 0.008 * max(k / 5 - 60.0, 0.0)  # 27 deg in a minute
        air = VA * np.array([cos(psi), sin(psi)])
        filt.update(k / 5, np.array([*(air + WIND + 0.5 * rng.standard_normal(2)), 0.0]), VA, psi - drift)
        reported.append(filt.wind[:2])
    assert np.abs(np.array(reported)[400:] - WIND).max() < 1.0
    assert filt.heading_bias == pytest.approx(0.48, abs=0.06)


def test_doubt_shrinks_with_turns_only():
    straight, circle = flown(60.0, rate=0.0), flown(60.0)
    assert circle.sigma < 0.7 * straight.sigma < WindFilter().sigma


@pytest.mark.parametrize(("drift", "least", "most"), [(0.0, 0.15, 0.35), (0.6, 0.2, 0.9), (2.4, 1.2, 2.4)])
def test_the_flight_tells_how_much_the_wind_drifts(drift, least, most):
    found = []
    for seed in range(4):
        rng, filt, slow, gust = np.random.default_rng(seed), WindFilter(), np.zeros(2), np.zeros(2)
        assert filt.drift_sigma == pytest.approx(1.43, abs=0.01)  # nothing is known yet
        for k in range(5 * 400):
            psi = 0.02 * k / 5 + 0.8 * np.sin(0.05 * k / 5)
            slow = slow * np.exp(-0.2 / 60.0) + drift * np.sqrt(1 - np.exp(-0.4 / 60.0)) * rng.standard_normal(2)
            gust = gust * np.exp(-0.2 / 7.0) + 0.8 * np.sqrt(1 - np.exp(-0.4 / 7.0)) * rng.standard_normal(2)
            air = VA * np.array([cos(psi), sin(psi)])
            read = (
                air - gust + rng.standard_normal(2)
            )  # a gust changes what is read at once, and the ground velocity late
            north, east = air + WIND + slow
            filt.update(k / 5, (north, east, 0.0), float(np.hypot(*read)), float(np.arctan2(read[1], read[0])))
        found.append(filt.drift_sigma)
    assert least <= np.median(found) <= most


def test_spikes_are_gated():
    assert np.allclose(flown(120.0, spikes=20).wind, [*WIND, 0.0], atol=0.3)


def test_rows_that_tell_nothing_are_passed_over():
    filt = flown(60.0)
    before = filt.wind
    filt.update(filt.t, np.array([99.0, 99.0, 0.0]), VA, 0.0)  # a repeat
    filt.update(filt.t - 5.0, np.array([99.0, 99.0, 0.0]), VA, 0.0)  # a late one
    filt.update(filt.t + 1.0, np.array([0.1, 0.1, 0.0]), 0.5, 0.0)  # standing on the ground
    assert np.array_equal(filt.wind, before)


def test_a_steep_dive_and_a_long_silence_stay_finite():
    filt = flown(30.0)
    filt.update(filt.t + 1e6, np.array([5.0, 5.0, 60.0]), VA, 1.0)
    assert np.isfinite([*filt.wind, filt.scale, filt.sigma]).all()


def test_a_wind_that_cannot_be_is_never_told():
    """Airspeed and velocity as telemetry lets them through, whatever the first rows say, and estimates of others."""
    for seed in range(20):
        rng, filt = np.random.default_rng(seed), WindFilter()
        for k in range(80):
            wild = 10.0 ** rng.uniform(1.0, 5.0) if rng.random() < 0.3 else 1.0
            filt.update(k / 5, np.clip(20.0 * wild * rng.standard_normal(3), -1e5, 1e5), min(VA * wild, 1e5), k)
            assert np.hypot(*filt.wind[:2]) < 150.0
    filt = flown(60.0)
    before = filt.wind
    for odd in (np.inf, np.nan, 1e4):
        filt.reset_wind(filt.t, np.array([odd, 0.0, 0.0]))
        filt.inflate_after_step(np.array([odd, 0.0, 0.0]), 1.0, 0.1)
    filt.inflate_after_step(np.zeros(3), np.inf, 0.1)
    assert np.array_equal(filt.wind, before) and np.isfinite(filt.P).all()


def test_gusts_in_the_readings_do_not_reduce_the_scale():
    """A gust is read at once, by pitot tube and nose; the ground velocity hardly follows it."""
    found = []
    for seed in range(6):
        rng, filt, gust = np.random.default_rng(seed), WindFilter(), np.zeros(2)
        for k in range(5 * 300):
            psi = 0.02 * k / 5 + 0.8 * np.sin(0.05 * k / 5)
            gust = gust * np.exp(-0.2 / 2.0) + 1.5 * np.sqrt(1 - np.exp(-0.4 / 2.0)) * rng.standard_normal(2)
            air = 1.03 * VA * np.array([cos(psi), sin(psi)])
            read = air - gust
            reported = float(np.hypot(*read)) / 1.03
            filt.update(k / 5, (*(air + WIND), 0.0), reported, float(np.arctan2(read[1], read[0])))
        found.append(filt.scale)
    assert np.mean(found) == pytest.approx(1.03, abs=0.01)


def test_the_scale_begins_with_the_standard_atmosphere():
    filt = WindFilter()
    filt.expect_scale(2_000.0)
    assert filt.scale == pytest.approx(1.10, abs=0.01)
    filt.update(0.0, (*(np.array([VA, 0.0]) + WIND), 0.0), VA, 0.0)
    begun = filt.scale
    filt.expect_scale(0.0)
    assert filt.scale == begun


def test_a_reported_wind_outlasts_the_expected_scale():
    """Without airspeed there are no rows: each altitude sets the scale anew, and the wind of the autopilot stays."""
    filt = WindFilter()
    filt.reset_wind(0.0, np.array([*WIND, 0.0]))
    filt.expect_scale(2_000.0)
    assert np.allclose(filt.wind, [*WIND, 0.0])


def test_the_angle_of_attack_turns_the_air_velocity_out_of_the_turn():
    """Against the exact rotation of (cos alpha, 0, sin alpha), at the pitch of a level turn."""
    for phi in (-0.7, -0.3, 0.0, 0.5, 0.8):
        alpha, psi = 0.09, 2.0
        theta = float(np.arctan2(np.sin(alpha) * cos(phi), np.cos(alpha)))  # level flight
        air = rotation(phi, theta, psi) @ np.array([cos(alpha), 0.0, sin(alpha)])
        assert air[2] == pytest.approx(0.0, abs=1e-9)
        assert reported_direction(phi, theta, psi, 0.0, VA) == pytest.approx(np.arctan2(air[1], air[0]), abs=0.006)
