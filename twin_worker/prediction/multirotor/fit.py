"""Fit of the multirotor model: minimise the rollout error from many starts over the last minute.

Drag and wind come from the tilt: horizontal thrust minus acceleration is drag, which depends on the airspeed.
Source: drag as in Mahony, Kumar & Corke 2012 (linear in airspeed).
"""

from dataclasses import replace
from math import isfinite, tan

import numpy as np

from fleet.frames import G
from twin_worker.prediction.multirotor.rollout import Onboard, Rotor, Way, fly_segments
from twin_worker.prediction.multirotor.route import lay
from twin_worker.telemetry.track import STEP, Track

_LEAST_S = 2.0  # minimum track before a rollout [s]
_BACK_S = 60.0  # compared flight [s]
_EVERY_S, _OVER_S = 4.0, 10.0  # interval of starts, length of a rollout [s]
_LAGS = (0.7, 1.0, 1.4, 2.0, 2.8)  # tried natural frequencies [rad/s]
_SHARES = (0.6, 0.8, 0.9, 1.0, 1.1, 1.25)  # tried fractions of the limits
_PAUSES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)  # tried delays at each stop [s]
_TRIED = (("share", _SHARES), ("pause", _PAUSES), ("wn", _LAGS), ("push", _SHARES))  # one per call
_DOUBT = 20.0  # cost of a fraction e times the limit, as a sum of errors [m]


def compare(track: Track, seq: np.ndarray, board: Onboard, rotor: Rotor) -> Rotor:
    """Fit lag, speed, acceleration and stop delay to the last minute by the rollout error from many starts."""
    rotor = _blown(track, board, rotor)
    starts = _starts(track, seq, board)
    if len(starts) < 3:
        return rotor
    laid = {}
    for k in starts:
        if seq[k] not in laid:
            laid[seq[k]] = lay(board.items, int(seq[k]) + board.shift, board.origin, track.p[k], board.params)[0]

    def miss(one: Rotor) -> float:
        found = [_strays(track, k, laid[seq[k]], int(seq[k]) + board.shift, Way(board, one)) for k in starts]
        return float(np.mean(found)) + _DOUBT / len(starts) * (abs(np.log(one.share)) + 0.3 * abs(np.log(one.push)))

    name, tried = _TRIED[rotor.turn % len(_TRIED)]
    options = [replace(rotor, **{name: value}) for value in dict.fromkeys((getattr(rotor, name), *tried))]
    found = [miss(one) for one in options]
    best = int(np.argmin(found))
    return replace(options[best], miss=found[best], starts=len(starts), turn=rotor.turn + 1)


def _starts(track: Track, seq: np.ndarray, board: Onboard) -> list[int]:
    """Return the start rows: on this route, moving, with ten seconds of flight after them."""
    over, every = int(_OVER_S / STEP), int(_EVERY_S / STEP)
    first = max(int(np.searchsorted(track.t, board.since + _LEAST_S)), len(track) - int(_BACK_S / STEP), 20)
    rows = range(len(track) - 1 - over, first, -every)
    return [k for k in rows if isfinite(seq[k]) and track.ok[k - 20 : k + over].all() and _moves(track, k, over)]


def _moves(track: Track, k: int, over: int) -> bool:
    return bool(np.linalg.norm(track.p[k + over] - track.p[k]) > 3.0)


def _strays(track: Track, k: int, laid: np.ndarray, seq: int, way: Way) -> float:
    if not len(laid):
        return 0.0
    ahead = np.arange(0.0, _OVER_S + 0.5)
    path = fly_segments(track.part(max(k - 100, 0), k + 1), laid, seq, way, ahead)
    flown = track.p[k + np.rint(ahead / STEP).astype(int)]
    return float(np.linalg.norm(path - flown, axis=1).mean())


def _blown(track: Track, board: Onboard, rotor: Rotor) -> Rotor:
    """Fit drag and wind to the tilt: horizontal thrust minus acceleration is k (v - w), linear in k and k w."""
    rows = np.arange(len(track) - 1, max(len(track) - int(_BACK_S / STEP), 10), -5)
    rows = rows[track.ok[rows] & np.isfinite(track.euler[rows]).all(axis=1)]
    if len(rows) < 40:
        return rotor
    euler = track.euler[rows]
    cf, sf, ct, st, cp, sp = (g(euler[:, i]) for i in range(3) for g in (np.cos, np.sin))
    down = np.column_stack([cf * st * cp + sf * sp, cf * st * sp - sf * cp, cf * ct])  # body z axis in NED
    slope = (track.v[rows] - track.v[rows - 10]) / (10 * STEP)
    thrust = (G - slope[:, 2]) / np.maximum(down[:, 2], 0.5)
    v = track.v[rows, :2] - 0.5 * STEP * 10 * slope[:, :2]
    pull = -down[:, :2] * thrust[:, None] - slope[:, :2]
    one = np.ones(len(rows))
    nil = 0.0 * one
    A = np.vstack([np.column_stack([v[:, 0], -one, nil]), np.column_stack([v[:, 1], nil, -one])])
    found = np.linalg.solve(A.T @ A + np.diag([20.0, 2.0, 2.0]), A.T @ pull.T.ravel() + [20.0 * 0.2, 0.0, 0.0])
    k = float(found[0])
    if not 0.03 < k < 2.0 or np.ptp(v, axis=0).max() < 3.0:
        return rotor
    wind = found[1:] / k
    if not np.hypot(*wind) < 25.0:
        return rotor
    return replace(rotor, v_air=G * tan(board.limit.tilt) / k, wind=(float(wind[0]), float(wind[1])))
