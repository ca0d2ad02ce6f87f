"""Plant: the identified model of one aircraft, either a derivatives model or two linear axes."""

import numba as nb
import numpy as np

from fleet.physics.actuators import TAU, lagged
from fleet.physics.dynamics import rates_of_change
from fleet.physics.simulate import coupled_plant, linear_plant
from fleet.physics.wrench import OFFSETS, WIND
from fleet.window import INPUTS, Window
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.output_error import LINE
from twin_worker.identification.linear.linear_model import Axis

DYNAMICS, PAPER = "dynamics", "paper"  # derivatives model, two linear axes
Plant = Coupled | tuple[Axis, Axis]

SETTLE_S = 40.0  # window of the bias correction [s]
_LEAST_S = 4.0  # minimum window [s]
_EVERY = 5  # interval of the evaluated rows
_DRIVEN = np.array([0, 2, 4, 1, 3, 5])  # state that each offset drives, in the order of `OFFSETS`


def method(plant: Plant) -> str:
    """Return the method name of the model."""
    return DYNAMICS if isinstance(plant, Coupled) else PAPER


def finite(plant: Plant) -> bool:
    """Return whether all parameters are finite."""
    parts = (plant.par,) if isinstance(plant, Coupled) else [axis.D for axis in plant]
    return all(bool(np.isfinite(part).all()) for part in parts)


def settled(plant: Plant, good: Window) -> tuple:
    """Return the plant for `fleet.physics.simulate` with its recent mean error removed from the offsets.

    Args:
        plant: the model
        window: newest telemetry, without gaps
    """
    newest = max(len(good) - int(SETTLE_S / good.dt), 0)
    if isinstance(plant, Coupled):  # only the flight that it was identified from
        newest = max(newest, min(int(np.searchsorted(good.t, plant.t0)), len(good) - int(_LEAST_S / good.dt)))
    recent = good.part(newest, len(good))
    if isinstance(plant, Coupled):
        return coupled_plant(_level(plant, recent), plant.at)
    return linear_plant(*(part for axis in plant for part in (_centred(axis, recent), axis.means)))


def _level(plant: Coupled, recent: Window) -> np.ndarray:
    """Correct the six offsets so that the mean acceleration of the model equals the measured one."""
    par, y = plant.par.copy(), np.ascontiguousarray(recent.x)
    par[WIND:] = 0.0
    total = np.zeros(9)
    rows = _add_rates(y, lagged(np.ascontiguousarray(recent.u), recent.dt, TAU), par, plant.at, total)
    n = min(LINE * 4, len(y) // 2)
    flown = (y[-n:].mean(axis=0) - y[:n].mean(axis=0)) / ((len(y) - n) * recent.dt)
    miss = flown - total / rows
    par[list(OFFSETS)] += miss[_DRIVEN]
    return par


@nb.njit(cache=True, nogil=True)
def _add_rates(y: np.ndarray, delta: np.ndarray, par: np.ndarray, at: np.ndarray, total: np.ndarray) -> int:
    """Add x' of every `_ROW_STRIDE`th row to `total`, (9,); return the number of rows."""
    rate, rows = np.empty(9), range(0, len(y), _EVERY)
    for k in rows:
        rates_of_change(y[k], delta[k], par, at, rate)
        total += rate
    return len(rows)


def _centred(axis: Axis, recent: Window) -> np.ndarray:
    """Return [A B c] of an axis with c corrected by the mean one-step error."""
    D = axis.physical()
    y = recent.columns(axis.states) - axis.y_mean
    z = np.column_stack([y, recent.columns(axis.inputs) - axis.u_mean, np.ones(len(y))])
    D[:, -1] += (y[1:] - z[:-1] @ D.T).mean(axis=0)
    return D


def acting(good: Window) -> np.ndarray:
    """Return the actuator states at the end, in the order of `INPUTS`, (4,)."""
    assert good.u.shape[1] == len(INPUTS)
    return lagged(good.u[-50:], good.dt, TAU)[-1]
