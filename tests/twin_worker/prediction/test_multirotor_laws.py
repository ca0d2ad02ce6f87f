"""The multirotor laws of ArduCopter and PX4 against simulated aircraft on other physics and another autopilot."""

import numpy as np
import pytest

from fleet.contract import Mission
from fleet.simulator.multirotor.uav import SimulatedMultirotor
from tests.support.flights import HERE, item
from twin_worker.prediction.multirotor.rollout import MultirotorModel, fly_route, multirotor_config
from twin_worker.prediction.multirotor.route import segments_from_mission
from twin_worker.telemetry.track import STEP, Track

AHEAD = np.arange(0.0, 16.0)


@pytest.mark.parametrize(("autopilot", "aircraft", "limit"), [("ardupilot", "quad", 1.5), ("px4", "quad", 3.0)])
def test_the_route_is_predicted_within_metres(autopilot: str, aircraft: str, limit: float) -> None:
    uav = SimulatedMultirotor(0, 31, wind=3.0, autopilot=autopilot, aircraft=aircraft)
    uav.silent, rows = True, []
    for k in range(1, 751):
        uav.step(k * STEP)
        e = uav.estimate
        rows.append((k * STEP, *e.p, *e.v, *e.euler, float(uav._mission_seq)))
    t, p, v, euler, seq = np.split(np.array(rows), [1, 4, 7, 10], axis=1)
    config = multirotor_config(
        Mission(uav=0, t=0.0, items=uav.items), uav.params, autopilot, 0.0, origin=uav.origin, flown=None
    )
    assert config.plans_legs == (autopilot == "ardupilot")
    errors = []
    for k in range(250, 590, 10):
        flown = Track(t[: k + 1, 0], p[: k + 1], v[: k + 1], euler[: k + 1], np.ones(k + 1, bool), "")
        path, _ = fly_route(flown, seq[: k + 1, 0], config, MultirotorModel(), AHEAD)
        assert path is not None and np.allclose(path[0], p[k], atol=0.01)
        errors.append(np.linalg.norm(path - p[k + np.rint(AHEAD / STEP).astype(int)], axis=1))
    assert np.median(np.array(errors)[:, [5, 10, 15]]) < limit


def test_a_delay_is_a_wait_where_the_aircraft_is_and_a_circle_one_segment() -> None:
    turns = item(3, 18, north=100.0, param1=2.0, param3=-20.0)
    mission = (item(0), item(1, north=50.0), item(2, 93, param1=7.0), turns)
    for arcs in (False, True):
        rows, _ = segments_from_mission(mission, 1, HERE, np.array([0.0, 0.0, -100.0]), {}, arcs=arcs)
        waits = rows[rows[:, 10] == 2]
        assert len(waits) == 1 and waits[0, 9] == 7.0 and np.allclose(waits[0, :3], waits[0, 3:6])
    assert np.count_nonzero(rows[:, 10] == 3) == 2 and rows[-1, 12] == pytest.approx(-4 * np.pi)
