"""Rollout of ArduCopter's route: synchronise its waypoint navigation with the flight so far, and simulate it.

The state of the navigation is that of an undisturbed simulated flight, from the leg before the present one, at the time
that lies nearest to the newest positions and velocities.
"""

from collections.abc import Mapping, Sequence
from math import atan2, hypot, isfinite, pi, tan

import numpy as np

from fleet.autopilots import copter, copter_legs
from fleet.autopilots.copter import Limits
from fleet.contract import Item
from fleet.frames import G
from twin_worker.telemetry.track import STEP, Track

_MAX_RUN = 1200  # steps of the undisturbed flight
_MATCH_ROWS = range(0, 50, 5)  # rows of the track, before the newest one, that are compared
_VELOCITY_S = 0.7  # weight of a velocity against a position [s]
_MAX_OFFSET_M = 5.0  # from the leg; beyond it a new leg begins at the aircraft
_ATTITUDE_LAG_S = 0.25
_MIN_INPUT_TC_S = 0.1  # ArduCopter limits the rise of jerk to half of what this time permits [s]
_STATIONARY_SPEED = 0.8  # [m/s]
_TAKEOFF, _JERK_Z = 22, 5.0  # MAV_CMD; default of PSC_JERK_D [m/s3]
_LONG_S = 1e4  # time after the end of any leg [s]
_REPORT_DELAY_S = 0.5  # mean delay of MISSION_CURRENT at 1 Hz [s]
_VELOCITY_ROWS, _ACCELERATION_ROWS, _DRAG_ROWS = 3, 8, 200
_GAINS = (  # default and parameter names: horizontal P, vertical P, horizontal I and D of the velocity,
    # time constant of the attitude commands
    (1.0, ("PSC_NE_POS_P", "PSC_POSXY_P")),
    (2.0, ("PSC_NE_VEL_P", "PSC_VELXY_P")),
    (1.0, ("PSC_D_POS_P", "PSC_POSZ_P")),
    (5.0, ("PSC_D_VEL_P", "PSC_VELZ_P")),
    (1.0, ("PSC_NE_VEL_I", "PSC_VELXY_I")),
    (0.25, ("PSC_NE_VEL_D", "PSC_VELXY_D")),
    (0.15, ("ATC_INPUT_TC",)),
)


GainTable = tuple[tuple[float, tuple[str, ...]], ...]
"""Default and parameter names of each gain."""


def parameters(limit: Limits, params: Mapping[str, float], drag: float) -> np.ndarray:
    """Return the parameters of the navigation, (copter_legs.N_PAR,); drag over mass and airspeed [1/s]."""
    par = gains(_GAINS, limit, params, (1.0, drag))
    par[copter_legs.JERK_TIME] = 2.0 * max(par[copter_legs.JERK_TIME], _MIN_INPUT_TC_S)
    return par


def gains(table: GainTable, limit: Limits, params: Mapping[str, float], airframe: tuple[float, float]) -> np.ndarray:
    """Return gains of the position loop and limits, (copter_legs.N_PAR,).

    Args:
        table: of the autopilot
        limit, params: limits and autopilot parameters
        airframe: 1 if the derivative is of the velocity error, 0 if of the velocity; drag over mass and airspeed [1/s]
    """
    values = [
        next((params[name] for name in names if isfinite(params.get(name, np.nan)) and params[name] > 0), default)
        for default, names in table
    ]
    tilt = G * tan(min(limit.tilt, 1.2))
    middle = (_ATTITUDE_LAG_S, limit.jerk, limit.radius, limit.acc_corner, tilt, limit.acc)
    return np.array([*values[:4], *middle, *values[4:], *airframe])


def prepare(
    segments: np.ndarray, commanded: np.ndarray, items: Sequence[Item], params: Mapping[str, float]
) -> np.ndarray:
    """Set the speeds with which legs are planned before a commanded change, and the jerk of take-offs.

    Args:
        segments, commanded: with and without limits, (n, copter_legs.N_COLUMNS)
        items: mission
        params: autopilot parameters
    """
    for k in range(1, len(segments)):
        before, own = commanded[k - 1, copter.SPEED], commanded[k, copter.SPEED]
        if before != own and min(before, own) >= 0.0 and not segments[k, copter_legs.TURN]:
            horizontal = segments[k, copter.B_N : copter.B_N + 2] - segments[k, copter.A_N : copter.A_N + 2]
            share = float(np.hypot(*horizontal)) / max(_length(segments[k]), 1e-6)
            segments[k, copter_legs.SPEED_BEFORE] = segments[k - 1, copter.SPEED] if share > 0.9 else 0.0
    takeoff = np.isin(segments[:, copter.SEQ], [item.seq for item in items if item.command == _TAKEOFF])
    jerk = params.get("PSC_JERK_D", params.get("PSC_JERK_Z", _JERK_Z))
    segments[takeoff, copter_legs.LEG_JERK] = jerk if jerk > 0 else _JERK_Z
    return segments


def stopping_point(p: np.ndarray, v: np.ndarray, par: np.ndarray) -> np.ndarray:
    """Return where the position loop stops an aircraft, NED, (3,) [m]."""
    speed = float(np.linalg.norm(v))
    return p + v * copter_legs.stopping_time(speed, par[copter_legs.POS_P], par[copter_legs.ACC_XY])


def present_motion(track: Track, par: np.ndarray) -> np.ndarray:
    """Return the newest position, velocity, acceleration, and unbalanced drag, (4, 3).

    The integrator balances a change of drag, b' = -k x'' - b I / P, at the velocity error -b / P of slow motion.
    """
    rows = min(_ACCELERATION_ROWS, len(track) - 1)
    a = (track.v[-1] - track.v[-1 - rows]) / (STEP * rows) if rows else np.zeros(3)
    b, recovery = np.zeros(3), par[copter_legs.VEL_I] / par[copter_legs.VEL_P] * STEP
    for change in np.diff(track.v[-_DRAG_ROWS:, :2], axis=0):
        b[:2] -= par[copter_legs.DRAG] * change + recovery * b[:2]
    return np.array([track.p[-1], track.v[-_VELOCITY_ROWS:].mean(axis=0), np.clip(a, -5.0, 5.0), b])


def fly(track: Track, segments: np.ndarray, item: tuple[int, float], par: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Simulate the flight from the end of the track; return the path, (k, 3) [m].

    Args:
        track: newest flight
        segments: from the leg before the present one on, (n, copter_legs.N_COLUMNS)
        item: current mission item, and the time since it was first reported, nan unknown [-, s]
        par: as of `parameters`
        ahead: look-ahead, (k,) [s]
    """
    state, xva = _synchronise(track, segments, item, par), present_motion(track, par)
    out = np.empty((int(ahead[-1] / STEP) + 2, 3))
    copter_legs.follow(state, segments, xva, par, STEP, out)
    return np.column_stack([np.interp(ahead, STEP * np.arange(len(out)), column) for column in out.T])


def _synchronise(track: Track, segments: np.ndarray, item: tuple[int, float], par: np.ndarray) -> np.ndarray:
    """Return the state of the navigation now, (copter_legs.N_STATE,)."""
    seq, since = item
    own = np.flatnonzero(segments[:, copter.SEQ] == seq)
    first = int(own[0]) if len(own) else 0
    circle = own[segments[own, copter_legs.TURN] != 0.0]
    if len(circle) and (state := _on_circle(track, segments[circle[0]])) is not None:
        state[copter_legs.SEGMENT] = circle[0]
        return state
    waits = len(own) > 0 and _length(segments[first]) < 0.1
    if waits and not first and isfinite(since):  # without the leg before, it waits since the report
        state = _new_leg(track, segments, first, par)
        state[copter_legs.T], state[copter_legs.WAIT] = _LONG_S, since + _REPORT_DELAY_S
        return state
    if not len(own):
        return _new_leg(track, segments, first, par)
    states, simulated = np.empty((_MAX_RUN, copter_legs.N_STATE)), np.empty((_MAX_RUN, 3, 3))
    n = copter_legs.simulated_states(segments, int(own[-1]), par, STEP, states, simulated)
    segment = states[:n, copter_legs.SEGMENT].astype(int)
    rows = np.flatnonzero((segments[segment, copter.SEQ] == seq) & (segments[segment, copter_legs.TURN] == 0.0))
    if not len(rows):
        return _new_leg(track, segments, first, par)
    stopped = int(_stationary_s(track) / STEP)
    at_end = np.linalg.norm(track.p[-1] - segments[own[-1], copter.B_N : copter.B_N + 3]) < 3.0
    back = min(stopped, len(track) - 2) if stopped and at_end else 0  # rows since it was moving
    matched = np.arange(rows[-1] + 1) if waits else rows  # it was moving on the leg before
    row = int(matched[np.argmin(_distance(track, simulated, matched, back))])
    if np.linalg.norm(simulated[row, 0] - track.p[-1 - back]) > _MAX_OFFSET_M:
        return _new_leg(track, segments, int(segment[row]), par)
    return states[min(max(row + back, int(rows[0])), int(rows[-1]))].copy()


def _distance(track: Track, simulated: np.ndarray, rows: np.ndarray, back: int) -> np.ndarray:
    """Return the squared distance of simulated rows from the track until `back` rows ago, (n,) [m2]."""
    cost = np.zeros(len(rows))
    for lag in _MATCH_ROWS:
        k = len(track) - 1 - back - lag
        if k >= 0:
            earlier = np.maximum(rows - lag, 0)
            v = track.v[max(k - 1, 0) : k + 1].mean(axis=0)
            offset, difference = simulated[earlier, 0] - track.p[k], simulated[earlier, 1] - v
            cost += np.einsum("ij,ij->i", offset, offset)
            cost += _VELOCITY_S**2 * np.einsum("ij,ij->i", difference, difference)
    return cost


def _length(segment: np.ndarray) -> float:
    return float(np.linalg.norm(segment[copter.B_N : copter.B_N + 3] - segment[copter.A_N : copter.A_N + 3]))


def _new_leg(track: Track, segments: np.ndarray, k: int, par: np.ndarray) -> np.ndarray:
    """Return the state on a leg that leads from the aircraft to the end of segment `k`, at its present speed."""
    state = np.zeros(copter_legs.N_STATE)
    state[copter_legs.SEGMENT], state[copter_legs.SCALE] = k, 1.0
    state[copter_legs.TAIL] = state[copter_legs.LEAD] = -1.0
    p, v = track.p[-1], track.v[-_VELOCITY_ROWS:].mean(axis=0)
    offset = segments[k, copter.B_N : copter.B_N + 3] - p
    direction = offset / max(float(np.linalg.norm(offset)), 1e-6)
    speed, acc, jerk = max(float(v @ direction), 0.0), segments[k, copter.ACC], par[copter_legs.JERK]
    ramp = min(acc / jerk, float(np.sqrt(speed / jerk)))  # time of each jerk phase of an acceleration to this speed
    time = 2 * ramp + max(speed / acc - ramp, 0.0) if speed > 0.3 else 0.0
    state[copter_legs.T] = time + 0.5 * par[copter_legs.JERK_TIME]
    state[copter_legs.START_N : copter_legs.START_D + 1] = p - direction * speed * time / 2
    return state


def _on_circle(track: Track, segment: np.ndarray) -> np.ndarray | None:
    """Return the state on a circle, with the angle flown so far; None: not there yet."""
    centre, radius = segment[copter_legs.C_N : copter_legs.C_E + 1], segment[copter_legs.RADIUS]
    offset = track.p[:, :2] - centre
    distance = np.hypot(*offset.T)
    level = np.abs(track.p[:, 2] - segment[copter.B_N + 2]) < 3.0
    tangential = offset[:, 0] * track.v[:, 1] - offset[:, 1] * track.v[:, 0]
    sense = 1.0 if segment[copter_legs.TURN] > 0 else -1.0
    there = (np.abs(distance - radius) < max(2.0, 0.15 * radius)) & level
    moves = sense * tangential / np.maximum(distance, 1.0) > 0.3
    if not (there[-1] and moves[-1]):
        return None
    away = np.flatnonzero(~(there & moves))
    begin = int(away[-1]) + 1 if len(away) else 0
    angle = np.unwrap(np.arctan2(offset[begin:, 1], offset[begin:, 0]))
    state = np.zeros(copter_legs.N_STATE)
    state[copter_legs.TAIL] = state[copter_legs.LEAD] = -1.0
    state[copter_legs.SCALE] = 1.0
    state[copter_legs.ANGLE] = atan2(offset[-1, 1], offset[-1, 0])
    state[copter_legs.RATE] = hypot(*track.v[-1, :2]) / radius
    state[copter_legs.TURNED] = min(abs(float(angle[-1] - angle[0])), 40 * pi)
    return state


def _stationary_s(track: Track) -> float:
    """Return how long the aircraft has been stationary [s]."""
    moving = np.flatnonzero(np.linalg.norm(track.v, axis=1) > _STATIONARY_SPEED)
    return STEP * (len(track) - 1 - (int(moving[-1]) if len(moving) else -1))
