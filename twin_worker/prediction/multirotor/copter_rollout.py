"""Rollout of ArduCopter's route: synchronise its waypoint navigation with the flight so far, and simulate it.

The state of the navigation is that of an undisturbed simulated flight, from the leg before the present one, at the time
that lies nearest to the newest positions and velocities.
"""

from collections.abc import Mapping, Sequence
from math import isfinite, pi, tan

import numpy as np

from fleet.autopilots import copter, copter_legs, position_loop
from fleet.autopilots.copter import Limits
from fleet.contract import Item
from fleet.frames import G, wrap
from twin_worker.telemetry.track import STEP, Track

_MAX_RUN = 1200  # steps of the undisturbed flight
_MATCH_ROWS = range(0, 50, 5)  # rows of the track, before the newest one, that are compared
_VELOCITY_S = 0.7  # weight of a velocity against a position [s]
_MAX_OFFSET_M = 5.0  # from the leg; beyond it a new leg begins at the aircraft
_ATTITUDE_LAG_S = 0.25
_MIN_INPUT_TC_S = 0.1  # ArduCopter limits the rise of jerk to half of what this time permits [s]
_STATIONARY_SPEED = 0.8  # [m/s]
_TAKEOFF, _JERK_Z = 22, 5.0  # MAV_CMD; default of PSC_JERK_D [m/s3]
_LONG_ROWS = 300  # of a circle before its motion is steady
_LONG_S = 1e4  # time after the end of any leg [s]
_REPORT_DELAY_S = 0.5  # mean delay of MISSION_CURRENT at 1 Hz [s]
_VELOCITY_ROWS, _ACCELERATION_ROWS, _DRAG_ROWS = 3, 8, 200
_TILT_ROWS, _SATURATED = 3, 0.98
_GAINS = (  # default and parameter names: horizontal P, vertical P, horizontal I and D of the velocity,
    # time constant of the attitude commands, jerk of shaped positions
    (1.0, ("PSC_NE_POS_P", "PSC_POSXY_P")),
    (2.0, ("PSC_NE_VEL_P", "PSC_VELXY_P")),
    (1.0, ("PSC_D_POS_P", "PSC_POSZ_P")),
    (5.0, ("PSC_D_VEL_P", "PSC_VELZ_P")),
    (1.0, ("PSC_NE_VEL_I", "PSC_VELXY_I")),
    (0.25, ("PSC_NE_VEL_D", "PSC_VELXY_D")),
    (0.15, ("ATC_INPUT_TC",)),
    (5.0, ("PSC_JERK_NE", "PSC_JERK_XY")),
)


GainTable = tuple[tuple[float, tuple[str, ...]], ...]
"""Default and parameter names of each gain."""


def parameters(limit: Limits, params: Mapping[str, float], airframe: Sequence[float]) -> np.ndarray:
    """Return the parameters of the navigation, (position_loop.N_PAR,).

    Args:
        limit, params: limits and autopilot parameters
        airframe: linear and quadratic drag over mass, wind north and east [1/s, 1/m, m/s, m/s]
    """
    par = gains(_GAINS, limit, params, (1.0, *airframe))
    par[position_loop.JERK_TIME] = 2.0 * max(par[position_loop.JERK_TIME], _MIN_INPUT_TC_S)
    return par


def gains(table: GainTable, limit: Limits, params: Mapping[str, float], airframe: Sequence[float]) -> np.ndarray:
    """Return gains of the position loop and limits, (position_loop.N_PAR,).

    Args:
        table: of the autopilot
        limit, params: limits and autopilot parameters
        airframe: 1 for ArduCopter's law, 0 for PX4's; drag and wind as of `parameters`
    """
    values = [
        next((params[name] for name in names if isfinite(params.get(name, np.nan)) and params[name] > 0), default)
        for default, names in table
    ]
    tilt = G * tan(min(limit.tilt, 1.2))
    middle = (_ATTITUDE_LAG_S, limit.jerk, limit.radius, limit.acc_corner, tilt, limit.acc)
    return np.array([*values[:4], *middle, *values[4:7], *airframe, values[7], limit.acc_z])


def prepare(
    segments: np.ndarray, commanded: np.ndarray, items: Sequence[Item], params: Mapping[str, float], limit: Limits
) -> np.ndarray:
    """Set speeds before a commanded change and on circles, the jerk of take-offs, and the speeds of a landing.

    Args:
        segments, commanded: with and without limits, (n, copter_legs.N_COLUMNS)
        items: mission
        params: autopilot parameters
        limit: limits
    """
    for k in range(1, len(segments)):
        before, own = commanded[k - 1, copter.SPEED], commanded[k, copter.SPEED]
        if before != own and min(before, own) >= 0.0 and not segments[k, copter_legs.TURN]:
            t = segments[k, copter.B_N : copter.B_N + 3] - segments[k, copter.A_N : copter.A_N + 3]
            t = t / max(float(np.linalg.norm(t)), 1e-6)
            speed = copter.limit_along(before or limit.speed, limit.up, limit.down, t)
            segments[k, copter_legs.SPEED_BEFORE] = min(speed, 100.0)
    for row, wanted in zip(segments, commanded, strict=True):
        if row[copter_legs.TURN]:
            row[copter_legs.SPEED_BEFORE] = wanted[copter_legs.SPEED_BEFORE] or limit.speed
            row[copter.SPEED] = min(wanted[copter.SPEED], row[copter_legs.SPEED_BEFORE])
        if row[copter_legs.DESCENT]:
            high = params.get("LAND_SPD_HIGH_MS", params.get("LAND_SPEED_HIGH", 0.0) * 0.01)
            row[copter_legs.DESCENT] = max(high if high > 0 else limit.down, limit.land)
            row[copter_legs.LOW] = max(params.get("LAND_ALT_LOW_M", params.get("LAND_ALT_LOW", 1000.0) * 0.01), 1.0)
            row[copter.SPEED] = limit.land
    takeoff = np.isin(segments[:, copter.SEQ], [item.seq for item in items if item.command == _TAKEOFF])
    jerk = params.get("PSC_JERK_D", params.get("PSC_JERK_Z", _JERK_Z))
    segments[takeoff, copter_legs.LEG_JERK] = jerk if jerk > 0 else _JERK_Z
    return segments


def stopping_point(p: np.ndarray, v: np.ndarray, par: np.ndarray) -> np.ndarray:
    """Return where the position loop stops an aircraft, NED, (3,) [m]."""
    speed = float(np.linalg.norm(v))
    return p + v * position_loop.stopping_time(speed, par[position_loop.POS_P], par[position_loop.ACC_XY])


def present_motion(track: Track, par: np.ndarray) -> np.ndarray:
    """Return the newest position, velocity, acceleration by tilt, and integrator, (4, 3), as of `track_reference`."""
    rows = min(_ACCELERATION_ROWS, len(track) - 1)
    v = track.v[-_VELOCITY_ROWS:].mean(axis=0)
    a = (track.v[-1] - track.v[-1 - rows]) / (STEP * rows) if rows else np.zeros(3)
    tilt, largest = tilt_acceleration(track.euler[-_DRAG_ROWS:]), _SATURATED * par[position_loop.ACC_MAX]
    recent = np.ascontiguousarray(track.v[-_DRAG_ROWS:, :2])
    drag, integrator = position_loop.drag_integrator(recent, tilt, par, STEP, largest)
    f = np.clip(a, -5.0, 5.0)
    f[:2] += drag
    if len(tilt) >= _TILT_ROWS and np.isfinite(tilt[-_TILT_ROWS:]).all():
        f[:2] = tilt[-_TILT_ROWS:].mean(axis=0)
    return np.array([track.p[-1], v, f, [*integrator, 0.0]])


def tilt_acceleration(euler: np.ndarray) -> np.ndarray:
    """Return g tan(tilt) in the direction of the horizontal thrust, (n, 2) [m/s2], from phi theta psi, (n, 3)."""
    cf, sf, ct, st, cp, sp = (g(euler[:, i]) for i in range(3) for g in (np.cos, np.sin))
    horizontal = np.column_stack([cf * st * cp + sf * sp, cf * st * sp - sf * cp])
    return -G * horizontal / np.maximum(cf * ct, 0.3)[:, None]


def fly(track: Track, segments: np.ndarray, item: tuple[int, float], par: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Simulate the flight from the end of the track; return the path, (k, 3) [m].

    Args:
        track: newest flight
        segments: from the leg before the present one on, (n, copter_legs.N_COLUMNS)
        item: current mission item, and the time since it was first reported, nan unknown [-, s]
        par: as of `parameters`
        ahead: look-ahead, (k,) [s]
    """
    (state, integrator), xva = _synchronise(track, segments, item, par), present_motion(track, par)
    if integrator is not None:
        xva[3] = integrator
    out = np.empty((int(ahead[-1] / STEP) + 2, 3))
    copter_legs.follow(state, segments, xva, par, STEP, out)
    return np.column_stack([np.interp(ahead, STEP * np.arange(len(out)), column) for column in out.T])


def _synchronise(
    track: Track, segments: np.ndarray, item: tuple[int, float], par: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the state of the navigation now, (copter_legs.N_STATE,), and the integrator if it is simulated, (3,)."""
    seq, since = item
    own = np.flatnonzero(segments[:, copter.SEQ] == seq)
    own = own[np.cumprod(np.diff(own, prepend=own[:1] - 1) == 1).astype(bool)]  # not those after a jump back
    first = int(own[0]) if len(own) else 0
    circle = own[segments[own, copter_legs.TURN] != 0.0]
    if len(circle) and (state := _on_circle(track, segments, int(circle[0]), par)) is not None:
        return state, None
    waits = len(own) > 0 and _length(segments[first]) < 0.1
    if waits and not first and isfinite(since):  # without the leg before, it waits since the report
        state = _new_leg(track, segments, first, par)
        state[copter_legs.T], state[copter_legs.WAIT] = _LONG_S, since + _REPORT_DELAY_S
        return state, None
    if not len(own):
        return _new_leg(track, segments, first, par), None
    states, simulated = np.empty((_MAX_RUN, copter_legs.N_STATE)), np.empty((_MAX_RUN, 4, 3))
    n = copter_legs.simulated_states(segments, int(own[-1]), par, STEP, states, simulated)
    segment = states[:n, copter_legs.SEGMENT].astype(int)
    rows = np.flatnonzero((segments[segment, copter.SEQ] == seq) & (segments[segment, copter_legs.TURN] == 0.0))
    if not len(rows):
        return _new_leg(track, segments, first, par), None
    stopped = int(_stationary_s(track) / STEP)
    at_end = np.linalg.norm(track.p[-1] - segments[own[-1], copter.B_N : copter.B_N + 3]) < 3.0
    back = min(stopped, len(track) - 2) if stopped and at_end else 0  # rows since it was moving
    matched = np.arange(rows[-1] + 1) if waits else rows  # it was moving on the leg before
    row = int(matched[np.argmin(_distance(track, simulated, matched, back))])
    if np.linalg.norm(simulated[row, 0] - track.p[-1 - back]) > _MAX_OFFSET_M:
        return _new_leg(track, segments, int(segment[row]), par), None
    row = min(max(row + back, int(rows[0])), int(rows[-1]))
    return states[row].copy(), simulated[row, 3]


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
    speed, acc, jerk = max(float(v @ direction), 0.0), segments[k, copter.ACC], par[position_loop.JERK]
    ramp = min(acc / jerk, float(np.sqrt(speed / jerk)))  # time of each jerk phase of an acceleration to this speed
    time = 2 * ramp + max(speed / acc - ramp, 0.0) if speed > 0.3 else 0.0
    state[copter_legs.T] = time + 0.5 * par[position_loop.JERK_TIME]
    state[copter_legs.START_N : copter_legs.START_D + 1] = p - direction * speed * time / 2
    return state


def _on_circle(track: Track, segments: np.ndarray, k: int, par: np.ndarray) -> np.ndarray | None:
    """Return the state on circle `k`; None: not there yet.

    It is that of a simulated circle that began when the aircraft did, or long ago, turned to the aircraft.
    """
    segment = segments[k]
    centre = segment[copter_legs.C_N : copter_legs.C_E + 1]
    level = np.abs(track.p[:, 2] - segment[copter.B_N + 2]) < 3.0
    there = _circles(track.p, track.v, segment) & level
    if not there[-1]:
        return None
    away = np.flatnonzero(~there)
    rows = len(there) - 1 - (int(away[-1]) if len(away) else -_LONG_ROWS)
    states, simulated = np.empty((rows + _LONG_ROWS, copter_legs.N_STATE)), np.empty((rows + _LONG_ROWS, 4, 3))
    endless = segments[k : k + 1].copy()
    endless[0, copter.A_N : copter.B_N + 3] = np.tile(segment[copter.B_N : copter.B_N + 3], 2)
    copter_legs.simulated_states(endless, 0, par, STEP, states, simulated)
    begun = np.flatnonzero(~_circles(simulated[:, 0], simulated[:, 1], segment))
    row = min((int(begun[-1]) if len(begun) else 0) + rows, len(states) - 1)
    state = states[row].copy()
    offset, model = track.p[-1, :2] - centre, simulated[row, 0, :2] - centre
    ahead = wrap(float(np.arctan2(*offset[::-1]) - np.arctan2(*model[::-1])))
    turn = np.array([[np.cos(ahead), -np.sin(ahead)], [np.sin(ahead), np.cos(ahead)]])
    shaped = state[copter_legs.SHAPED :].reshape(3, 2)
    shaped[0] -= centre
    shaped[:] = shaped @ turn.T
    shaped[0] += centre
    sense = 1.0 if segment[copter_legs.TURN] > 0 else -1.0
    state[copter_legs.SEGMENT], state[copter_legs.ANGLE] = k, state[copter_legs.ANGLE] + ahead
    state[copter_legs.TURNED] += sense * ahead
    if not len(away):  # it began before the track does
        angle = np.unwrap(np.arctan2(track.p[:, 1] - centre[1], track.p[:, 0] - centre[0]))
        state[copter_legs.TURNED] = min(abs(float(angle[-1] - angle[0])), 40 * pi)
    return state


def _circles(p: np.ndarray, v: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Return where positions and velocities, (n, 3), are on a circle, in its direction, (n,) bool."""
    offset = p[:, :2] - segment[copter_legs.C_N : copter_legs.C_E + 1]
    distance, radius = np.hypot(*offset.T), segment[copter_legs.RADIUS]
    tangential = (offset[:, 0] * v[:, 1] - offset[:, 1] * v[:, 0]) * np.sign(segment[copter_legs.TURN])
    return (np.abs(distance - radius) < max(3.0, 0.15 * radius)) & (tangential / np.maximum(distance, 1.0) > 0.3)


def _stationary_s(track: Track) -> float:
    """Return how long the aircraft has been stationary [s]."""
    moving = np.flatnonzero(np.linalg.norm(track.v, axis=1) > _STATIONARY_SPEED)
    return STEP * (len(track) - 1 - (int(moving[-1]) if len(moving) else -1))
