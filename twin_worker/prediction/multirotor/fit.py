"""Fit of the multirotor model: minimise the rollout error from many starts over the last minute.

Drag and wind come from the tilt: horizontal thrust minus acceleration is drag, which depends on the airspeed.
Source: drag as in Mahony, Kumar & Corke 2012 (linear in airspeed).
"""

from dataclasses import replace
from math import isfinite, tan

import numpy as np

from fleet.frames import G
from twin_worker.prediction.multirotor.rollout import (
    MultirotorConfig,
    MultirotorModel,
    MultirotorTwin,
    fly_segments,
    time_on_item,
)
from twin_worker.telemetry.track import STEP, Track

_HISTORY_ROWS = 300  # flight before each start
_MIN_TRACK_S = 2.0  # minimum track before a rollout [s]
_COMPARE_S = 60.0  # compared flight [s]
_MIN_TILT_S, _TILT_ROWS = 20.0, 5  # minimum flight for drag and wind [s], rows from one to the next
_MIN_VELOCITY_CHANGE = 3.0  # minimum range of the horizontal velocity for both [m/s]
_START_INTERVAL_S, _RUN_S = 4.0, 10.0  # interval of starts, length of a rollout [s]
_LAG_VALUES = (0.7, 1.0, 1.4, 2.0, 2.8)  # tried natural frequencies [rad/s]
_FRACTIONS = (0.6, 0.8, 0.9, 1.0, 1.1, 1.25)  # tried fractions of the limits
_STOP_DELAYS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)  # tried delays at each stop [s]
_TRIALS: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("speed_fraction", _FRACTIONS),
    ("stop_delay_s", _STOP_DELAYS),
    ("wn", _LAG_VALUES),
    ("accel_fraction", _FRACTIONS),
)  # one per call
# cost of a fraction e times the limit, as a sum of errors [m]
_PRIOR_COST_ASSUMED, _PRIOR_COST_RECEIVED = 20.0, 200.0


def fit_model(track: Track, seq: np.ndarray, config: MultirotorConfig, model: MultirotorModel) -> MultirotorModel:
    """Fit lag, speed, acceleration and stop delay to the last minute by the rollout error from many starts."""
    model = _fit_drag_and_wind(track, config, model)
    starts = _starts(track, seq, config)
    if len(starts) < 3:
        return model
    segments_of = {
        k: config.segments(track.part(max(k - _HISTORY_ROWS, 0), k + 1), seq[max(k - _HISTORY_ROWS, 0) : k + 1])[0]
        for k in starts
    }

    def cost_of(candidate: MultirotorModel) -> float:
        errors = [
            _rollout_error(
                (track, seq), k, segments_of[k], int(seq[k]) + config.seq_offset, MultirotorTwin(config, candidate)
            )
            for k in starts
        ]
        speed, accel = (
            _PRIOR_COST_ASSUMED if name in config.absent else _PRIOR_COST_RECEIVED for name in ("speed", "acc")
        )
        prior = speed * abs(np.log(candidate.speed_fraction)) + 0.3 * accel * abs(np.log(candidate.accel_fraction))
        return float(np.mean(errors)) + prior / len(starts)

    name, trials = _TRIALS[model.n_comparisons % len(_TRIALS)]
    if name in ("wn", "stop_delay_s") and (config.plans_legs or config.smooths_velocity):
        trials = ()  # these navigation laws have gains and stops of their own
    options = [replace(model, **{name: value}) for value in dict.fromkeys((getattr(model, name), *trials))]
    costs = [cost_of(option) for option in options]
    best = int(np.argmin(costs))
    return replace(options[best], mean_error=costs[best], n_starts=len(starts), n_comparisons=model.n_comparisons + 1)


def _starts(track: Track, seq: np.ndarray, config: MultirotorConfig) -> list[int]:
    """Return the start rows: on this route, moving, with ten seconds of flight after them."""
    run_rows, interval_rows = int(_RUN_S / STEP), int(_START_INTERVAL_S / STEP)
    first = max(int(np.searchsorted(track.t, config.changed_t + _MIN_TRACK_S)), len(track) - int(_COMPARE_S / STEP), 20)
    rows = range(len(track) - 1 - run_rows, first, -interval_rows)
    return [
        k for k in rows if isfinite(seq[k]) and track.ok[k - 20 : k + run_rows].all() and _moves(track, k, run_rows)
    ]


def _moves(track: Track, k: int, run_rows: int) -> bool:
    return bool(np.linalg.norm(track.p[k + run_rows] - track.p[k]) > 3.0)


def _rollout_error(
    history: tuple[Track, np.ndarray], k: int, segments: np.ndarray, seq: int, twin: MultirotorTwin
) -> float:
    if not len(segments):
        return 0.0
    ahead = np.arange(0.0, _RUN_S + 0.5)
    track, items = history
    past = track.part(max(k - _HISTORY_ROWS, 0), k + 1)
    path = fly_segments(past, segments, seq, twin, ahead, since=time_on_item(items[: k + 1]))
    actual = track.p[k + np.rint(ahead / STEP).astype(int)]
    return float(np.linalg.norm(path - actual, axis=1).mean())


def _fit_drag_and_wind(track: Track, config: MultirotorConfig, model: MultirotorModel) -> MultirotorModel:
    """Fit drag and wind to the tilt: horizontal thrust minus acceleration is k (v - w), linear in k and k w."""
    rows = np.arange(len(track) - 1, max(len(track) - int(_COMPARE_S / STEP), 10), -_TILT_ROWS)
    rows = rows[track.ok[rows] & np.isfinite(track.euler[rows]).all(axis=1)]
    if len(rows) < _MIN_TILT_S / (_TILT_ROWS * STEP):
        return model
    euler = track.euler[rows]
    cf, sf, ct, st, cp, sp = (g(euler[:, i]) for i in range(3) for g in (np.cos, np.sin))
    down = np.column_stack([cf * st * cp + sf * sp, cf * st * sp - sf * cp, cf * ct])  # body z axis in NED
    acceleration = (track.v[rows] - track.v[rows - 10]) / (10 * STEP)
    thrust = (G - acceleration[:, 2]) / np.maximum(down[:, 2], 0.5)
    v = track.v[rows, :2] - 0.5 * STEP * 10 * acceleration[:, :2]
    drag = -down[:, :2] * thrust[:, None] - acceleration[:, :2]
    unit = np.ones(len(rows))
    zero = 0.0 * unit
    A = np.vstack([np.column_stack([v[:, 0], -unit, zero]), np.column_stack([v[:, 1], zero, -unit])])
    solution = np.linalg.solve(A.T @ A + np.diag([20.0, 2.0, 2.0]), A.T @ drag.T.ravel() + [20.0 * 0.2, 0.0, 0.0])
    k = float(solution[0])
    if not 0.03 < k < 2.0 or np.ptp(v, axis=0).max() < _MIN_VELOCITY_CHANGE:
        return model
    wind = solution[1:] / k
    if not np.hypot(*wind) < 25.0:
        return model
    return replace(model, max_tilt_airspeed=G * tan(config.limit.tilt) / k, wind=(float(wind[0]), float(wind[1])))
