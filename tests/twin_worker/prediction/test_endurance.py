"""Remaining battery at the end of a mission and at home."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.contract import Mission
from tests.support.flights import HERE, item
from tests.twin_worker.estimation.test_battery import WIND, discharged
from twin_worker.estimation.battery import BatteryModel
from twin_worker.prediction.multirotor.config import multirotor_config
from twin_worker.prediction.multirotor.endurance import forecast_battery, mission_to_end
from twin_worker.prediction.multirotor.rollout import MultirotorModel
from twin_worker.telemetry.track import STEP, Track

ITEMS = (item(0), *(item(k, north=400.0 * k, alt_m=60.0) for k in range(1, 6)), item(6, 20))
MODEL = MultirotorModel(wind=(float(WIND[0]), float(WIND[1])))


def hovering() -> Track:
    n = 40
    p = np.tile([0.0, 0.0, -60.0], (n, 1))
    return Track(STEP * np.arange(n), p, np.zeros((n, 3)), np.zeros((n, 3)), np.ones(n, bool), "")


def battery(start: float) -> BatteryModel:
    t, rows, v = discharged(200, 5, start)
    model = BatteryModel()
    model.update(t, rows, v, WIND)
    return model


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_the_mission_is_simulated_to_the_ground_at_home(autopilot: str) -> None:
    items = ITEMS if autopilot == "ardupilot" else ITEMS[1:]
    config = multirotor_config(Mission(uav=0, t=0.0, items=items), {}, autopilot, 0.0, origin=HERE, flown=None)
    config = replace(config, items=ITEMS, seq_offset=0)
    flight = mission_to_end(hovering(), np.full(40, 1.0), config, MODEL)
    assert flight is not None and np.linalg.norm(flight.end[-1, :2]) < 2.0
    cruise = config.limit.speed
    assert 4000.0 / cruise < flight.dt.sum() < 4000.0 / cruise + 240.0
    assert flight.seq[0] == 1 and flight.seq[-1] == 6 and (np.diff(flight.seq) >= 0).all()


def test_home_is_reached_up_to_an_item_and_not_after_it() -> None:
    config = multirotor_config(Mission(uav=0, t=0.0, items=ITEMS), {}, "ardupilot", 0.0, origin=HERE, flown=None)
    seq, params = np.full(40, 1.0), {"BATT_CAPACITY": 6000.0}
    full, low = (forecast_battery(hovering(), seq, (config, MODEL, battery(s)), params) for s in (1.0, 0.35))
    assert full is not None and low is not None and full.end is not None and low.end is not None
    assert full.end > 0.3 and full.last_item == -1 and full.sentence.startswith("lands with")
    assert low.end < low.home < low.remaining and full.end - low.end == pytest.approx(0.65, abs=0.1)
    assert low.end < 0.0 and 1 <= low.last_item < 6
    assert "is empty before the end" in low.sentence and f"after item {low.last_item}" in low.sentence
    no_mission = forecast_battery(hovering(), np.full(40, np.nan), (config, MODEL, battery(1.0)), params)
    assert no_mission is not None and no_mission.end is None and "if it returns now" in no_mission.sentence
    assert forecast_battery(hovering(), seq, (config, MODEL, BatteryModel()), params) is None
