"""Battery of a multirotor: power by speed and climb, charge, and the share that remains after a flight."""

import numpy as np
import pytest

from fleet.contract import BatteryForecast
from twin_worker.estimation.battery import BatteryModel
from twin_worker.twin.steps.alerts import battery_hazard

CAPACITY_AS = 3600.0 * 6.0  # of 6 Ah [A s]
WIND = np.array([3.0, -1.0])


def power(v: np.ndarray) -> np.ndarray:
    """Return the power of the flight, which is least at 6 m/s through the air [W]."""
    u = np.hypot(v[:, 0] - WIND[0], v[:, 1] - WIND[1])
    return 200.0 * (1.0 - 0.005 * u**2 + 0.0006 * u**3) - 12.0 * v[:, 2]


def velocities(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return legs of 20 s with different speeds, directions and climbs, (n, 3) [m/s]."""
    legs = np.repeat(rng.uniform((-9, -9, -1), (9, 9, 1), (n // 20 + 1, 3)), 20, axis=0)
    return legs[:n]


def discharged(n: int, seed: int, start: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, rows with reports in steps of 1 %, and velocities of a flight at 1 Hz."""
    rng = np.random.default_rng(seed)
    v = velocities(n, rng)
    watts = power(v) * (1.0 + 0.03 * rng.standard_normal(n))
    remaining, rows = start, np.empty((n, 3))
    for k in range(n):
        voltage = 12.6 * (0.86 + 0.14 * remaining) - 0.01 * watts[k] / 12.0
        remaining -= watts[k] / voltage / CAPACITY_AS
        rows[k] = voltage, watts[k] / voltage, round(remaining, 2)
    return 1e9 + np.arange(n, dtype=float), rows, v


@pytest.mark.parametrize("seed", range(1, 5))
def test_the_share_at_the_end_of_a_flight_is_predicted_with_an_interval_that_holds(seed: int) -> None:
    t, rows, v = discharged(700, seed)
    for known in (120, 300):
        model = BatteryModel()
        model.update(t[:known], rows[:known], v[:known], WIND)
        remaining, std = model.remaining_after(v[known:], np.ones(700 - known), WIND, {"BATT_CAPACITY": 6200.0})
        assert abs(remaining[-1] - rows[-1, 2]) < 3.0 * std[-1] < 0.15
        assert abs(remaining[-1] - rows[-1, 2]) < 0.03
        assert (np.diff(remaining) < 0.0).all() and std[-1] > std[0]


def test_power_depends_on_airspeed_and_climb() -> None:
    t, rows, v = discharged(700, 9)
    model = BatteryModel()
    model.update(t, rows, v, WIND)
    ground = np.array([[3.0, -1.0, 0.0], [9.0, -1.0, 0.0], [3.0, -1.0, -1.0]])
    drops = [1.0 - model.remaining_after(g[None], np.array([60.0]), WIND, {})[0][0] for g in ground]
    assert drops[2] > drops[0] > drops[1]  # a climb costs, translational flight saves


def test_without_current_or_charge_nothing_is_predicted() -> None:
    t, rows, v = discharged(60, 2)
    silent, brief = BatteryModel(), BatteryModel()
    silent.update(t, np.column_stack([rows[:, 0], np.full(60, np.nan), rows[:, 2]]), v, WIND)
    brief.update(t[:25], np.column_stack([rows[:25, :2], np.ones(25)]), v[:25], WIND)
    for model in (silent, brief):
        remaining, std = model.remaining_after(v[:3], np.ones(3), WIND, {})
        assert np.isnan(remaining).all() and np.isnan(std).all()
    assert np.isfinite(brief.remaining_after(v[:3], np.ones(3), WIND, {"BAT1_CAPACITY": 6000.0})[0]).all()


def test_a_new_battery_starts_anew() -> None:
    t, rows, v = discharged(300, 3)
    model = BatteryModel()
    model.update(t, rows, v, WIND)
    model.update(t + 400.0, rows, v, WIND)
    assert model.first == pytest.approx(1.0, abs=0.011)
    assert model.charge({})[0] == pytest.approx(1 / CAPACITY_AS, rel=0.1)


def test_an_empty_battery_before_home_or_the_end_is_a_hazard() -> None:
    def hazard(**fields: float) -> float:
        return battery_hazard(BatteryForecast(remaining=0.3, home_sigma=0.01, end_sigma=0.02, **fields)).probability

    assert hazard(home=0.2, end=0.1) < 0.01 and hazard(home=0.2, end=-0.05) > 0.9 and hazard(home=-0.03, end=0.1) > 0.9
    assert battery_hazard(None).probability == 0.0
