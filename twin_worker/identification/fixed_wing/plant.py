"""Plant: the identified model of one aircraft, either a derivatives model or two linear axes."""

import numba as nb
import numpy as np

from fleet.physics.dynamics import rates_of_change
from fleet.physics.simulate import TAU, coupled_plant, lagged, linear_plant
from fleet.physics.wrench import OFFSETS, WIND
from fleet.window import INPUTS, Window
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.output_error import LINE_SAMPLES
from twin_worker.identification.linear.linear_model import AxisModel

DYNAMICS, PAPER = "dynamics", "paper"  # derivatives model, two linear axes
Plant = DerivativesModel | tuple[AxisModel, AxisModel]

BIAS_WINDOW_S = 40.0  # window of the bias correction [s]
_MIN_WINDOW_S = 4.0  # minimum window [s]
_ROW_STRIDE = 5  # interval of the evaluated rows
_DRIVEN_STATE = np.array([0, 2, 4, 1, 3, 5])  # state that each offset drives, in the order of `OFFSETS`


def method(plant: Plant) -> str:
    """Return the method name of the model."""
    return DYNAMICS if isinstance(plant, DerivativesModel) else PAPER


def is_finite(plant: Plant) -> bool:
    """Return whether all parameters are finite."""
    parts = (plant.par,) if isinstance(plant, DerivativesModel) else [axis.D for axis in plant]
    return all(bool(np.isfinite(part).all()) for part in parts)


def bias_corrected(plant: Plant, window: Window) -> tuple:
    """Return the plant for `fleet.physics.simulate` with its recent mean error removed from the offsets.

    Args:
        plant: the model
        window: newest telemetry, without gaps
    """
    first_row = max(len(window) - int(BIAS_WINDOW_S / window.dt), 0)
    if isinstance(plant, DerivativesModel):  # only the flight that it was identified from
        first_row = max(
            first_row, min(int(np.searchsorted(window.t, plant.t0)), len(window) - int(_MIN_WINDOW_S / window.dt))
        )
    recent = window.part(first_row, len(window))
    if isinstance(plant, DerivativesModel):
        return coupled_plant(_correct_offsets(plant, recent), plant.trim_velocity)
    return linear_plant(*(part for axis in plant for part in (_correct_constant(axis, recent), axis.means)))


def _correct_offsets(plant: DerivativesModel, recent: Window) -> np.ndarray:
    """Correct the six offsets so that the mean acceleration of the model equals the measured one."""
    par, y = plant.par.copy(), np.ascontiguousarray(recent.x)
    par[WIND:] = 0.0
    total = np.zeros(9)
    rows = _add_rates(y, lagged(np.ascontiguousarray(recent.u), recent.dt, TAU), par, plant.trim_velocity, total)
    n = min(LINE_SAMPLES * 4, len(y) // 2)
    measured = (y[-n:].mean(axis=0) - y[:n].mean(axis=0)) / ((len(y) - n) * recent.dt)
    error = measured - total / rows
    par[list(OFFSETS)] += error[_DRIVEN_STATE]
    return par


@nb.njit(cache=True, nogil=True)
def _add_rates(y: np.ndarray, delta: np.ndarray, par: np.ndarray, trim_velocity: np.ndarray, total: np.ndarray) -> int:
    """Add x' of every `_ROW_STRIDE`th row to `total`, (9,); return the number of rows."""
    rate, rows = np.empty(9), range(0, len(y), _ROW_STRIDE)
    for k in rows:
        rates_of_change(y[k], delta[k], par, trim_velocity, rate)
        total += rate
    return len(rows)


def _correct_constant(axis: AxisModel, recent: Window) -> np.ndarray:
    """Return [A B c] of an axis with c corrected by the mean one-step error."""
    D = axis.physical()
    y = recent.columns(axis.states) - axis.y_mean
    z = np.column_stack([y, recent.columns(axis.inputs) - axis.u_mean, np.ones(len(y))])
    D[:, -1] += (y[1:] - z[:-1] @ D.T).mean(axis=0)
    return D


def actuator_state(window: Window) -> np.ndarray:
    """Return the actuator states at the end, in the order of `INPUTS`, (4,)."""
    assert window.u.shape[1] == len(INPUTS)
    return lagged(window.u[-50:], window.dt, TAU)[-1]
