"""Remaining battery of a multirotor at the end of its mission and at home, with intervals.

The mission is simulated to its end. A return is flown at the limits of the autopilot, with the time of one
acceleration and one stop per leg.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
from scipy.special import ndtr

from fleet.autopilots import copter, copter_legs
from fleet.contract import BatteryForecast
from twin_worker.estimation.battery import BatteryModel
from twin_worker.prediction.multirotor import copter_rollout
from twin_worker.prediction.multirotor.config import MultirotorConfig
from twin_worker.prediction.multirotor.rollout import MultirotorModel, MultirotorTwin, fly_segments, time_on_item
from twin_worker.prediction.multirotor.route import limit_speeds, return_segments
from twin_worker.telemetry.track import Track

_MAX_LEGS = 400  # of a mission that is simulated to its end
_MAX_S = 5400.0  # longest simulated flight [s]
_STEP_S = 1.0  # of the simulated velocities [s]
_REACHED = 0.95  # probability with which home counts as within reach
_ARRIVED_M = 0.5  # from the last position
_LAND_M = 10.0  # height of the slow part of a landing [m]
Z90 = 1.645  # half-width of an interval of 90 % in standard deviations [-]


@dataclass(frozen=True)
class Flight:
    """A flight in parts: ground velocity, (n, 3) [m/s], duration, (n,) [s], item at the end of each part, (n,)."""

    v: np.ndarray
    dt: np.ndarray
    seq: np.ndarray
    end: np.ndarray  # position at the end of each part, NED, (n, 3) [m]


def forecast_battery(
    track: Track,
    seq: np.ndarray,
    twins: tuple[MultirotorConfig, MultirotorModel, BatteryModel],
    params: Mapping[str, float],
) -> BatteryForecast | None:
    """Predict the remaining share at the end of the mission and at home; None before the charge is known.

    Args:
        track: newest flight
        seq: mission item of each row; nan: no mission is flown, only the return is predicted
        twins: configuration of the autopilot, model, battery
        params: autopilot parameters
    """
    config, model, battery = twins
    wind = np.array(model.wind)
    home = _flight(return_legs(config, track.p[-1], MultirotorTwin(config, model)))
    at_home, home_std = battery.remaining_after(home.v, home.dt, wind, params)
    if not (len(at_home) and isfinite(at_home[-1])):
        return None
    fields = {"remaining": battery.newest[2], "home": float(at_home[-1]), "home_sigma": float(home_std[-1])}
    power = battery.newest[0] * battery.newest[1]
    mission = mission_to_end(track, seq, config, model) if isfinite(seq[-1]) else None
    if mission is None:
        return BatteryForecast(power_w=power, sentence=_sentence(fields, None), **fields)  # type: ignore[arg-type]
    remaining, std = battery.remaining_after(mission.v, mission.dt, wind, params)
    fields |= {"end": float(remaining[-1]), "end_sigma": float(std[-1]), "end_s": float(mission.dt.sum())}
    last = _last_item_with_home(mission, (config, model, battery), params)
    lands = bool(len(mission.end)) and float(np.ptp(mission.end[-20:, 2])) > _ARRIVED_M
    sentence = _sentence(fields, last, lands=lands)
    number = -1 if last is None else last
    return BatteryForecast(power_w=power, last_item=number, sentence=sentence, **fields)  # type: ignore[arg-type]


def mission_to_end(track: Track, seq: np.ndarray, config: MultirotorConfig, model: MultirotorModel) -> Flight | None:
    """Simulate the mission to its end; None: nothing to fly."""
    config = replace(config, max_legs=_MAX_LEGS)
    segments, _ = config.segments(track, seq)
    if not len(segments):
        return None
    twin = MultirotorTwin(config, model)
    parts = _flight(_limited(segments, twin))
    ahead = np.arange(0.0, min(1.5 * float(parts.dt.sum()) + 60.0, _MAX_S) + _STEP_S, _STEP_S)
    path = fly_segments(track, segments, int(seq[-1]) + config.seq_offset, twin, ahead, since=time_on_item(seq))
    moving = np.flatnonzero(np.linalg.norm(path - path[-1], axis=1) > _ARRIVED_M)
    n = min(int(moving[-1]) + 2 if len(moving) else 1, len(path) - 1)
    v = np.diff(path[: n + 1], axis=0) / _STEP_S
    ends = np.cumsum(parts.dt) * n * _STEP_S / max(float(parts.dt.sum()), 1e-6)
    item = parts.seq[np.minimum(ends.searchsorted(ahead[1 : n + 1] - 1e-9), len(parts.seq) - 1)] - config.seq_offset
    return Flight(v, np.full(n, _STEP_S), item, path[1 : n + 1])


def return_legs(config: MultirotorConfig, p: np.ndarray, twin: MultirotorTwin) -> np.ndarray:
    """Return the segments of a return from `p` with their limits; empty if home is unknown."""
    segments = return_segments(config.items, config.origin, p, config.params, arcs=config.plans_legs)
    return _limited(segments, twin)


def _limited(segments: np.ndarray, twin: MultirotorTwin) -> np.ndarray:
    out = limit_speeds(segments, twin.limit) if len(segments) else segments
    if len(out) and out.shape[1] == copter_legs.N_COLUMNS:
        out = copter_rollout.prepare(out, segments, twin.config.items, twin.config.params, twin.limit)
    return out


def _flight(segments: np.ndarray) -> Flight:
    """Return segments with limits as a flight in parts."""
    v: list[np.ndarray] = []
    dt: list[float] = []
    seq: list[float] = []
    end: list[np.ndarray] = []
    for row in segments:
        displacement = row[copter.B_N : copter.B_N + 3] - row[copter.A_N : copter.A_N + 3]
        length, speed = float(np.linalg.norm(displacement)), max(float(row[copter.SPEED]), 0.1)
        direction = displacement / max(length, 1e-6)
        parts = [(length, speed)]
        if len(row) == copter_legs.N_COLUMNS and row[copter_legs.DESCENT]:
            slow = min(max(float(row[copter_legs.LOW]), _LAND_M), length)
            parts = [(length - slow, float(row[copter_legs.DESCENT])), (slow, speed)]
        elif len(row) == copter_legs.N_COLUMNS and row[copter_legs.TURN]:
            parts, direction = [(abs(row[copter_legs.TURN]) * row[copter_legs.RADIUS], speed)], np.array([1.0, 0, 0])
        for distance, top in parts:
            if distance > 0.0:
                time = distance / top + min(top / max(float(row[copter.ACC]), 0.1), distance / top)
                v, dt = [*v, direction * distance / time], [*dt, time]
                seq, end = [*seq, row[copter.SEQ]], [*end, row[copter.B_N : copter.B_N + 3]]
        if 0.0 < row[copter.HOLD] < 1e6:
            v, dt = [*v, np.zeros(3)], [*dt, float(row[copter.HOLD])]
            seq, end = [*seq, row[copter.SEQ]], [*end, row[copter.B_N : copter.B_N + 3]]
    return Flight(np.array(v).reshape(-1, 3), np.array(dt), np.array(seq), np.array(end).reshape(-1, 3))


def _last_item_with_home(
    mission: Flight, twins: tuple[MultirotorConfig, MultirotorModel, BatteryModel], params: Mapping[str, float]
) -> int | None:
    """Return the last item after which home is reached; None: after every one, -1: not even now."""
    config, model, battery = twins
    twin = MultirotorTwin(config, model)
    last = -1
    for k in [*np.flatnonzero(np.diff(mission.seq) != 0), len(mission.seq) - 1]:
        home = _flight(return_legs(config, mission.end[k], twin))
        v, dt = np.vstack([mission.v[: k + 1], home.v]), np.concatenate([mission.dt[: k + 1], home.dt])
        remaining, std = battery.remaining_after(v, dt, np.array(model.wind), params)
        if ndtr(remaining[-1] / std[-1]) < _REACHED:
            return last
        last = int(mission.seq[k])
    return None


def _sentence(fields: Mapping[str, float], last: int | None, *, lands: bool = False) -> str:
    """Describe the forecast: lands with 12 ± 3 %; cannot reach home after item 9."""

    def share(name: str) -> str:
        return f"{100 * max(fields[name], 0.0):.0f} ± {100 * Z90 * fields[f'{name}_sigma']:.0f} %"

    at_home = f"at home with {share('home')} if it returns now"
    if "end" not in fields:
        return at_home
    empty = ndtr(fields["end"] / fields["end_sigma"]) < 1.0 - _REACHED
    end = "is empty before the end" if empty else f"{'lands' if lands else 'ends'} with {share('end')}"
    limit = "" if last is None else "; cannot reach home" + (f" after item {last}" if last >= 0 else " from here")
    return f"{end}{limit}; {at_home}" if last is None or last >= 0 else f"{end}{limit}"
