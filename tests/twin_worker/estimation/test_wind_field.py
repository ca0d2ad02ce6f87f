"""The wind field of a fleet: found from estimates, surer near them, own drift separate, invalid messages rejected."""

from math import nan

import numpy as np
import pytest
from msgspec.structs import replace

from fleet.bus.codec import decode, encode
from fleet.contract import Array, WindEstimate, WindField
from fleet.frames import Origin, to_geodetic
from tests.support.examples import EXAMPLES
from twin_worker.estimation.wind_field import (
    MAX_AGE_S,
    SharedWind,
    WindFieldEstimator,
    estimate_defect,
    field_defect,
    own_wind,
)
from twin_worker.estimation.wind_filter import WindFilter

HOME, T = Origin(470_000_000, 80_000_000, 400_000), 1_700_000_000.0
AHEAD = np.arange(0.0, 61.0, 5.0)


def estimate(t: float, p: np.ndarray, wind: np.ndarray, sigma: float = 0.2) -> WindEstimate:
    lat, lon, alt = to_geodetic(HOME, p)
    position = int(lat), int(lon), int(alt)
    return WindEstimate(
        t=float(t), position=position, height_m=-float(p[2]), wind=(float(wind[0]), float(wind[1])), sigma=sigma
    )


def structure(p: np.ndarray, t: float) -> np.ndarray:
    """A wave of 0.8 m/s that drifts north with the mean wind of 5 m/s, stronger aloft."""
    wave = 0.8 * np.sin((p[0] - 5.0 * t) / 250.0)
    return np.array([5.0 * (-p[2] / 100.0) ** 0.2 + wave, wave])


def estimator(truth=structure, uavs: int = 12, own: float = 0.0, seed: int = 1) -> WindFieldEstimator:
    rng, out = np.random.default_rng(seed), WindFieldEstimator()
    places = np.column_stack([rng.uniform(-800, 800, (uavs, 2)), rng.uniform(-180, -80, uavs)])
    course, drift = rng.uniform(0, 2 * np.pi, uavs), own * rng.standard_normal((uavs, 2))
    for t in np.arange(0.0, 121.0, 5.0):
        for uav in range(uavs):
            turned = course[uav] + 20.0 / 300.0 * t  # a circle of 300 m
            p = places[uav] + 300.0 * np.array([np.cos(turned), np.sin(turned), 0.0])
            wind = truth(p, t) + drift[uav] + 0.2 * rng.standard_normal(2)
            out.add(uav, estimate(T + t, p, wind))
    return out


def found(truth=structure, **kwargs) -> SharedWind:
    wind_field = estimator(truth, **kwargs).estimate()
    assert wind_field is not None
    return SharedWind(decode(WindField, encode(wind_field)))


def path(n: int = len(AHEAD)) -> np.ndarray:
    return np.column_stack([np.linspace(-400, 400, n), np.zeros(n), np.full(n, -120.0)])


def test_a_drifting_structure_and_the_profile_are_found_along_a_path() -> None:
    wind = found().along(99, T + 120.0, AHEAD, path(), HOME)
    assert wind is not None
    truth = np.array([structure(p, 120.0 + t) for p, t in zip(path(), AHEAD, strict=True)])
    mean = np.array([5.0 * 1.2**0.2, 0.0])
    error, before = np.sqrt(np.mean((wind.mean - truth) ** 2)), np.sqrt(np.mean((truth - mean) ** 2))
    assert error < 0.5 * before
    assert error < 3 * np.sqrt(np.diag(wind.cov).mean())
    assert np.linalg.eigvalsh(wind.cov).min() > -1e-6


def test_far_from_every_aircraft_only_the_mean_is_known() -> None:
    shared = found()
    near = shared.along(99, T + 120.0, AHEAD, path(), HOME)
    far = shared.along(99, T + 120.0, AHEAD, path() + np.array([50_000.0, 0.0, 0.0]), HOME)
    assert near is not None and far is not None
    assert far.path_sigma > 1.5 * near.path_sigma
    np.testing.assert_allclose(far.mean[:, 0], 5.0, atol=0.6)


def test_wind_of_one_aircraft_alone_stays_with_it() -> None:
    shared = found(lambda p, t: np.array([4.0, -2.0]), own=1.0)
    winds = [shared.along(uav, T + 120.0, AHEAD, path(), HOME) for uav in (0, 1, 99)]
    one, other, stranger = (wind.mean[0] for wind in winds if wind is not None)
    assert np.linalg.norm(one - other) > 0.3
    np.testing.assert_allclose(stranger, [4.0, -2.0], atol=1.0)
    assert winds[0] is not None and winds[2] is not None
    assert winds[0].cov[0, 0] < 0.5 * winds[2].cov[0, 0] and shared.message.drift_sigma > 2 * shared.message.sigma


def test_more_aircraft_make_it_surer_and_too_few_make_none() -> None:
    few, many = (found(uavs=n).along(99, T + 120.0, AHEAD, path(), HOME) for n in (3, 16))
    assert few is not None and many is not None and many.path_sigma < few.path_sigma
    assert estimator(uavs=2).estimate() is None and WindFieldEstimator().estimate() is None


def test_estimates_of_another_time_are_left_out_and_an_old_field_is_not_used() -> None:
    one = estimator()
    one.add(77, estimate(T - 5_000.0, np.array([0.0, 0.0, -100.0]), np.array([40.0, 0.0])))
    wind_field = one.estimate()
    assert wind_field is not None and wind_field.uavs == tuple(range(12))
    shared = SharedWind(wind_field)
    assert shared.along(0, T + 120.0 + MAX_AGE_S, AHEAD, path(), HOME) is None
    assert shared.along(0, T - 60.0, AHEAD, path(), HOME) is None


def test_the_work_is_bounded_for_a_large_fleet() -> None:
    wind_field = estimator(uavs=60).estimate()
    assert wind_field is not None and len(wind_field.uavs) == 60
    assert len(wind_field.nodes.numpy()) <= 100 and len(encode(wind_field)) < 100_000


def test_own_wind_returns_to_the_mean_and_becomes_less_sure() -> None:
    wind_filter = WindFilter()
    wind_filter.update(T, np.array([20.0, 0.0, 0.0]), 18.0, 0.0)
    wind_filter.x[2:6] = 3.0, 0.0, 2.0, 0.0
    wind_filter.P[:] *= 0.05
    wind = own_wind(wind_filter, AHEAD)
    np.testing.assert_allclose(wind.mean[0], [5.0, 0.0])
    assert wind.mean[-1, 0] == pytest.approx(3.0 + 2.0 * np.exp(-1.0)) and wind.cov[-1, -1] > wind.cov[0, 0]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"wind": (nan, 0.0)}, "finite"),
        ({"wind": (200.0, 0.0)}, "200"),
        ({"sigma": 0.0}, "wind"),
        ({"sigma": -1.0}, "wind"),
        ({"position": (2_000_000_000, 0, 0)}, "Earth"),
        ({"height_m": 1e9}, "height"),
    ],
)
def test_a_bad_estimate_is_rejected_with_the_reason(changes: dict, reason: str) -> None:
    good = estimate(T, np.array([0.0, 0.0, -100.0]), np.array([3.0, 0.0]))
    assert estimate_defect(good) == ""
    with pytest.raises(ValueError, match=reason):
        WindFieldEstimator().add(1, replace(good, **changes))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"covariance": Array.of(-np.eye(4))}, "positive semidefinite"),
        ({"covariance": Array.of(np.triu(np.ones((4, 4))))}, "symmetric"),
        ({"covariance": Array.of(np.eye(3))}, "shapes"),
        ({"nodes": Array.of(np.empty((0, 3)))}, "shapes"),
        ({"nodes": Array.of(np.zeros((500, 3)))}, "shapes"),
        ({"uavs": (1,)}, "shapes"),
        ({"values": Array.of([[nan, 0.0], [0.0, 0.0]])}, "finite"),
        ({"values": Array.of([[1e6, 0.0], [0.0, 0.0]])}, "above"),
        ({"profile": Array("<f4", (2, 2), b"")}, "bytes"),
        ({"length_m": 0.0}, "positive"),
        ({"persistence_s": -1.0}, "positive"),
        ({"sigma": 1e9}, "kernel"),
        ({"wind": (1e4, 0.0)}, "above"),
        ({"t": nan}, "finite"),
    ],
)
def test_a_bad_field_is_rejected_with_the_reason(changes: dict, reason: str) -> None:
    good = EXAMPLES[WindField]
    assert field_defect(good) == ""
    with pytest.raises(ValueError, match=rf"^wind field: .*{reason}.*; it is ignored$"):
        SharedWind(replace(good, **changes))
