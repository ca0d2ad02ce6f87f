"""Rollout of a PX4 multirotor's route: its trajectory starts with the motion of the aircraft."""

from collections.abc import Mapping, Sequence
from math import isfinite

import numpy as np

from fleet.autopilots import copter, px4_multirotor
from fleet.autopilots.copter import Limits
from fleet.contract import Item
from twin_worker.prediction.multirotor.copter_rollout import gains, present_motion
from twin_worker.telemetry.track import STEP, Track

_GAINS = (
    (0.95, ("MPC_XY_P",)),
    (1.8, ("MPC_XY_VEL_P_ACC",)),
    (1.0, ("MPC_Z_P",)),
    (4.0, ("MPC_Z_VEL_P_ACC",)),
)
_DEFAULTS = {
    "NAV_ACC_RAD": 10.0,
    "NAV_MC_ALT_RAD": 0.8,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_UP_MAX": 4.0,
    "MPC_ACC_DOWN_MAX": 3.0,
    "MPC_Z_V_AUTO_UP": 3.0,
    "MPC_Z_V_AUTO_DN": 1.5,
    "MPC_XY_ERR_MAX": 2.0,
}
_TAKEOFF = 22  # MAV_CMD
_REPORT_DELAY_S = 0.5  # mean delay of MISSION_CURRENT at 1 Hz [s]


def parameters(limit: Limits, params: Mapping[str, float]) -> np.ndarray:
    """Return the parameters of the trajectory, (px4_multirotor.N_PAR,)."""
    known = {name: value for name, value in params.items() if name in _DEFAULTS and isfinite(value) and value > 0}
    values = _DEFAULTS | known
    own = [values[name] for name in _DEFAULTS]
    own[2] = limit.acc  # with what was learnt from flight
    return np.array([*gains(_GAINS, limit, params), *own])


def limit_takeoff(segments: np.ndarray, items: Sequence[Item], params: Mapping[str, float]) -> np.ndarray:
    """Limit the climb of take-offs to MPC_TKO_SPEED."""
    speed = params.get("MPC_TKO_SPEED", 1.5)
    takeoffs = [item.seq for item in items if item.command == _TAKEOFF]
    rows = np.isin(segments[:, copter.SEQ], takeoffs)
    segments[rows, copter.SPEED] = np.minimum(segments[rows, copter.SPEED], speed if speed > 0 else np.inf)
    return segments


def fly(track: Track, segments: np.ndarray, item: tuple[int, float], par: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Simulate the flight from the end of the track; arguments as of `copter_rollout.fly`."""
    seq, since = item
    own = np.flatnonzero(segments[:, copter.SEQ] == seq)
    k = own[int(np.argmin(_offset(track.p[-1], segments[own])))] if len(own) else 0
    state = np.zeros(px4_multirotor.N_STATE)
    state[px4_multirotor.SEGMENT] = k
    a, b = segments[k, copter.A_N : copter.A_N + 3], segments[k, copter.B_N : copter.B_N + 3]
    if np.linalg.norm(b - a) < 0.1 and isfinite(since):
        state[px4_multirotor.WAIT] = since + _REPORT_DELAY_S
    elif segments[k, copter.HOLD] > 0:
        state[px4_multirotor.WAIT] = _accepted_s(track, b, par)
    out = np.empty((int(ahead[-1] / STEP) + 2, 3))
    px4_multirotor.follow(state, segments, present_motion(track), par, STEP, out)
    return np.column_stack([np.interp(ahead, STEP * np.arange(len(out)), column) for column in out.T])


def _offset(p: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Return the distance of a position from each segment [m]."""
    a, b = segments[:, copter.A_N : copter.A_N + 3], segments[:, copter.B_N : copter.B_N + 3]
    length2 = np.maximum(np.sum((b - a) ** 2, axis=1), 1e-6)
    share = np.clip(np.sum((p - a) * (b - a), axis=1) / length2, 0.0, 1.0)
    return np.linalg.norm(a + share[:, None] * (b - a) - p, axis=1)


def _accepted_s(track: Track, b: np.ndarray, par: np.ndarray) -> float:
    """Return how long the aircraft has been within the acceptance radius of a point [s]."""
    offset = track.p - b
    there = np.hypot(offset[:, 0], offset[:, 1]) < par[px4_multirotor.ACCEPT]
    there &= np.abs(offset[:, 2]) < par[px4_multirotor.ACCEPT_Z]
    away = np.flatnonzero(~there)
    return STEP * (len(track) - 1 - (int(away[-1]) if len(away) else -1))
