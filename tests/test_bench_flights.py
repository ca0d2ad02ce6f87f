"""The flights of the identification bench: whoever made or read them, every surface has the signs of the house."""

import numpy as np
import pytest

from fleet.frames import body_to_ned
from tests.bench import gust_limit
from tests.bench.identification import gusty, pretended, recorded
from tests.bench.identification.flight import STATE_COLUMNS, Flight, true_airspeed
from tests.bench.identification.score import fit_percent

DT = 0.04


def slopes(flight: Flight, rate: int, surface: int) -> float:
    """Give the change of a body rate by a surface, with the rate and the ground velocities accounted for."""
    smooth = np.convolve(flight.x[:, rate], np.ones(5) / 5, "same")
    good = flight.ok.copy()
    good[:50] = good[-50:] = False
    rest = np.column_stack([flight.u[:, surface], flight.x[:, [0, 1, 2, 3, 4, 5]], np.ones(len(flight))])
    return float(np.linalg.lstsq(rest[good], np.gradient(smooth, DT)[good], rcond=None)[0][0])


def check(flight: Flight, b: tuple[float, float]) -> None:
    """Hold one flight against what any flight in house signs obeys."""
    assert flight.dt == pytest.approx(DT) and len(flight) * DT > 90
    assert flight.x.shape == (len(flight), 9) and flight.u.shape == (len(flight), 4)
    assert np.isfinite(flight.x).all() and np.isfinite(flight.u).all()
    assert flight.ok.mean() > 0.9 and b[0] < flight.b < b[1]
    assert np.abs(np.diff(flight.x[:, 6:9], axis=0)).max() < 0.5  # unwrapped
    phi, theta, psi = flight.x[:, 6:9].T
    p, q, r = flight.x[:, 3:6].T
    turn = (q * np.sin(phi) + r * np.cos(phi)) / np.cos(theta)
    for angle, rate in ((phi, p), (psi, turn)):
        assert np.corrcoef(np.gradient(angle, DT), rate)[0, 1] > 0.5  # differences of a noisy angle are noisier
    climb = -body_to_ned(phi, theta, psi, flight.x[:, :3])[:, 2]
    assert np.corrcoef(theta, climb)[0, 1] > 0.3
    assert slopes(flight, 3, 0) > 0.5
    assert flight.u[:, 3].min() >= 0 and flight.u[:, 3].max() <= 1.2
    assert abs(np.nanmean(flight.Va) - np.linalg.norm(flight.x[:, :3], axis=1).mean()) < 3


def test_yardstick_flights_have_the_signs_of_the_house():
    for case in gusty.cases("doublets", 0)[:3]:
        check(case.flight, (2.5, 3.5))
        assert slopes(case.flight, 4, 1) > 3


def test_pretend_flights_have_the_signs_of_the_house_and_come_back_from_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PARAUAV_BENCH_CACHE", str(tmp_path))
    monkeypatch.setattr(pretended, "UAVS", 1)
    monkeypatch.setattr(pretended, "SECONDS", 100.0)
    case = pretended.cases(7)[0]
    check(case.flight, (2.5, 3.5))
    assert slopes(case.flight, 4, 1) > 0.1
    assert len(list(tmp_path.iterdir())) == 1
    assert np.array_equal(pretended.cases(7)[0].flight.x, case.flight.x)


def test_the_true_airframe_without_gusts_flies_as_the_flight_did_in_still_air(tmp_path, monkeypatch):
    monkeypatch.setenv("PARAUAV_BENCH_CACHE", str(tmp_path))
    for name, value in (("UAVS", 1), ("SECONDS", 60.0), ("WIND", 0.0), ("TURBULENCE", 0)):
        monkeypatch.setattr(pretended, name, value)
    case = pretended.cases(5)[0]
    ahead = case.flight.x[300:1300]
    fit = fit_percent(ahead, case.oracle.forecast(300, 1000), np.ones(1000, bool))
    assert fit.min() > 30 and np.median(fit) > 80
    each = case.oracle.kstep(300, 400, 25)
    assert np.isfinite(each[::10]).all() and np.isnan(each[1]).all()
    assert np.abs(each[0] - case.flight.x[325]).max() < 1.0


def test_gusts_of_another_seed_change_the_run_and_gusts_of_the_same_seed_repeat_it(tmp_path, monkeypatch):
    monkeypatch.setenv("PARAUAV_BENCH_CACHE", str(tmp_path))
    for name, value in (("UAVS", 1), ("SECONDS", 84.0)):
        monkeypatch.setattr(pretended, name, value)
    case = pretended.cases(5)[0]
    wind = case.oracle.mean_wind(1000, 1000)
    # a fresh aircraft each: the gusts of a run start at those that the run before has left
    calm, first, again, other = (
        pretended.cases(5)[0].oracle.fly(1000, 1000, wind, gusts=seed) for seed in (None, 1, 1, 2)
    )
    assert np.array_equal(first, again) and np.array_equal(calm, case.oracle.forecast(1000, 1000))
    assert 0.2 < (first - calm)[100:, 1].std() < 3.0 and 0.2 < (other - first)[100:, 1].std() < 3.0
    moved = case.oracle.fly(1000, 10, wind, case.flight.x[1000])
    assert np.abs(moved[0] - case.flight.x[1000]).max() < 0.02


def test_the_bench_of_the_gust_limit_scores_every_method_in_every_window(tmp_path, monkeypatch):
    monkeypatch.setenv("PARAUAV_BENCH_CACHE", str(tmp_path))
    monkeypatch.setattr(gust_limit, "GUST_RUNS", 1)
    for name, value in (("UAVS", 1), ("SECONDS", 84.0)):
        monkeypatch.setattr(pretended, name, value)
    fits = gust_limit.measure(pretended.cases(5), None, 5)
    assert set(fits) == set(gust_limit.METHODS) and {fit.shape for fit in fits.values()} == {(1, 9)}
    assert np.array_equal(fits["other gusts"], fits["one of them"])
    table = gust_limit.summary(fits)
    assert table["identified"]["identified - lon"] == 0.0
    assert table["true start"]["lat"] == pytest.approx(fits["true start"][0, STATE_COLUMNS["lat"]].mean(), abs=0.1)


@pytest.mark.recordings
@pytest.mark.parametrize("kind", ["c172p", "stack", "thor"])
def test_recorded_flights_have_the_signs_of_the_house(recordings, kind):
    cases = getattr(recorded, kind)(recordings)
    assert len(cases) == {"c172p": 6, "stack": 3, "thor": 1}[kind]
    assert len({case.flight.name for case in cases}) == len(cases)
    for case in cases:
        check(case.flight, (1.0, 12.0))
        assert case.flight.x[:, 0].min() > 6.0  # airborne from the first row to the last
    assert np.median([slopes(case.flight, 4, 1) for case in cases]) > 0.1  # one flight alone may hide its elevator


def test_true_airspeed_grows_with_height():
    assert true_airspeed(np.array([20.0]), np.array([0.0]))[0] == 20.0
    assert true_airspeed(np.array([20.0]), np.array([3000.0]))[0] == pytest.approx(20 * 1.1604, rel=1e-3)
