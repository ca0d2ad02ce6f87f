"""Kinematic model of a fixed wing: route guidance and lags, identified from positions alone.

Airspeed and wind come from the wind filter; without an airspeed sensor they come from the change of ground speed with
course. A guidance period that is not received is the one with the smallest error over the last minute.
"""

from dataclasses import dataclass, replace
from math import atan2

import numpy as np

from fleet.autopilots import arduplane
from fleet.autopilots import greybox as law
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.shadow import shadow
from fleet.contract import Item
from fleet.frames import G, Origin
from fleet.mission import KIND, TAKEOFF, VA_C, Route
from fleet.process.sanitise import below
from twin_worker.numerics.interpolation import straight
from twin_worker.prediction.autopilot_parameters import CRUISE_OF, Control, on_wings
from twin_worker.prediction.closed_loop import unrolled
from twin_worker.prediction.route_override import Instead, gone_over
from twin_worker.telemetry.track import STEP, Track

LEAST_S = 5.0  # minimum track on this route [s]
_SYNC_S = 60.0  # flight for the synchronisation of the guidance [s]
_BACK_S, _EVERY_S, _OVER_S = 80.0, 8.0, 20.0  # compared flight, interval of starts, length of a rollout [s]
_PERIODS = (9.0, 12.0, 16.0, 20.0, 26.0)  # NAVL1_PERIOD tried if not received [s]
_LAGS = (0.4, 0.8, 1.4)  # tried bank lags [s]
_SPEED_S = 20.0  # window of the mean airspeed [s]
_SLOWEST = 5.0  # minimum airspeed of fixed-wing flight [m/s]
CRUISE = CRUISE_OF["arduplane"]
_RIDGE = 5.0  # prior standard deviation of the wind [m/s]


@dataclass(frozen=True)
class Grey:
    """Identified guidance period [s], bank lag [s], mean error over 20 s [m] and its number of starts."""

    period: float = 0.0  # 0: from the parameters
    tau_phi: float = 0.8
    miss: float = float("nan")
    starts: int = 0

    @property
    def identified(self) -> dict[str, float]:
        """Return the identified parameters by autopilot name."""
        return {"NAVL1_PERIOD": self.period} if self.period > 0 else {}


@dataclass(frozen=True)
class Board:
    """Route and parameters of the autopilot, and wind."""

    items: tuple[Item, ...]
    params: dict[str, float]
    since: float
    origin: Origin
    wind: np.ndarray | None  # NED, (3,) [m/s]; None: no airspeed received
    instead: Instead | None = None  # what-if query, from the start on
    first: int = 1  # number of the first mission item to fly


@dataclass(frozen=True)
class Ahead:
    """Rollout, or the reason why there is none."""

    path: np.ndarray | None
    seq: int
    sentence: str
    law: Control | None = None


def air_of(track: Track, wind: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Return wind (2,) and mean true airspeed [m/s].

    Without a wind, |v - w|^2 = V^2 is linear in w and V^2 - w^2: |v|^2 = 2 v.w + (V^2 - |w|^2).
    """
    v = track.v[track.ok][-int(120 / STEP) :: 5, :2]
    if wind is not None:
        w = np.asarray(wind[:2], float)
    else:
        A = np.column_stack([2 * v, np.ones(len(v))])
        spread = 2.0 * max(float(np.mean(np.hypot(*v.T))), 5.0)  # a gust of 1 m/s in |v|^2
        ridge = np.diag([(spread / _RIDGE) ** 2, (spread / _RIDGE) ** 2, 1e-9])
        middle = np.array([0.0, 0.0, np.mean(np.sum(v * v, axis=1))])
        w = np.linalg.solve(A.T @ A + ridge, A.T @ (np.sum(v * v, axis=1)) + ridge @ middle)[:2]
        w = w * min(1.0, 15.0 / max(float(np.hypot(*w)), 1e-6))
    recent = track.v[track.ok][-int(_SPEED_S / STEP) :]
    return w, float(np.mean(np.linalg.norm(recent - [*w, 0.0], axis=1)))


def fly(track: Track, seq: np.ndarray, board: Board, grey: Grey, ahead: np.ndarray) -> Ahead:
    """Predict the flight along the route from the end of the track.

    Args:
        track: newest flight
        seq: current mission item of each row, nan if unknown, (n,)
        config, model: configuration of the autopilot, and the identified model
        ahead: requested look-ahead times, (k,) [s]
    """
    first = max(int(np.searchsorted(track.t, board.since)), len(track) - int(_SYNC_S / STEP))
    bad = np.flatnonzero(~track.ok | ~np.isfinite(seq))
    first = max(first, int(bad[-1]) + 1 if len(bad) else 0)
    if len(track) - first < LEAST_S / STEP:
        reported = len(track) and np.isfinite(seq[-1])
        why = f"{below(max(len(track) - first, 0) * STEP, LEAST_S)} s on this route, {LEAST_S:.0f} s are needed; wait"
        return Ahead(None, -1, why if reported else "the current mission item is not reported (MISSION_CURRENT)")
    seen = track.part(first, len(track))
    return _fly(seen, seq[first:].astype(np.int64), board, grey, ahead)


def _fly(seen: Track, seq: np.ndarray, board: Board, grey: Grey, ahead: np.ndarray) -> Ahead:
    law_now = on_wings(board.params, grey.identified, sentence=law.LAW)
    par = law_now.par(_altitude(seen, board))
    way = unrolled(board.items, int(seq[0]), board.origin, board.params, board.first)
    if not len(way.legs):
        return Ahead(None, int(seq[-1]), way.said or "the mission has no legs to fly")
    w, V = air_of(seen, board.wind)
    if V < _SLOWEST or np.linalg.norm(seen.v[-1] - [*w, 0.0]) < _SLOWEST:
        return Ahead(None, int(seq[-1]), "too slow to fly on wings")
    start = way.start if np.isfinite(way.start).all() else seen.p[0]
    ctl = _synchronised(seen, seq, (par, way.legs, start), w)
    lags = _lags(seen, way.legs[int(ctl[arduplane.LEG])], par, law_now.absent, (grey, V))
    flown = _Course(ctl, par, way, lags, law_now)
    if board.instead is not None:
        flown = _otherwise(flown, seen, board, grey, board.instead)
    if not len(flown.way.legs):
        return Ahead(None, int(seq[-1]), flown.way.said or "the mission has no legs to fly")
    if int(flown.way.legs[int(flown.ctl[arduplane.LEG]), KIND]) == TAKEOFF:
        return Ahead(None, int(seq[-1]), "take-off is not modelled: no route-aware prediction")
    state, out = _state(seen, w), np.empty((int(ahead[-1] / STEP) + 2, 3))
    if board.instead is not None and board.instead.speed is not None:
        state[3] = board.instead.speed
    law.follow(flown.ctl, flown.par, flown.way.legs, flown.lags, state, w, STEP, out)
    path = straight(ahead, STEP * np.arange(len(out)), out)
    seq_now = int(seq[-1]) if board.instead is None else board.instead.seq
    return Ahead(path, seq_now, flown.way.said, flown.law)


@dataclass(frozen=True)
class _Course:
    """State and parameters of the guidance, route, lags and controller."""

    ctl: np.ndarray
    par: np.ndarray
    way: Route
    lags: np.ndarray
    law: Control


def _altitude(seen: Track, board: Board) -> float:
    return board.origin.alt_mm * 1e-3 - float(seen.p[-1, 2])


def _otherwise(now: _Course, seen: Track, board: Board, grey: Grey, instead: Instead) -> _Course:
    """Transfer the synchronised guidance to a what-if query; its lags and speed ratio stay."""
    control = on_wings(board.params, grey.identified, instead.asked, sentence=law.LAW)
    way, par, lags = instead.way(board.origin, board.params), control.par(_altitude(seen, board)), now.lags.copy()
    if CRUISE in instead.asked:
        lags[law.CRUISE] = par[P.VA_CRUISE] * lags[law.SHARE]
    ctl = now.ctl
    if len(way.legs):
        ctl = gone_over(ctl, now.way.legs, par, way.legs, (instead.anew, seen.p[-1]))
    return _Course(ctl, par, way, lags, control)


def _synchronised(seen: Track, seq: np.ndarray, way: tuple[np.ndarray, ...], w: np.ndarray) -> np.ndarray:
    """Synchronise the guidance with the flight."""
    n = len(seen)
    nil = np.full(n, np.nan)
    air = seen.v - [*w, 0.0]
    psi = np.arctan2(air[:, 1], air[:, 0])
    euler = np.column_stack([_banks(seen, air), 0.0 * psi, psi])
    triple, quad = np.full((n, 3), np.nan), np.full((n, 4), np.nan)
    rows = (seen.t - seen.t[0], seen.p, seen.v, euler, triple, nil, nil, nil, quad, seq)
    ctl, _ = shadow(*way, *(np.ascontiguousarray(row) for row in rows))  # type: ignore[call-arg]
    return ctl


def _banks(seen: Track, air: np.ndarray) -> np.ndarray:
    """Return the bank at each row: reported, else from the turn rate of the track [rad]."""
    course = np.unwrap(np.arctan2(air[:, 1], air[:, 0]))
    rate = np.gradient(course, STEP)
    smooth = np.convolve(np.pad(rate, 5, mode="edge"), np.ones(11) / 11, mode="valid")
    turn = np.arctan(np.clip(smooth * np.linalg.norm(air[:, :2], axis=1) / G, -1.5, 1.5))
    return np.where(np.isfinite(seen.euler[:, 0]), seen.euler[:, 0], turn)


def _state(seen: Track, w: np.ndarray) -> np.ndarray:
    air = seen.v[-5:].mean(axis=0) - [*w, 0.0]
    phi = float(_banks(seen.part(max(len(seen) - 40, 0), len(seen)), seen.v[-40:] - [*w, 0.0])[-3:].mean())
    return np.array([*seen.p[-1], np.linalg.norm(air), phi, atan2(air[1], air[0]), -air[2]])


def _lags(
    seen: Track, leg: np.ndarray, par: np.ndarray, absent: tuple[str, ...], told: tuple[Grey, float]
) -> np.ndarray:
    """Return the parameters of the law: lags and recent speeds."""
    grey, V = told
    known = CRUISE not in absent
    commanded = leg[VA_C] if leg[VA_C] > 0 else par[P.VA_CRUISE] if known else 0.0
    share = V / commanded if commanded > 0 and 0.7 < V / commanded < 1.5 else par[P.EAS2TAS]
    cruise = par[P.VA_CRUISE] * share if known else V
    out = np.empty(law.N_PAR)
    out[law.TAU_PHI], out[law.TAU_V], out[law.TAU_H], out[law.TAU_CLIMB] = grey.tau_phi, 4.0, 4.0, 1.5
    out[law.CRUISE], out[law.SHARE] = (V if not 0.7 < V / cruise < 1.5 else cruise), share
    rise = -seen.v[:, 2]
    out[law.CLIMB] = max(float(np.quantile(rise, 0.98)), min(par[P.CLIMB_MAX], 2.5))
    out[law.SINK] = max(float(np.quantile(-rise, 0.98)), min(par[P.SINK_MAX], 2.0))
    return out


def compare(track: Track, seq: np.ndarray, board: Board, grey: Grey) -> Grey:
    """Fit period and lag: minimise the mean rollout error from several starts over the last minute."""
    over = int(_OVER_S / STEP)
    last = len(track) - 1 - over
    rows = range(last, max(len(track) - int(_BACK_S / STEP), int(LEAST_S / STEP)), -int(_EVERY_S / STEP))
    starts = [k for k in rows if track.t[k] > board.since + LEAST_S and track.ok[k - 40 : k + over].all()]
    if len(starts) < 3:
        return grey

    def miss(one: Grey) -> float:
        found = [_strays(track, k, seq, board, one) for k in starts]
        good = [x for x in found if x is not None]
        return float(np.mean(good)) if len(good) >= 2 else np.inf

    _, absent = arduplane.parameters(board.params)
    unknown = "NAVL1_PERIOD" in absent
    for name, tried in (("period", _PERIODS if unknown else ()), ("tau_phi", _LAGS)):
        options = [replace(grey, **{name: value}) for value in dict.fromkeys((getattr(grey, name), *tried))]
        grey = min(options, key=miss)
    found = miss(grey)
    return replace(grey, miss=found, starts=len(starts)) if np.isfinite(found) else grey


def _strays(track: Track, k: int, seq: np.ndarray, board: Board, grey: Grey) -> float | None:
    ahead = np.arange(0.0, _OVER_S + 0.5)
    begin = max(k - int(30 / STEP), 0)
    made = fly(track.part(begin, k + 1), seq[begin : k + 1], board, grey, ahead)
    if made.path is None:
        return None
    flown = track.p[k + np.rint(ahead / STEP).astype(int)]
    return float(np.linalg.norm(made.path - flown, axis=1).mean())


def said(grey: Grey) -> str:
    """Describe the model and its error."""
    if not grey.starts:
        return "route flown by guidance and lags, not yet compared with flight"
    period = f"L1 period {grey.period:.0f} s, " if grey.period else ""
    return f"route flown by guidance and lags: {period}mean error {grey.miss:.0f} m over {_OVER_S:.0f} s"
