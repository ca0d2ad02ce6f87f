"""Fit of the multirotor model: minimise the rollout error from many starts over the last minute.

Drag and wind come from the tilt: horizontal thrust minus acceleration is drag, (k1 + k2 |u|) u with u = v - w.
Source: drag as in Faessler, Franchi & Scaramuzza 2018 (linear in airspeed) and its quadratic part.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import isfinite

import numpy as np

from fleet.frames import G
from twin_worker.prediction.multirotor.config import CIRCLE_RATE, MultirotorConfig, with_identified
from twin_worker.prediction.multirotor.copter_rollout import tilt_acceleration
from twin_worker.prediction.multirotor.rollout import (
    MultirotorModel,
    MultirotorTwin,
    fly_segments,
    time_on_item,
)
from twin_worker.prediction.multirotor.route import home_position
from twin_worker.telemetry.track import STEP, Track

_HISTORY_ROWS = 300  # flight before each start
_MIN_TRACK_S = 2.0  # minimum track before a rollout [s]
_COMPARE_S = 60.0  # compared flight [s]
_MIN_TILT_S, _MEAN_ROWS = 20.0, 10  # minimum flight for drag and wind [s], rows of one mean
_MIN_HEIGHT = 2.0  # above home [m]
_PRIOR = ((0.25, 0.01, 0.0, 0.0), (0.15, 0.01, 4.0, 4.0))  # drag and wind: mean and standard deviation
_ITERATIONS, _MAX_WIND = 8, 25.0  # [-, m/s]
_DRAG_STD = 0.3  # of a mean of the drag before its scatter is known [m/s2]
START_INTERVAL_S, _RUN_S = 4.0, 10.0  # interval of starts, length of a rollout [s]
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
_FITTED_LIMITS = {"acc": (0.5, 8.0), "jerk": (0.3, 20.0), "radius": (0.5, 30.0)}  # fitted limits and their bounds
_RATIOS = (0.7, 0.85, 1.15, 1.4)  # tried values over the present one
_COST_OF_CHANGE = 1.0  # of a limit, as a sum of errors [m]
_WAYPOINT, _TURNS = 16, 18  # MAV_CMD
_LEVEL_SPEED, _MIN_CRUISE, _MIN_CRUISE_S, _CRUISE_QUANTILE = 0.3, 1.5, 5.0, 0.95  # [m/s, m/s, s, -]
_MIN_CIRCLE_SPEED, _MIN_CIRCLE_S, _RATE_ROWS = 0.8, 5.0, 10  # [m/s, s, rows of one rate]
_TURNING_SHARE = 0.7  # of the usual largest rate: less is not on the circle [-]


def fit_model(track: Track, seq: np.ndarray, config: MultirotorConfig, model: MultirotorModel) -> MultirotorModel:
    """Fit lag, speed, acceleration and stop delay to the last minute by the rollout error from many starts."""
    model = fit_drag_and_wind(track, config, model)
    starts = _starts(track, seq, config)
    if len(starts) < 3:
        return model
    if config.has_law and not config.absent:  # nothing to fit
        return _compared(track, seq, MultirotorTwin(config, model), starts)
    segments_of = {k: _segments_at(track, seq, config, k) for k in starts}

    def cost_of(candidate: MultirotorModel, configured: MultirotorConfig) -> tuple[float, float]:
        twin = MultirotorTwin(configured, candidate)
        errors = [
            _rollout_error((track, seq), k, segments_of[k], int(seq[k]) + config.seq_offset, twin) for k in starts
        ]
        speed, accel = (
            _PRIOR_COST_ASSUMED if name in config.absent else _PRIOR_COST_RECEIVED for name in ("speed", "acc")
        )
        prior = speed * abs(np.log(candidate.speed_fraction)) + 0.3 * accel * abs(np.log(candidate.accel_fraction))
        return float(np.mean(errors)) + prior / len(starts), float(np.median(errors))

    if config.has_law:
        return _fit_limits(identify_speeds(track, seq, config, model), config, cost_of, len(starts))
    name, trials = _TRIALS[model.n_comparisons % len(_TRIALS)]
    options = [replace(model, **{name: value}) for value in dict.fromkeys((getattr(model, name), *trials))]
    costs = [cost_of(option, config) for option in options]
    best = int(np.argmin([cost for cost, _ in costs]))
    return _with_errors(options[best], costs[best], len(starts))


def _segments_at(track: Track, seq: np.ndarray, config: MultirotorConfig, k: int) -> np.ndarray:
    past = slice(max(k - _HISTORY_ROWS, 0), k + 1)
    return config.segments(track.part(past.start, past.stop), seq[past])[0]


def _compared(track: Track, seq: np.ndarray, twin: MultirotorTwin, starts: list[int]) -> MultirotorModel:
    """Return the model with the errors over the last minute; only rollouts since the last comparison are flown."""
    model, config, oldest = twin.model, twin.config, float(track.t[starts[-1]])
    errors = [(t, error) for t, error in model.errors if t > oldest - 0.5 * START_INTERVAL_S]
    newest = errors[-1][0] if errors else -np.inf
    for k in sorted(starts):
        if track.t[k] > newest + 0.5 * START_INTERVAL_S:
            segments = _segments_at(track, seq, config, k)
            error = _rollout_error((track, seq), k, segments, int(seq[k]) + config.seq_offset, twin)
            errors.append((float(track.t[k]), error))
    values = [error for _, error in errors]
    return _with_errors(
        replace(model, errors=tuple(errors)), (float(np.mean(values)), float(np.median(values))), len(errors)
    )


def _with_errors(model: MultirotorModel, errors: tuple[float, float], n: int) -> MultirotorModel:
    mean, median = errors
    return replace(model, mean_error=mean, median_error=median, n_starts=n, n_comparisons=model.n_comparisons + 1)


def _fit_limits(
    model: MultirotorModel, config: MultirotorConfig, cost_of: Callable[..., tuple[float, float]], n: int
) -> MultirotorModel:
    """Fit one limit that was not received, by trials around its present value; the others stay."""
    names = [name for name in _FITTED_LIMITS if name in config.absent]

    def adopt(identified: Mapping[str, float]) -> MultirotorConfig:
        limit, params = with_identified(config.limit, config.params, config.absent, identified)
        return replace(config, limit=limit, params=params)

    options = [dict(model.identified)]
    if names:
        name = names[model.n_comparisons % len(names)]
        present, (low, high) = getattr(adopt(model.identified).limit, name), _FITTED_LIMITS[name]
        options += [{**model.identified, name: float(np.clip(present * ratio, low, high))} for ratio in _RATIOS]
    costs = [cost_of(model, adopt(identified)) for identified in options]
    best = int(np.argmin([cost + _COST_OF_CHANGE / n * (k > 0) for k, (cost, _) in enumerate(costs)]))
    return _with_errors(replace(model, identified=options[best]), costs[best], n)


def identify_speeds(track: Track, seq: np.ndarray, config: MultirotorConfig, model: MultirotorModel) -> MultirotorModel:
    """Learn the speed of legs without a commanded one, and the rate of circles, if they were not received."""
    identified = dict(model.identified)
    commands = {item.seq: item.command for item in config.items}
    command = np.array([commands.get(int(s) + config.seq_offset, 0) if isfinite(s) else 0 for s in seq])
    on_route = track.ok & (track.t > config.changed_t)
    speed, level = np.hypot(*track.v[:, :2].T), np.abs(track.v[:, 2]) < _LEVEL_SPEED
    cruise = speed[on_route & level & (command == _WAYPOINT) & (speed > _MIN_CRUISE)]
    if "speed" in config.absent and not config.speed and len(cruise) > _MIN_CRUISE_S / STEP:
        identified["speed"] = float(np.quantile(cruise, _CRUISE_QUANTILE))
    circling = on_route & (command == _TURNS)
    if CIRCLE_RATE not in config.params or CIRCLE_RATE in identified:
        course = np.unwrap(np.arctan2(track.v[circling, 1], track.v[circling, 0]))
        rate = np.abs(course[_RATE_ROWS:] - course[:-_RATE_ROWS]) / (STEP * _RATE_ROWS)
        steady = rate[np.minimum(speed[circling][_RATE_ROWS:], speed[circling][:-_RATE_ROWS]) > _MIN_CIRCLE_SPEED]
        turning = steady[steady > _TURNING_SHARE * np.quantile(steady, 0.9)] if len(steady) else steady
        if len(turning) > _MIN_CIRCLE_S / STEP:  # the way to the circle does not turn
            identified[CIRCLE_RATE] = float(np.degrees(np.median(turning)))
    return replace(model, identified=identified)


def _starts(track: Track, seq: np.ndarray, config: MultirotorConfig) -> list[int]:
    """Return the start rows: on this route, moving, with ten seconds of flight after them."""
    run_rows, interval_rows = int(_RUN_S / STEP), int(START_INTERVAL_S / STEP)
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


def fit_drag_and_wind(track: Track, config: MultirotorConfig, model: MultirotorModel) -> MultirotorModel:
    """Fit drag and wind to the tilt by maximum a posteriori Gauss-Newton; `model` if the flight is too short."""
    ground = home_position(config.items, config.origin)[2]
    v, f = _means(track, ground)
    if len(v) < _MIN_TILT_S / (_MEAN_ROWS * STEP):
        return model
    mean, std = np.array(_PRIOR)
    x, scatter = mean.copy(), _DRAG_STD
    for _ in range(_ITERATIONS):
        u = v - x[2:]
        speed = np.hypot(*u.T)[:, None]
        residual = f - (x[0] + x[1] * speed) * u
        slope = x[0] + x[1] * speed[:, 0], x[1] * u / np.maximum(speed, 1e-6)
        by_wind = -slope[0][:, None, None] * np.eye(2) - u[:, :, None] * slope[1][:, None, :]
        J = np.concatenate([u[:, :, None], (speed * u)[:, :, None], by_wind], axis=2).reshape(-1, 4)
        information = J.T @ J / scatter**2 + np.diag(std**-2.0)
        x += np.linalg.solve(information, J.T @ residual.ravel() / scatter**2 + (mean - x) / std**2)
        x[:2] = np.maximum(x[:2], (0.02, 0.0))
        scatter = max(float(np.sqrt(np.mean(residual**2))), 0.05)
    if not (np.isfinite(x).all() and np.hypot(*x[2:]) < _MAX_WIND):
        return model
    k1_std, k2_std = np.sqrt(np.diag(np.linalg.inv(information))[:2]).tolist()
    k1, k2, w_n, w_e = x.tolist()
    return replace(model, drag=(k1, k2), drag_std=(k1_std, k2_std), wind=(w_n, w_e))


def _means(track: Track, ground: float) -> tuple[np.ndarray, np.ndarray]:
    """Return means of the horizontal velocity and drag in flight, (n, 2) each [m/s, m/s2]."""
    n = (len(track) - 1) // _MEAN_ROWS
    first = len(track) - 1 - n * _MEAN_ROWS
    ends = first + _MEAN_ROWS * np.arange(n + 1)
    a = np.diff(track.v[ends], axis=0) / (STEP * _MEAN_ROWS)

    def mean(x: np.ndarray) -> np.ndarray:
        return x[first : first + n * _MEAN_ROWS].reshape(n, _MEAN_ROWS, -1).mean(axis=1)

    thrust = mean(tilt_acceleration(track.euler)) * (1.0 - a[:, 2:] / G)
    whole = (mean(track.ok[:, None].astype(float)) == 1.0)[:, 0] & np.isfinite(thrust).all(axis=1)
    flies = whole & (mean(track.p)[:, 2] < ground - _MIN_HEIGHT)
    return mean(track.v)[flies, :2], (thrust - a[:, :2])[flies]
