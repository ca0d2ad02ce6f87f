"""Free runs of an identified model from an estimated start: state, and constant sensor bias of every output.

Measured angles and velocities carry errors that drift over tens of seconds. A free run from the measured state would
count them as errors of the model; here the state and the bias come from a least-squares fit to the rows before the run
(or, on the data identified on, to the rows of the run, as common identification toolboxes compare model and data).
For the coupled model, the six constant accelerations of its trim are fitted as well, about those identified.

    sum (y - b - y_hat)' N^-1 (y - b - y_hat) 25 / rows + b' Q^-1 b      N, Q: white noise and drift of the sensors

The information of all rows counts as that of one second, because errors of the model are correlated.

Source: Jategaonkar 2015, chapter 4 (initial conditions and bias parameters of output error).
"""

from dataclasses import replace

import numpy as np

from fleet.frames import ned_to_body
from fleet.physics.simulate import TAU, lagged
from fleet.physics.wrench import N_PAR, OFFSETS
from fleet.window import STATES, Window
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.output_error import GROUP, line_fit_start, residuals_and_jacobian
from twin_worker.identification.linear.linear_model import AxisModel
from twin_worker.identification.linear.multiple_shooting import SensorErrors
from twin_worker.identification.linear.prediction_error_method import free_run

# sensor errors of a small UAV's state estimate and of its telemetry: white noise with rounding, and drift
_WHITE = {"u": 0.03, "v": 0.03, "w": 0.03, "p": 0.003, "q": 0.003, "r": 0.003, "phi": 1e-3, "theta": 1e-3, "psi": 1e-3}
_DRIFT = {"u": 0.08, "v": 0.12, "w": 0.12, "p": 1e-3, "q": 1e-3, "r": 1e-3, "phi": 4e-3, "theta": 4e-3, "psi": 4e-3}
_TRIM_SIGMA = np.array([0.1, 0.2, 0.1, 0.1, 0.1, 0.05])  # of X Z M Y L N about the identified [m/s2, rad/s2]
_INFORMATION_S = 1.0  # information of the fitted rows [s]
_FIT_STEPS = 3  # Gauss-Newton steps of the nonlinear fit


def sensor_errors(states: tuple[str, ...], scale: np.ndarray) -> SensorErrors:
    """Return the sensor errors of some states divided by their scale, (n,)."""
    return SensorErrors(*(np.array([table[name] for name in states]) / scale for table in (_WHITE, _DRIFT)))


def linear_free_run(axis: AxisModel, window: Window, fitted: slice, shown: slice) -> np.ndarray:
    """Fit state and bias of one axis to the rows `fitted`, run free from the first of them to the last shown.

    Args:
        axis: the model
        window: flight
        fitted: rows of the fit
        shown: rows of the result, none before the fitted
    Returns:
        outputs, bias included, (rows shown, n)
    """
    y, u = axis.scaled(window)
    errors = sensor_errors(axis.states, axis.y_scale)
    rows, n = fitted.stop - fitted.start, y.shape[1]
    forced = _run(axis.D, np.zeros(n), u[fitted])
    response = np.empty((rows, n, 2 * n))
    response[..., n:] = np.eye(n)
    unforced = np.hstack([axis.D[:, :n], np.zeros((n, axis.D.shape[1] - n))])
    for j, unit in enumerate(np.eye(n)):
        response[..., j] = _run(unforced, unit, u[fitted])
    weight = np.sqrt(_INFORMATION_S / window.dt / rows) / errors.white
    equations = np.vstack(
        [(response * weight[:, None]).reshape(-1, 2 * n), np.hstack([np.zeros((n, n)), np.diag(1 / errors.drift)])]
    )
    wanted = np.concatenate([((y[fitted] - forced) * weight).ravel(), np.zeros(n)])
    solution = np.linalg.lstsq(equations, wanted, rcond=1e-12)[0]
    run = _run(axis.D, solution[:n], u[fitted.start : shown.stop])[shown.start - fitted.start :]
    return (run + solution[n:]) * axis.y_scale + axis.y_mean


def _run(D: np.ndarray, x0: np.ndarray, u: np.ndarray) -> np.ndarray:
    out = np.empty((len(u), len(x0)))
    free_run(D, x0, np.ascontiguousarray(u), out)
    return out


def coupled_free_run(
    model: DerivativesModel, window: Window, fitted: slice, shown: slice, wind: np.ndarray
) -> np.ndarray:
    """Fit state, bias and trim of the coupled model to the rows `fitted`, run free to the last shown.

    Args:
        model: the coupled model
        window: flight
        fitted: rows of the fit, extended to the left to whole groups
        shown: rows of the result, none before the fitted
        wind: wind that makes the velocities of the window air-relative, NED, (3,) [m/s]
    Returns:
        states in the order of `fleet.window.STATES`, air-relative, bias included, (rows shown, 9); nan after divergence
    """
    y, delta = window.over_ground, lagged(window.u, window.dt, TAU)
    errors = sensor_errors(STATES, np.ones(len(STATES)))
    rows = -(-(fitted.stop - fitted.start) // GROUP) * GROUP
    start = fitted.stop - rows
    x, bias, par = line_fit_start(y[start : fitted.stop]), np.zeros(9), model.par.copy()
    groups, offsets = rows // GROUP, list(OFFSETS)
    weight = np.sqrt(_INFORMATION_S / window.dt / rows) / errors.white
    e, J = np.empty((groups, 9)), np.empty((groups, 9, N_PAR + 9))
    output_bias = np.broadcast_to(np.diag(weight), (groups, 9, 9))
    prior = np.hstack([np.zeros((15, 9)), np.diag(1 / np.concatenate([errors.drift, _TRIM_SIGMA]))])
    segments = np.array([[start, fitted.stop]])
    for _ in range(_FIT_STEPS):
        squares = residuals_and_jacobian(
            par, x[None], segments, y - bias, delta, model.trim_velocity, window.dt, weight, e, J
        )
        if not np.isfinite(squares):
            break
        slopes = np.concatenate([J[:, :, N_PAR:], output_bias, J[:, :, offsets]], axis=2).reshape(-1, 24)
        earlier = np.concatenate([bias / errors.drift, (par - model.par)[offsets] / _TRIM_SIGMA])
        change = np.linalg.lstsq(np.vstack([slopes, prior]), np.concatenate([e.ravel(), -earlier]), rcond=1e-12)[0]
        x, bias = x + change[:9], bias + change[9:18]
        par[offsets] += change[18:]
    trimmed = replace(model, par=par)
    run = trimmed.free_run_segments(x[None], np.array([start]), shown.stop - start, delta[: shown.stop], window.dt)
    run = run[shown.start :] + bias
    phi, theta, psi = run[:, 6:].T
    run[:, :3] -= ned_to_body(phi, theta, psi, np.tile(wind, (len(run), 1)))
    return run
