"""Closed-loop prediction: synchronise the controller twin with telemetry, then simulate the route.

Source: Huang 2021, section 3.4 (identical controller, same route, identified model in the loop).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numba as nb
import numpy as np

from fleet.autopilots import arduplane, laws
from fleet.autopilots.shadow import shadow
from fleet.contract import Item
from fleet.frames import Origin, wrap
from fleet.mission import FIRST, KIND, LAND, P_D, P_N, READ, SPEED, TAKEOFF, Route, route
from fleet.physics.simulate import N_STATE, simulate
from fleet.process.sanitise import below
from fleet.window import Window
from twin_worker.estimation.airspeed_setpoint import aimed_at, as_told, held_to
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.plant import Plant, acting, settled
from twin_worker.numerics.interpolation import straight
from twin_worker.prediction.autopilot_parameters import CRUISE_OF, Control, on_wings
from twin_worker.prediction.route_override import Instead, gone_over
from twin_worker.telemetry.history import History

LEAST_AHEAD_S = 60.0  # shortest valid rollout [s]
SHADOW_S = 60.0  # telemetry for the synchronisation of the controller twin [s]
_WIND_S = 10.0  # maximum age of the autopilot's wind estimate [s]
_SHADOW_STEP = 2  # window rows per shadow step
_ROUTES = 1024  # cached routes: missions change rarely, and a route takes as long as a rollout
_REFUSED = {TAKEOFF: "take-off", LAND: "landing"}


@dataclass(frozen=True)
class Flown:
    """Simulated flight ahead, or the reason why there is none.

    Attributes:
        path: position at each requested look-ahead time, NED, (k, 3) [m]; None without a prediction
        seq: mission item at the start
        sentence: limitations or reason, or empty
        diverged: the twin left its flight envelope
        controller: the controller twin
    """

    path: np.ndarray | None
    seq: int
    sentence: str
    diverged: bool = False
    law: Control | None = None


@dataclass(frozen=True)
class Start:
    """Start of rollouts of any model.

    Attributes:
        window: flight on the present route
        synchronised: synchronised state, parameters and legs of the controller twin
        state: state, current commands and inputs, and air, as for `fleet.physics.simulate`
        seq: current mission item
        sentence: limitations, or empty
        controller: the controller twin
    """

    good: Window
    control: tuple[np.ndarray, np.ndarray, np.ndarray]
    state: tuple[np.ndarray, np.ndarray, np.ndarray]
    seq: int
    sentence: str
    law: Control


@dataclass(frozen=True)
class Onboard:
    """Route and parameters of the autopilot."""

    items: tuple[Item, ...]
    params: Mapping[str, float]  # received
    since: float  # when route, mode and parameters last changed [s since 1970]
    identified: Mapping[str, float] = field(default_factory=dict)  # from flight; used if not received
    instead: Instead | None = None  # what-if query, from the start on
    autopilot: str = "ardupilot"  # reported type
    law: str = "arduplane"  # name in `laws.LAWS`; empty: unknown
    why: str = ""  # how the law was selected, or why none is


@dataclass(frozen=True)
class Heard:
    """Telemetry on the present route for the replay of a control law.

    Attributes:
        window: telemetry without gaps
        legs, start_point: route from the first current item, and the point before
        rows: t p v euler rates Va phi_c theta_c delta, as for `shadow`
        seq: current mission item of each row
        altitude_m: final height above mean sea level [m]
        sentence: problems of the route, or empty
    """

    good: Window
    legs: np.ndarray
    start: np.ndarray
    rows: tuple[np.ndarray, ...]
    seq: np.ndarray
    altitude_m: float
    sentence: str

    @property
    def t(self) -> np.ndarray:
        """Return times since the first row, (n,) [s]."""
        return self.rows[0]

    @property
    def p(self) -> np.ndarray:
        """Return positions, NED, (n, 3) [m]."""
        return self.rows[1]

    @property
    def Va(self) -> np.ndarray:
        """Return reported airspeeds, (n,) [m/s]."""
        return self.rows[5]

    @property
    def phi_c(self) -> np.ndarray:
        """Return the commanded banks, (n,) [rad]."""
        return self.rows[6]


@dataclass(frozen=True)
class Situation:
    """Inputs of a prediction.

    Attributes:
        window: newest resampled telemetry, at least `SHADOW_S` if available
        history: telemetry as received
        onboard: active route and parameters
        wind_filter: current wind filter
        origin: origin of the twin's NED frame
    """

    window: Window
    history: History
    onboard: Onboard
    wind: WindFilter
    origin: Origin


def held(t: np.ndarray, x: np.ndarray, at: np.ndarray, longest: float) -> np.ndarray:
    """Sample rows with zero-order hold, nan before the first and after `max_age` seconds, (len(query_t), k)."""
    if not len(t):
        return np.full((len(at), x.shape[1]), np.nan)
    out = np.empty((len(at), x.shape[1]))
    _hold(t, x, np.ascontiguousarray(at), longest, out)
    return out


@nb.njit(cache=True, nogil=True)
def _hold(t: np.ndarray, x: np.ndarray, at: np.ndarray, longest: float, out: np.ndarray) -> None:
    """Compute the last row before each of the rising times, nan if there is none or it is too old, (k, m)."""
    k = -1
    for i in range(len(at)):
        while k + 1 < len(t) and t[k + 1] <= at[i]:
            k += 1
        known = k >= 0 and not at[i] - t[k] > longest
        for j in range(x.shape[1]):
            out[i, j] = x[k, j] if known else np.nan


def _reported(history: History, name: str, at: np.ndarray, longest: float) -> np.ndarray:
    """Return the last reported row at each time, nan after `max_age` seconds, (len(query_t), k)."""
    return held(*history.look(name, at[0] - longest - 1.0), at, longest)


def fly_ahead(now: Situation, plant: Plant, ahead: np.ndarray) -> Flown:
    """Predict with the identified model and the controller twin in closed loop.

    Args:
        context: inputs; the prediction starts at the end of its window
        plant: derivatives model, or longitudinal and lateral linear axes
        ahead: requested look-ahead times, rising, (k,) [s]
    """
    start = set_out(now)
    return start if isinstance(start, Flown) else fly_from(start, plant, ahead)


def heard(now: Situation) -> Heard | Flown:
    """Return the replay data of the present route, or the reason why there are none."""
    good = _on_this_route(now.window, now.onboard.since)
    if len(good) < 5.0 / good.dt:
        return Flown(None, -1, f"{below(good.seconds, 5.0)} s on this route, 5 s are needed; wait")
    every = slice((len(good) - 1) % _SHADOW_STEP, None, _SHADOW_STEP)
    at = good.t[every]
    seq = _reported(now.history, "leg", at, 15.0)[:, 0]
    if not np.isfinite(seq[-1]):
        return Flown(None, -1, "the current mission item is not reported (MISSION_CURRENT)")
    seq = np.where(np.isfinite(seq), seq, seq[np.isfinite(seq)][0]).astype(np.int64)
    board = now.onboard
    first = FIRST.get(board.autopilot, 1)
    way = unrolled(board.items, int(seq[0]), now.origin, board.params, first)
    said = way.said
    if not len(way.legs):
        return Flown(None, int(seq[-1]), said or "the mission has no legs to fly")
    start = way.start if np.isfinite(way.start).all() else good.p[0]
    altitude = now.origin.alt_mm * 1e-3 - float(good.p[-1, 2])
    return Heard(good, way.legs, start, _telemetry(good, every, now.history), seq, altitude, said)


def unrolled(items: tuple[Item, ...], seq: int, origin: Origin, params: Mapping[str, float], first: int) -> Route:
    """Return the cached, read-only result of `fleet.mission.route`: legs from item `seq` on."""
    return _unrolled(items, seq, origin, tuple((name, params[name]) for name in READ if name in params), first)


@lru_cache(maxsize=_ROUTES)
def _unrolled(
    items: tuple[Item, ...], seq: int, origin: Origin, params: tuple[tuple[str, float], ...], first: int
) -> Route:
    return route(items, seq=seq, origin=origin, params=dict(params), first=first)


def known_wind(now: Situation, good: Window) -> tuple[float, float]:
    """Return the wind estimate of the autopilot if reported, else of the twin, NED [m/s]."""
    reported = _reported(now.history, "wind", good.t[-1:], _WIND_S)[0]
    w_n, w_e = reported if np.isfinite(reported).all() else now.wind.wind[:2]
    return float(w_n), float(w_e)


def set_out(now: Situation) -> Start | Flown:
    """Synchronise the controller twin with telemetry; return the start of rollouts, or why there is none."""
    seen, board = heard(now), now.onboard
    if isinstance(seen, Flown):
        return seen
    seq = int(seen.seq[-1])
    if not board.law:
        return Flown(None, seq, board.why or "the control law is not known yet")
    law = on_wings(board.params, board.identified, law=board.law)
    par = laws.blown(law.par(seen.altitude_m), *known_wind(now, seen.good))
    told = _aimed(now, float(seen.good.t[-1]), float(law.values[CRUISE_OF[board.law]]))
    legs = as_told(seen.legs, float(seq), float(law.values[CRUISE_OF[board.law]]), told)
    ctl, _ = shadow(par, legs, seen.start, *seen.rows, seen.seq)  # type: ignore[call-arg]
    said = " ".join(filter(None, (board.why, seen.sentence)))
    begun = Start(seen.good, (ctl, par, legs), _start(now, seen.good), seq, said, law)
    if board.instead is not None:
        begun = _otherwise(now, begun, board.instead, told)
    return _refused(begun) or replace(begun, sentence=" ".join(filter(None, (begun.sentence, _assumed(begun.law)))))


def _aimed(now: Situation, t: float, cruise: float) -> float:
    """Return the airspeed set-point: reported, else the flown one of the mission speeds; nan if unknown [m/s]."""
    told = aimed_at(now.history, t)
    if np.isfinite(told):
        return told
    named = {item.param2 for item in now.onboard.items if item.command == SPEED and 0 < item.param2 < np.inf}
    return held_to(now.history, t, np.array(sorted(named | {cruise}))) if named else told


def _altitude(now: Situation, good: Window) -> float:
    return now.origin.alt_mm * 1e-3 - float(good.p[-1, 2])


def _otherwise(now: Situation, begun: Start, instead: Instead, told: float) -> Start:
    """Transfer the synchronised controller to a what-if query; `setpoint`: airspeed set-point so far [m/s]."""
    name = now.onboard.law
    law, cruise = on_wings(now.onboard.params, now.onboard.identified, instead.asked, name), CRUISE_OF[name]
    way = instead.way(now.origin, now.onboard.params)
    par = laws.blown(law.par(_altitude(now, begun.good)), *known_wind(now, begun.good))
    legs, (ctl, _, before) = way.legs, begun.control
    if len(legs):
        aimed = np.nan if cruise in instead.asked else told
        legs = as_told(legs, float(instead.seq), float(law.values[cruise]), aimed)
        ctl = gone_over(ctl, before, par, legs, (instead.anew, begun.good.p[-1]))
    state = begun.state[0].copy()
    state[3:6] = instead.at_speed(state[3:6])
    said = way.said
    begun = replace(begun, state=(state, *begun.state[1:]), control=(ctl, par, legs))
    return replace(begun, seq=instead.seq, sentence=said, law=law)


def _refused(begun: Start) -> Flown | None:
    """Return the reason why the current leg is not modelled; None if it is."""
    ctl, _, legs = begun.control
    if not len(legs):
        return Flown(None, begun.seq, begun.sentence or "the mission has no legs to fly")
    kind = int(legs[int(ctl[arduplane.LEG]), KIND])
    if kind not in _REFUSED:
        return None
    return Flown(None, begun.seq, f"{_REFUSED[kind]} is not modelled: no route-aware prediction")


def _assumed(law: Control) -> str:
    """Describe the parameters that are assumed at their defaults; empty if there are none."""
    absent = law.absent
    few = f"({', '.join(absent[:3])} …)"
    return f"{len(absent)} autopilot parameters not received, defaults assumed {few}" if absent else ""


def fly_from(start: Start, plant: Plant, ahead: np.ndarray) -> Flown:
    """Simulate one model from the start; arguments as for `fly_ahead`. The path is nan beyond the envelope."""
    ctl, par, legs = start.control
    dt = start.good.dt
    out = np.empty((int(ahead[-1] / dt) + 2, N_STATE))
    ctl = ctl.copy()
    done = simulate(ctl, par, legs, settled(plant, start.good), *start.state, dt, out)
    return at_times(out[:done, :3], dt, start, ctl, ahead)


def at_times(p: np.ndarray, step: float, start: Start, ctl: np.ndarray, ahead: np.ndarray) -> Flown:
    """Sample a rollout at the look-ahead times: nan beyond its end, constant position after touchdown.

    Args:
        p: positions every `step` [s] until the twin left its envelope, NED, (n, 3) [m], changed in place
        initial: start of the rollout
        ctl: final controller state
        ahead: requested look-ahead times, rising, (k,) [s]
    """
    landed = _stay_down(p, ctl, start.control[2])
    if not landed and len(p) <= min(ahead[-1], ahead[0] + LEAST_AHEAD_S) / step:
        return Flown(None, start.seq, f"the twin leaves its envelope {len(p) * step:.0f} s ahead", True)
    t, beyond = step * np.arange(len(p)), None if landed else np.nan
    path = straight(ahead, t, p, beyond)
    return Flown(path, start.seq, start.sentence, law=start.law)


def _stay_down(p: np.ndarray, ctl: np.ndarray, legs: np.ndarray) -> bool:
    """Fix positions, NED (n, 3) [m], after touchdown at the end of the route; return whether it is reached."""
    at = int(ctl[arduplane.LEG])
    if not len(p) or int(legs[at, KIND]) != LAND:
        return False
    begin = ctl[arduplane.FROM][:2]
    line = legs[at, P_N:P_D] - begin
    short = np.flatnonzero((p[:, :2] - begin) @ line < line @ line)
    down = int(short[-1]) + 1 if len(short) else 0
    p[down:] = p[min(down, len(p) - 1)]
    return down < len(p)


def _on_this_route(window: Window, since: float) -> Window:
    """Return the gap-free flight on the present route, at most `SHADOW_S`."""
    start = max(int(np.searchsorted(window.t, since)), len(window) - int(SHADOW_S / window.dt))
    bad = np.flatnonzero(~window.ok)
    start = max(start, int(bad[-1]) + 1 if len(bad) else 0)
    return window.part(min(start, len(window) - 2), len(window))


def _telemetry(good: Window, every: slice, history: History) -> tuple[np.ndarray, ...]:
    """Return the synchronisation data at some rows: t p v euler rates Va phi_c theta_c delta."""
    at = good.t[every]
    command, Va = _reported(history, "command", at, 1.0), _reported(history, "air", at, 1.0)[:, 0]
    euler, rates = good.x[every, 6:9].copy(), good.x[every, 3:6]
    euler[:, 2] = wrap(euler[:, 2])
    rows = (at - at[0], good.p[every], good.v[every], euler, rates, Va, command[:, 0], command[:, 1], good.u[every])
    return tuple(np.ascontiguousarray(row) for row in rows)


def _start(now: Situation, good: Window) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return state (12,), current commands and inputs (6,) and air (4,) at the end of the window."""
    state = np.concatenate([good.p[-1], good.x[-3:, :6].mean(axis=0), good.x[-1, 6:]])
    command = _reported(now.history, "command", good.t[-1:], 1.0)[0, :2]
    command = np.where(np.isfinite(command), command, good.x[-1, 6:8])
    command = np.concatenate([command, acting(good)])
    return state, command, np.array([*now.wind.wind[:2], now.wind.scale, _gust(now, good)])


def _gust(now: Situation, good: Window) -> float:
    """Return the airspeed minus the airspeed by mean wind [m/s]; 0 without an airspeed sensor."""
    t, air = now.history.look("air", good.t[-1] - 1.0)
    recent = air[t <= good.t[-1], 0]
    if not len(recent) or recent.min() < 3.0:
        return 0.0
    n = int(1.0 / good.dt)
    return float(recent.mean() * now.wind.scale - np.linalg.norm(good.x[-n:, :3], axis=1).mean())
