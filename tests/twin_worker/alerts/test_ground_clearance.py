"""Height above the terrain: relative to home, with slopes beside the path, and above home where it is unknown."""

import copy

import msgspec
import numpy as np
import pytest

from fleet.frames import Origin
from tests.support.flights import HERE
from tests.support.heights import raster
from tests.support.predicted import T, straight
from twin_worker.alerts.gaussian_forecast import GaussianForecast, to_gaussian
from twin_worker.alerts.geofence import ground_clearance, ground_hazard
from twin_worker.ownership.handover import Snapshot, decode_snapshot, encode_snapshot
from twin_worker.twin.state.state import Twin

HOME = Origin(HERE.lat_e7, HERE.lon_e7, HERE.alt_mm)


def forecast(height_m: float = 100.0, half: tuple[float, float, float] = (5.0, 5.0, 5.0)) -> GaussianForecast:
    """A level flight from home to the north at 20 m/s."""
    flight = to_gaussian(straight(p=(0.0, 0.0, -height_m), v=(20.0, 0.0, 0.0), half=half))
    assert flight is not None
    return flight


@pytest.mark.parametrize("offset_m", [0.0, 450.0, -30.0])
def test_flat_terrain_of_any_height_is_the_height_of_home(offset_m: float) -> None:
    flight, flat = forecast(), raster(HOME, lambda north, east: 0.0 * north + offset_m)
    above_home = ground_clearance(flight, HOME, None)
    above_terrain = ground_clearance(flight, HOME, flat)
    assert above_terrain.known.all() and not above_home.known.any()
    np.testing.assert_allclose(above_terrain.height, above_home.height, atol=0.2)
    np.testing.assert_allclose(above_terrain.sigma, above_home.sigma, rtol=0.05)


def test_a_hill_ahead_is_reported_when_the_aircraft_reaches_it() -> None:
    hill = raster(HOME, lambda north, east: 320.0 + 90.0 * (np.abs(north - 1_500.0) < 200.0))
    found = ground_hazard(forecast(), HOME, 30.0, terrain=hill)
    assert found.probability > 0.99 and "above the terrain in 6" in found.message and "lowest 10 m" in found.message
    assert found.predicted_t == pytest.approx(T + 1_300.0 / 20.0, abs=2.1)
    assert ground_hazard(forecast(), HOME, 30.0).probability < 0.01  # above home it flies high enough
    assert ground_hazard(forecast(), HOME, 30.0, until=T + 50.0, terrain=hill).probability < 0.01  # not reached yet
    valley = raster(HOME, lambda north, east: -60.0 * (north > 500.0))
    assert ground_hazard(forecast(20.0), HOME, 30.0, terrain=valley).probability > 0.5  # over home it is too low


def test_uncertainty_across_a_slope_is_uncertainty_of_the_height_above_it() -> None:
    flight = forecast(half=(1.0, 40.0, 5.0))
    slope = ground_clearance(flight, HOME, raster(HOME, lambda north, east: 0.5 * east))
    flat = ground_clearance(flight, HOME, None)
    across = flight.sigma[:, 1]
    np.testing.assert_allclose(slope.sigma, np.hypot(flat.sigma, 0.5 * across), rtol=0.1)


def test_beyond_the_terrain_the_height_counts_above_home() -> None:
    flight, small = forecast(), raster(HOME, lambda north, east: 95.0 + 0.0 * north, reach_m=1_000.0)
    found = ground_clearance(flight, HOME, small)
    assert found.known[:20].all() and not found.known[30:].any()
    np.testing.assert_allclose(found.height[30:], 100.0, atol=0.2)
    low = ground_hazard(forecast(20.0), HOME, 30.0, terrain=raster(HOME, lambda north, east: np.nan * north))
    assert "above home (terrain unknown)" in low.message


def test_copies_of_a_twin_share_the_terrain_and_a_handover_leaves_it_out() -> None:
    flat = raster(HOME, lambda north, east: 0.0 * north)
    twin = msgspec.structs.replace(Twin.of(3), terrain=flat)
    assert copy.deepcopy(twin).terrain is flat
    data = encode_snapshot(Snapshot(twin))
    assert data == encode_snapshot(Snapshot(Twin.of(3))) and decode_snapshot(data, 3).twin.terrain is None
