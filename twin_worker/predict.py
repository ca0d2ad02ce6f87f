"""Fly the twin ahead of the aircraft: synchronise the controller twin on telemetry, then simulate the route.

Source: Huang 2021, section 3.4 (identical controller, same route, identified model in the loop).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fleet.autopilots import arduplane
from fleet.contract import Item
from fleet.frames import Origin
from fleet.mission import LAND, TAKEOFF, route
from fleet.simulate import N_STATE, simulate
from fleet.window import INPUTS, STATES, Window
from twin_worker.history import History
from twin_worker.identify import Axis
from twin_worker.wind import WindFilter

SHADOW_S = 60.0  # telemetry the controller twin is synchronised on [s]
SETTLE_S = 40.0  # telemetry whose mean the model must meet [s]
_SHADOW_STEP = 2  # window rows per shadow step
_REFUSED = {TAKEOFF: "take-off", LAND: "landing"}


@dataclass(frozen=True)
class Flown:
    """One simulated flight ahead, or why there is none.

    Attributes:
        path: position at each wanted look-ahead time, NED, (k, 3) [m]; None where the twin cannot fly this
        seq: mission item it starts on
        replay_rms: how well the controller twin met the reported bank command on telemetry [rad]
        sentence: what limits it, or empty
    """

    path: np.ndarray | None
    seq: int
    replay_rms: float
    sentence: str


@dataclass(frozen=True)
class Onboard:
    """What is known of the autopilot: its route and its parameters."""

    items: tuple[Item, ...]
    params: Mapping[str, float]
    since: float  # when route, mode and parameters last changed [s since 1970]


def held(t: np.ndarray, x: np.ndarray, at: np.ndarray, longest: float) -> np.ndarray:
    """Hold each row until the next, nan before the first and after `longest` seconds, (len(at), k)."""
    if not len(t):
        return np.full((len(at), x.shape[1]), np.nan)
    k = np.searchsorted(t, at, side="right") - 1
    out = x[np.clip(k, 0, None)].astype(float)
    out[(k < 0) | (at - t[np.clip(k, 0, None)] > longest)] = np.nan
    return out


def fly_ahead(
    window: Window,
    history: History,
    onboard: Onboard,
    axes: tuple[Axis, Axis],
    wind: WindFilter,
    origin: Origin,
    ahead: np.ndarray,
) -> Flown:
    """Predict with the identified linear model and the controller twin in closed loop (`--method paper`).

    Args:
        window: newest telemetry on the grid, at least `SHADOW_S` where there is as much
        history: telemetry as it came
        onboard: route and parameters in force
        axes: longitudinal and lateral model
        wind: wind filter, up to date
        origin: origin of the twin's NED frame
        ahead: wanted look-ahead times from the window's end, rising, (k,) [s]
    """
    rows = slice(max(int(np.searchsorted(window.t, onboard.since)), len(window) - int(SHADOW_S / window.dt)), None)
    good = window.part(rows.start, len(window))
    good = good.part(_last_break(good.ok), len(good))
    if len(good) < 5.0 / window.dt:
        return Flown(None, -1, np.nan, f"{good.seconds if len(good) > 1 else 0:.0f} s on this route; 5 s are needed")
    at = good.t[(len(good) - 1) % _SHADOW_STEP :: _SHADOW_STEP]
    seq = held(*history.rows("leg"), at, 15.0)[:, 0]
    if not np.isfinite(seq[-1]):
        return Flown(None, -1, np.nan, "the mission item in force is not reported (MISSION_CURRENT)")
    seq = np.where(np.isfinite(seq), seq, seq[np.isfinite(seq)][0]).astype(np.int64)
    altitude = origin.alt_mm * 1e-3 - float(good.p[-1, 2])
    par, absent = arduplane.parameters(onboard.params, altitude)
    way = route(onboard.items, seq=int(seq[0]), origin=origin, params=onboard.params)
    if not len(way.legs):
        return Flown(None, int(seq[-1]), np.nan, " ".join(way.sentences) or "the mission has no legs to fly")
    ctl, rms = _synchronise(good, at, history, way, par, seq)
    leg = way.legs[int(ctl[arduplane.LEG])]
    if int(leg[0]) in _REFUSED:
        return Flown(None, int(seq[-1]), rms, f"{_REFUSED[int(leg[0])]} is not modelled: no route-aware prediction")
    out = np.empty((int(ahead[-1] / good.dt) + 2, N_STATE))
    done = _simulate(good, history, axes, wind, (ctl, par, way.legs), out)
    if done <= ahead[-1] / good.dt:
        return Flown(None, int(seq[-1]), rms, f"the twin leaves its flight envelope {done * good.dt:.0f} s ahead")
    t = good.dt * np.arange(done)
    path = np.column_stack([np.interp(ahead, t, column) for column in out[:done, :3].T])
    said = list(way.sentences)
    if absent:
        said.append(f"{len(absent)} autopilot parameters not received, defaults assumed ({', '.join(absent[:3])} …)")
    return Flown(path, int(seq[-1]), rms, " ".join(said))


def _last_break(ok: np.ndarray) -> int:
    """Give the first row after the last unmeasured one, never past the end."""
    bad = np.flatnonzero(~ok)
    return min(int(bad[-1]) + 1, len(ok) - 1) if len(bad) else 0


def _synchronise(good: Window, at: np.ndarray, history: History, way, par, seq) -> tuple[np.ndarray, float]:  # type: ignore[no-untyped-def]
    """Run the controller twin over telemetry, so that its integrators and leg are those of the aircraft."""
    k = np.searchsorted(good.t, at)
    command = held(*history.rows("command"), at, 1.0)
    Va = held(*history.rows("air"), at, 1.0)[:, 0]
    start = way.start if np.isfinite(way.start).all() else good.p[0]
    x = good.x[k]
    euler = x[:, [STATES.index(name) for name in ("phi", "theta", "psi")]].copy()
    euler[:, 2] = (euler[:, 2] + np.pi) % (2 * np.pi) - np.pi
    rates = x[:, [STATES.index(name) for name in "pqr"]]
    rows = (good.p[k], good.v[k], euler, rates, Va, command[:, 0], command[:, 1], good.u[k], seq)
    flat = [np.ascontiguousarray(row, dtype=row.dtype if row.dtype == np.int64 else float) for row in rows]
    ctl, rms = arduplane.shadow(par, way.legs, np.asarray(start, float), at - at[0], *flat)
    return ctl, float(rms)


def _simulate(good: Window, history: History, axes, wind: WindFilter, controller, out: np.ndarray) -> int:  # type: ignore[no-untyped-def]
    lon, lat = axes
    now = slice(max(len(good) - 3, 0), None)
    state = np.concatenate([good.p[-1], good.x[now].mean(axis=0)])
    state[9:] = good.x[-1, 6:]
    command = held(*history.rows("command"), good.t[-1:], 1.0)[0, :2]
    command = np.where(np.isfinite(command), command, good.x[-1, 6:8])
    air = np.array([*wind.wind[:2], wind.scale])
    assert INPUTS[3] == "delta_t"
    matrices = []
    for axis in (lon, lat):
        matrices += [_settled(axis, good), np.concatenate([axis.y_mean, axis.u_mean])]
    return int(simulate(*controller, *matrices, state, command, air, good.dt, out))


def _settled(axis: Axis, good: Window) -> np.ndarray:
    """Give the model's [A B c] with c moved by its mean one-step miss of late, so that it starts without drift."""
    recent = good.part(max(len(good) - int(SETTLE_S / good.dt), 0), len(good))
    D = axis.physical()
    y = recent.columns(axis.states) - axis.y_mean
    z = np.column_stack([y, recent.columns(axis.inputs) - axis.u_mean, np.ones(len(y))])
    D[:, -1] += (y[1:] - z[:-1] @ D.T).mean(axis=0)
    return D
