"""The wind field of the simulator has the spectrum, the coherence and the advection of its source equations."""

import numpy as np
import pytest

from fleet.frames import Origin, to_geodetic
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.multirotor.uav import SimulatedMultirotor
from fleet.simulator.vehicle.missions import HOME
from fleet.simulator.vehicle.wind_field import CoherentWind, LocalWind

U = 6.0
F = np.geomspace(1e-6, 1 / 30, 4000)  # [Hz]
_FRICTION_SPEED, _N = 0.4 * U / np.log(1000.0), F * 100.0 / U
SPECTRUM = 105.0 * _N / (1 + 33.0 * _N) ** (5 / 3) * _FRICTION_SPEED**2 / F  # Kaimal et al. 1972, eq. 21 [m2/s2/Hz]


def winds(seed: int, t: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Along-wind fluctuation of a field that blows north, (times, places) [m/s]."""
    field = CoherentWind(U, 0.0, HOME, np.random.default_rng(seed))
    out = np.array([[field.at(float(s), p)[0] for p in places] for s in t])
    return out - np.array([field._friction_speed / 0.4 * np.log(-p[2] / 0.1) for p in places])


def ensemble(places: np.ndarray, fields: int = 150) -> np.ndarray:
    return np.array([winds(seed, np.array([0.0]), places)[0] for seed in range(fields)])


def test_the_variance_is_that_of_the_spectrum_below_the_cut_off() -> None:
    values = ensemble(np.array([[0.0, 0.0, -100.0]]))
    assert values.var() == pytest.approx(np.trapezoid(SPECTRUM, F), rel=0.25)


def test_near_places_agree_and_distant_ones_do_not() -> None:
    across = np.array([0.0, 60.0, 400.0, 6_000.0])
    places = np.column_stack([np.zeros(4), across, np.full(4, -100.0)])
    expected = [np.trapezoid(SPECTRUM * np.exp(-10.0 * F * d / U), F) / np.trapezoid(SPECTRUM, F) for d in across]
    np.testing.assert_allclose(np.corrcoef(ensemble(places).T)[0], expected, atol=0.15)
    assert expected[1] > 0.6 and expected[2] < 0.5 and expected[3] < 0.2


def test_structures_drift_with_the_mean_wind() -> None:
    later = 60.0
    values = np.array(
        [
            [
                winds(seed, np.array([0.0]), np.array([[0.0, 0.0, -100.0]]))[0, 0],
                *winds(seed, np.array([later]), np.array([[U * later, 0, -100], [-U * later, 0, -100.0]]))[0],
            ]
            for seed in range(120)
        ]
    )
    downwind, upwind = np.corrcoef(values.T)[0, 1:]
    assert downwind > 0.5 and downwind > upwind + 0.3


def test_it_grows_with_height_and_can_be_calm() -> None:
    field = CoherentWind(U, 0.0, HOME, np.random.default_rng(1))
    mean = [np.mean([field.at(t, np.array([0.0, 0.0, -h]))[0] for t in range(0, 20_000, 100)]) for h in (20.0, 200.0)]
    assert mean[1] > mean[0] + 1.0 > 3.0
    assert CoherentWind(0.0, 0.0, HOME, np.random.default_rng(1)).at(5.0, np.array([0.0, 0.0, -50.0])) == (0.0, 0.0)


def test_aircraft_of_different_homes_see_the_same_wind_at_the_same_place() -> None:
    field = CoherentWind.of_fleet(U, 3, HOME)
    home = Origin(*map(int, to_geodetic(HOME, np.array([300.0, -200.0, 0.0]))))
    here, there = LocalWind(field, HOME, 0.1), LocalWind(field, home, 0.1)
    place = np.array([500.0, 100.0, -120.0])
    np.testing.assert_allclose(here.step(place), there.step(place - [300.0, -200.0, 0.0]), atol=1e-3)
    assert CoherentWind.of_fleet(U, 3, HOME).at(9.0, place) == field.at(9.0, place)
    assert CoherentWind.of_fleet(U, 4, HOME).at(9.0, place) != field.at(9.0, place)


@pytest.mark.parametrize("kind", [SimulatedUav, SimulatedMultirotor])
def test_every_kind_of_aircraft_flies_in_the_field(kind: type) -> None:
    field = CoherentWind.of_fleet(U, 3, HOME)
    in_field, alone = (kind(1, 3, wind=U, turbulence=0, wind_field=shared) for shared in (field, None))
    place = np.array([50.0, 20.0, -60.0])
    offset = in_field._wind._offset
    expected = field.at(in_field._wind._t + in_field._wind._dt, place + offset)
    assert in_field._wind.step(place) == expected != alone._wind.step(place)
