"""What judging all pairs of a fleet costs: everyone predicts, and every pair is judged, once a second."""

import time
from typing import Any

import numpy as np

from fleet.contract import Array, Prediction, TwinState
from fleet.frames import to_geodetic
from fleet.simulator.vehicle.missions import HOME
from twin_worker.alerts.traffic import TrafficMonitor

T = 1_700_000_000.0
AHEAD = np.concatenate([np.arange(0.0, 61.0), np.arange(63.0, 181.0, 3.0)])
SPEED = 23.0  # [m/s]


def wandering(uav: int, rng: np.random.Generator, reach: float) -> Prediction:
    """Predict a flight that turns now and then within `reach` [m] of home, at 80 to 200 m."""
    course, turn = rng.uniform(-np.pi, np.pi), 0.0
    path = np.empty((len(AHEAD), 3))
    path[0] = [*rng.uniform(-reach, reach, 2), -rng.uniform(80, 200)]
    for k, dt in enumerate(np.diff(AHEAD), start=1):
        if rng.random() < 0.05 * dt:
            turn = rng.choice([0.0, 0.0, 0.25, -0.25])
        course += (0.2 if np.hypot(*path[k - 1, :2]) > reach else turn) * dt
        path[k] = path[k - 1] + [SPEED * np.cos(course) * dt, SPEED * np.sin(course) * dt, rng.normal(0, 0.5)]
    tube = np.array([2.0, 1.0, 1.0]) + AHEAD[:, None] * [1.3, 0.15, 0.06]
    lat, lon, alt = (int(x) for x in to_geodetic(HOME, np.array([*rng.uniform(-reach, reach, 2), 0.0])))
    return Prediction(
        uav=uav,
        t=T + rng.uniform(-0.5, 0.5),
        state=TwinState.PREDICTING,
        method="dynamics",
        origin=(lat, lon, alt),
        ahead=Array.of(AHEAD),
        path=Array.of(path),
        prediction_region_half_axes=Array.of(tube),
    )


def cost(uavs: int = 100, seconds: int = 10, seed: int = 1) -> dict[str, Any]:
    """Give the processor time of one second of judgement, for a crowded and a spread fleet [ms]."""
    rng, out = np.random.default_rng(seed), {}
    for name, reach in (("crowded_1_km", 1_000.0), ("spread_5_km", 5_000.0)):
        traffic, took, alerts = TrafficMonitor(), [], 0
        for second in range(-1, seconds):
            made = [wandering(uav, rng, reach) for uav in range(uavs)]
            began = time.process_time()
            for one in made:
                traffic.receive(one)
            alerts += sum(len(traffic.assess(uav, T + second)) for uav in range(uavs))
            took.append(1e3 * (time.process_time() - began))
        out[name] = {"pairs": uavs * (uavs - 1) // 2, "ms_median": round(float(np.median(took[1:])), 1)}
        out[name] |= {"ms_worst": round(max(took[1:]), 1), "alerts": alerts}
    return out
