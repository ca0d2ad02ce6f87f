"""Flights of the story: two aircraft meet in the announced window and not before, all others are far away."""

import numpy as np
import pytest

from fleet.frames import to_geodetic, to_ned
from fleet.simulator.flight.story import MAX_UAVS, MEET_S, RING_M, conflict_plans, story_aircraft
from fleet.simulator.vehicle.missions import HOME

STEP_S = 0.5


@pytest.mark.parametrize(("autopilot", "seed"), [("ardupilot", 1), ("ardupilot", 4), ("px4", 1)])
def test_two_aircraft_meet_in_the_window(autopilot: str, seed: int) -> None:
    paths = []
    for uav in story_aircraft(2, seed, autopilot):
        uav.silent, rows = True, []
        for t in np.arange(0.0, MEET_S[1], STEP_S):
            uav.step(float(t))
            rows.append(uav.aircraft.truth().p.copy())
        paths.append(to_ned(HOME, *to_geodetic(uav.origin, np.array(rows)).T))
    offset = paths[0] - paths[1]
    lost = (np.hypot(*offset[:, :2].T) < 50.0) & (np.abs(offset[:, 2]) < 20.0)
    assert lost.any() and MEET_S[0] - 10.0 < STEP_S * lost.argmax() < MEET_S[1]


def test_the_others_are_far_away() -> None:
    homes = [to_ned(HOME, *(np.array([x]) for x in plan.origin))[0] for plan in conflict_plans(MAX_UAVS, 1)]
    for k, home in enumerate(homes[2:], 2):
        assert min(np.linalg.norm(home - other) for n, other in enumerate(homes) if n not in (k, 1)) > 0.99 * RING_M
    for count in (1, MAX_UAVS + 1):
        with pytest.raises(ValueError, match="expected 2 to"):
            conflict_plans(count, 1)


def test_the_scene_has_the_weather_of_the_fleet() -> None:
    calm, windy = (story_aircraft(2, 1, "ardupilot", wind=wind, turbulence=0) for wind in (0.0, 8.0))
    for one, other in zip(calm, windy, strict=True):
        assert (one.setup.weather.mean, other.setup.weather.mean) == (0.0, 8.0)
        assert one.setup.weather.severity == 0
