"""A plant: the identified model of one aircraft, coupled or two linear axes, behind one door."""

import numpy as np

from fleet.physics.actuators import TAU, lagged
from fleet.physics.dynamics import rates_of_change
from fleet.physics.wrench import OFFSETS, WIND
from fleet.simulate import coupled_plant, linear_plant
from fleet.window import INPUTS, STATES, Window
from twin_worker.coupled import Coupled, states
from twin_worker.identify import Axis
from twin_worker.output_error import LINE
from twin_worker.refine import free_run

DYNAMICS, PAPER = "dynamics", "paper"  # coupled, two linear axes
Plant = Coupled | tuple[Axis, Axis]

SETTLE_S = 40.0  # telemetry whose mean the model must meet [s]
_EVERY = 5  # rows between those it is held against
_DRIVEN = np.array([0, 2, 4, 1, 3, 5])  # state each offset drives, in the order of `OFFSETS`


def method(plant: Plant) -> str:
    """Name the kind of model."""
    return DYNAMICS if isinstance(plant, Coupled) else PAPER


def finite(plant: Plant) -> bool:
    """Tell whether every number of it is finite."""
    parts = (plant.par,) if isinstance(plant, Coupled) else [axis.D for axis in plant]
    return all(bool(np.isfinite(part).all()) for part in parts)


def measured(plant: Plant, window: Window) -> np.ndarray:
    """Give the states as this kind of model has them, (n, 9): u v w over the ground, or through the air."""
    return states(window) if isinstance(plant, Coupled) else window.x


def runs(plant: Plant, window: Window, start: int, length: int) -> np.ndarray:
    """Run free from a fresh start every `length` rows of window[start:]; nan where a run crosses unmeasured rows.

    Args:
        plant: the model
        window: flight; what lies before `start` settles lags and start states
        start: first row to predict
        length: rows of a run
    Returns:
        states, as `measured` has them, (len(window) - start, 9)
    """
    begins = np.arange(start, len(window), length)
    stops = np.minimum(begins + length, len(window))
    broken = np.concatenate([[0], np.cumsum(~window.ok)])
    begins = begins[broken[stops] == broken[begins]]
    if isinstance(plant, Coupled):
        y, delta = states(window), lagged(window.u, window.dt, TAU)
        return plant.fly_each(_fresh(y, window.ok, begins), begins, length, delta, window.dt)[start:]
    out = np.full((len(window) - start, len(STATES)), np.nan)
    for axis in plant:
        columns = [STATES.index(name) for name in axis.states]
        y, u = axis.scaled(window)
        for k in begins:
            stop = min(k + length, len(window))
            if stop - k > 1:
                run = np.empty((stop - k, len(columns)))
                free_run(axis.D, y[k], np.ascontiguousarray(u[k:stop]), run)
                out[k - start : stop - start, columns] = run * axis.y_scale + axis.y_mean
    return out


def _fresh(y: np.ndarray, ok: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Read the states at rows off a line through the rows up to each; off that row alone where they are broken."""
    rows = begins[:, None] + np.arange(1 - LINE, 1)
    smooth = np.einsum("l,mlk->mk", _TO_END, y[np.maximum(rows, 0)])
    straight = (rows[:, 0] >= 0) & ok[np.maximum(rows, 0)].all(axis=1)
    return np.where(straight[:, None], smooth, y[begins])


_TO_END = np.linalg.pinv(np.column_stack([np.ones(LINE), np.arange(1 - LINE, 1)]))[0]


def settled(plant: Plant, good: Window) -> tuple:
    """Give the plant as `fleet.simulate` flies it, its offsets moved by its mean miss of late: it starts without drift.

    Args:
        plant: the model
        good: newest telemetry, unbroken
    """
    recent = good.part(max(len(good) - int(SETTLE_S / good.dt), 0), len(good))
    if isinstance(plant, Coupled):
        return coupled_plant(_level(plant, recent), plant.at)
    return linear_plant(*(part for axis in plant for part in (_centred(axis, recent), axis.means)))


def _level(plant: Coupled, recent: Window) -> np.ndarray:
    """Move the six offsets so that the model's mean acceleration is what was flown."""
    par, y = plant.par.copy(), recent.x.copy()
    par[WIND:] = 0.0
    delta = lagged(recent.u, recent.dt, TAU)
    rate, total = np.empty(9), np.zeros(9)
    rows = range(0, len(y), _EVERY)
    for k in rows:
        rates_of_change(y[k], delta[k], par, plant.at, rate)
        total += rate
    n = min(LINE * 4, len(y) // 2)
    flown = (y[-n:].mean(axis=0) - y[:n].mean(axis=0)) / ((len(y) - n) * recent.dt)
    miss = flown - total / len(rows)
    par[list(OFFSETS)] += miss[_DRIVEN]
    return par


def _centred(axis: Axis, recent: Window) -> np.ndarray:
    """Give [A B c] of an axis with c moved by its mean one-step miss."""
    D = axis.physical()
    y = recent.columns(axis.states) - axis.y_mean
    z = np.column_stack([y, recent.columns(axis.inputs) - axis.u_mean, np.ones(len(y))])
    D[:, -1] += (y[1:] - z[:-1] @ D.T).mean(axis=0)
    return D


def acting(good: Window) -> np.ndarray:
    """Give the inputs in force at the end, in the order of `INPUTS`, (4,)."""
    assert good.u.shape[1] == len(INPUTS)
    return lagged(good.u[-50:], good.dt, TAU)[-1]
