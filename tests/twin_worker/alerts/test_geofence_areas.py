"""Alerts of polygon fences on board and of areas that the operator gives."""

import numpy as np
import pytest
from scipy.stats import norm

from fleet.contract import Item, Mission, Params
from fleet.frames import Origin
from fleet.terrain.areas import Area
from tests.support.flights import T0
from tests.support.predicted import T, straight
from twin_worker.alerts.gaussian_forecast import GaussianForecast, to_gaussian
from twin_worker.alerts.geofence import area_margin, geofence_hazard, read_geofence
from twin_worker.twin.state.state import Twin, ingest
from twin_worker.twin.steps.alerts import geofence

HOME = Origin(470_000_000, 80_000_000, 500_000)
PER_M = 180 / np.pi * 1e7 / np.array([6_366_000, 4_359_000])  # [1e-7 deg / m]


def box(south: float, north: float, half: float, *, exclusion: bool = False, **heights: float) -> Area:
    """Return a rectangle between two distances north of home, `half` wide to both sides [m]."""
    corners = np.array([(south, -half), (south, half), (north, half), (north, -half)]) * PER_M
    vertices = tuple((HOME.lat_e7 + round(n), HOME.lon_e7 + round(e)) for n, e in corners)
    return Area("field", vertices, exclusion, **heights)


def forecast(**more: object) -> GaussianForecast:
    """Return a flight north at 20 m/s, 100 m above home, that begins at home."""
    return to_gaussian(straight(**more))


def test_leaving_a_polygon_is_said_when_and_what() -> None:
    limits = read_geofence({}, areas=[box(-500.0, 1000.0, 300.0)])
    found = geofence_hazard(forecast(half=(4.0, 4.0, 4.0)), limits, HOME)
    assert found.probability == 1.0 and found.predicted_t == pytest.approx(T + 50.0, abs=2.0)
    assert "leaves the geofence, field, in 5" in found.message
    assert area_margin(forecast(), limits, T + 40.0) == pytest.approx(200.0, abs=2.0)
    assert geofence_hazard(forecast(half=(4.0, 4.0, 4.0)), limits, HOME, T + 40.0).probability == 0.0


def test_a_no_fly_area_counts_with_its_heights() -> None:
    above = read_geofence({}, areas=[box(1000.0, 1400.0, 300.0, exclusion=True, ceiling=580.0)])
    through = read_geofence({}, areas=[box(1000.0, 1400.0, 300.0, exclusion=True, ceiling=620.0)])
    narrow = forecast(half=(4.0, 4.0, 4.0))
    assert geofence_hazard(narrow, above, HOME).probability == 0.0
    found = geofence_hazard(narrow, through, HOME)
    assert found.probability == 1.0 and "enters a no-fly area, field, in 5" in found.message
    assert area_margin(narrow, through, np.inf) < 0 < area_margin(narrow, above, np.inf)


@pytest.mark.parametrize("offset", [-20.0, 0.0, 20.0])
def test_the_probability_beside_an_area_is_that_of_the_region(offset: float) -> None:
    """A flight along the edge of a no-fly area, with a standard deviation across of 20 m."""
    half = 20.0 * norm.ppf((1 + 0.9 ** (1 / 3)) / 2)
    passing = forecast(p=(0.0, offset, -100.0), half=(4.0, half, 4.0))
    corners = np.array([(1000.0, 0.0), (1000.0, 900.0), (1400.0, 900.0), (1400.0, 0.0)]) * PER_M
    area = Area("field", tuple((HOME.lat_e7 + round(n), HOME.lon_e7 + round(e)) for n, e in corners), exclusion=True)
    found = geofence_hazard(passing, read_geofence({}, areas=[area]), HOME)
    assert found.probability == pytest.approx(norm.cdf(offset / 20.0), abs=0.08)


def polygon(seq: int, *corners: tuple[float, float], command: int = 5001) -> list[Item]:
    return [
        Item(
            seq=seq + k,
            command=command,
            param1=float(len(corners)),
            lat_e7=HOME.lat_e7 + round(n * PER_M[0]),
            lon_e7=HOME.lon_e7 + round(e * PER_M[1]),
        )
        for k, (n, e) in enumerate(corners)
    ]


NEAR = polygon(0, (-100.0, -300.0), (-100.0, 300.0), (1000.0, 300.0), (1000.0, -300.0))
FAR = polygon(4, (900.0, -300.0), (900.0, 300.0), (9000.0, 300.0), (9000.0, -300.0))
ON = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 4.0}


@pytest.mark.parametrize(
    ("params", "items", "probability"),
    [
        (ON, NEAR, 1.0),
        (ON, [*NEAR, *FAR], 1.0),  # both at once
        (ON | {"FENCE_OPTIONS": 2.0}, [*NEAR, *FAR], 0.0),  # one of them
        ({"GF_MAX_HOR_DIST": 0.0}, [*NEAR, *FAR], 0.0),  # PX4: one of them
        ({"FENCE_ENABLE": 0.0}, NEAR, 0.0),
        ({"FENCE_ENABLE": 1.0, "FENCE_TYPE": 3.0}, NEAR, 0.0),
        ({}, NEAR, 0.0),
    ],
)
def test_fence_items_count_as_the_parameters_say(params: dict, items: list[Item], probability: float) -> None:
    limits = read_geofence(params, tuple(items))
    assert geofence_hazard(forecast(half=(4.0, 4.0, 4.0)), limits, HOME).probability == probability


def test_damaged_fence_items_are_named_as_not_monitored() -> None:
    limits = read_geofence(ON | {"FENCE_TYPE": 6.0, "FENCE_RADIUS": 500.0}, tuple(NEAR[:3]))
    assert "begins a polygon of 4 points, found 3" in geofence_hazard(forecast(), limits, HOME).message


def test_a_twin_knows_the_fence_of_its_mission_and_of_the_operator() -> None:
    twin = Twin.of(1)
    twin.areas = (box(0.0, 10.0, 10.0, exclusion=True),)
    assert len(geofence(twin).exclusions) == 1
    ingest(twin, Params(uav=1, t=T0, values=ON, complete=True))
    ingest(twin, Mission(uav=1, t=T0, items=(), fence=tuple(NEAR), complete=True))
    assert [len(group) for group in geofence(twin).inclusions] == [1]
