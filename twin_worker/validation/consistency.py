"""Consistency of an identified model with held-out data, and the errors of its parameters that the test detects.

Each group of parameters is scaled by 1 + eps; one least-squares step on free runs of 4 s estimates eps:

    eps_hat = sum z' e / I,   I = sum z' z,   z = d y_hat / d eps
    var(eps_hat) = k / (k - 1) sum_s (z_s' e_s - z_s' z_s eps_hat)^2 / I^2 (1 + I / I_identified)

e and z are weighted residuals and sensitivities without the part that start states, offsets and mean wind explain.
Gusts, noise and model error correlate residuals within a run, so the sum over the k runs s, not over the samples,
gives the variance: k - 1 is the effective sample size. The last factor adds the covariance of the model itself.
A group fails if |eps_hat| exceeds `TOLERANCE` by more than chance allows at 5 % for all groups together.

Source: Liang & Zeger 1986 (cluster-robust variance); Chow 1960 (test of one model on two samples).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import t as student_t

from fleet.physics.simulate import TAU, lagged
from fleet.physics.wrench import NAMES, OFFSETS, WIND
from fleet.window import Window
from twin_worker.identification.fixed_wing.derivatives_model import EFFECTIVE_FRACTION, DerivativesModel
from twin_worker.identification.fixed_wing.output_error import (
    GROUP,
    N_COLUMN,
    SIGMA,
    line_fit_start,
    residuals_and_jacobian,
    unbroken_segments,
)

GROUPS = {  # derivatives that an error scales together
    "elevator_effectiveness": ("X_de", "Z_de", "M_de"),
    "aileron_effectiveness": ("Y_da", "L_da", "N_da"),
    "rudder_effectiveness": ("Y_dr", "L_dr", "N_dr"),
    "pitch_damping": ("Z_q", "M_q"),
    "roll_damping": ("L_p",),
    "pitch_stability": ("M_w",),
    "yaw_stability": ("N_v",),
    "thrust_and_drag": ("X_u", "X_dt"),
}
MASK = np.array([[name in names for names in GROUPS.values()] for name in NAMES], float)  # (37, groups)
_LONGITUDINAL = ("elevator_effectiveness", "pitch_damping", "pitch_stability", "thrust_and_drag")
AXIS_OF = {name: "longitudinal" if name in _LONGITUDINAL else "lateral" for name in GROUPS}
TOLERANCE = 0.07  # relative error of a group that counts as right, chosen on tuning flights (seeds 1000 to 1023) [-]
MAX_DETECTABLE = 0.5  # largest relative error for which the power is stated [-]
_RUN_S = 4.0  # free run [s]
MIN_RUNS = 6  # fewer do not give a variance
_SIGNIFICANCE, _POWER = 0.05, 0.95  # false rejections, over all groups; detections of an error of the stated size
_NUISANCE = (*OFFSETS, WIND, WIND + 1)  # trim and wind differ between two stretches of one flight
_N, _M = len(GROUPS), len(_NUISANCE)


@dataclass(frozen=True)
class Consistency:
    """Result of the test, by group.

    Attributes:
        axis_of: axis of each group of parameters
        error: estimated relative error of the model, positive where the aircraft has more, (groups,) [-]
        threshold: error above which a group fails, (groups,) [-]
        detectable: smallest error, too large or too small, that fails with 95 % probability, (groups,) [-]
    """

    axis_of: Mapping[str, str]
    error: np.ndarray
    threshold: np.ndarray
    detectable: np.ndarray

    def failed(self) -> dict[str, float]:
        """Return the estimated error of each group that fails, largest first [%]; groups without power cannot fail."""
        excess = np.where(self.threshold <= MAX_DETECTABLE, np.abs(self.error) - self.threshold, -1.0)
        return {name: 100.0 * float(self.error[k]) for k, name in self._sorted(-excess) if excess[k] > 0.0}

    def power(self) -> dict[str, float]:
        """Return the detectable error of each group up to `MAX_DETECTABLE`, smallest first [%]."""
        stated = self._sorted(self.detectable)
        return {name: 100.0 * float(self.detectable[k]) for k, name in stated if self.detectable[k] <= MAX_DETECTABLE}

    @property
    def has_power(self) -> bool:
        """Return whether the power is stated for every axis."""
        return {self.axis_of[name] for name in self.power()} == set(self.axis_of.values())

    def power_text(self) -> str:
        """Describe the smallest detectable error of each axis."""
        best: dict[str, str] = {}
        for name, value in self.power().items():
            best.setdefault(self.axis_of[name], f"{value:.0f} % in {name.replace('_', ' ')}")
        return f"would have detected an error of {' and '.join(best.values())}"

    def _sorted(self, key: np.ndarray) -> list[tuple[int, str]]:
        names = tuple(self.axis_of)
        return [(int(k), names[k]) for k in np.argsort(key)]


def error_text(failed: dict[str, float]) -> str:
    """Describe the groups that fail."""
    parts = (
        f"{name.replace('_', ' ')} {abs(error):.0f} % {'above' if error > 0 else 'below'}"
        for name, error in failed.items()
    )
    return f"on held-out data the aircraft has {', '.join(parts)} the model"


def estimate_errors(model: DerivativesModel, window: Window, start: int) -> Consistency | None:
    """Estimate the errors of a model on held-out data; None with too few free runs, or if one leaves the envelope.

    Args:
        model: the model
        window: flight; rows from `start` on are held out
        start: first held-out row
    """
    held_out = window.ok.copy()
    held_out[:start] = False
    grams = _gram_matrices(model, window, unbroken_segments(held_out, window.dt, _RUN_S))
    if grams is None:
        return None
    return compare(grams, AXIS_OF, _identified_information(model))


def compare(grams: np.ndarray, axis_of: Mapping[str, str], identified: np.ndarray) -> Consistency:
    """Estimate the relative errors of the groups from the products of sensitivities and residuals.

    Args:
        grams: of each free run, [sensitivities to the groups, to offsets and wind, residuals], (k, p, p)
        axis_of: groups and their axes
        identified: information on each group in the model itself, in the unit of these data, (groups,)
    """
    total, k, n = grams.sum(axis=0), len(grams), len(axis_of)
    rest = slice(n, total.shape[0] - 1)
    explained = solve(total[rest, rest], total[rest])  # of each column by offsets and wind
    Q = np.eye(len(total))
    Q[rest] -= explained
    projected = Q.T @ grams @ Q
    zz, ze = np.diagonal(projected, axis1=1, axis2=2)[:, :n], projected[:, :n, -1]
    I = np.maximum(zz.sum(axis=0), 1e-12)
    error = ze.sum(axis=0) / I
    variance = k / (k - 1) * ((ze - zz * error) ** 2).sum(axis=0) / I**2
    variance *= 1.0 + I / np.maximum(identified, 1e-12)
    threshold, detectable = limits(np.sqrt(variance), k - 1)
    return Consistency(axis_of, error, threshold, detectable)


def limits(std: np.ndarray, dof: int) -> tuple[np.ndarray, np.ndarray]:
    """Return threshold and detectable error for the standard deviations of estimates with `dof` degrees of freedom.

    A model is itself off by up to the tolerance, uniformly; an error of s, too large, is s / (1 + s) of the model.
    """
    critical, reserve = _quantiles(len(std), dof)
    threshold = TOLERANCE + critical * std
    x = threshold + reserve * np.sqrt(std**2 + TOLERANCE**2 / 3.0)
    return threshold, np.where(x < 1.0, x / np.maximum(1.0 - x, 1e-9), np.inf)


@lru_cache
def _quantiles(groups: int, dof: int) -> tuple[float, float]:
    return float(student_t.ppf(1.0 - _SIGNIFICANCE / (2 * groups), dof)), float(student_t.ppf(_POWER, dof))


def _gram_matrices(model: DerivativesModel, window: Window, runs: np.ndarray) -> np.ndarray | None:
    """Return the products of [sensitivities to groups, offsets and wind, residuals] of each free run, (k, 17, 17).

    What the start state explains is removed, as the identification does.
    """
    if len(runs) < MIN_RUNS:
        return None
    y, delta = window.over_ground, lagged(window.u, window.dt, TAU)
    starts = np.array([line_fit_start(y[a:b]) for a, b in runs])
    bounds = np.concatenate([[0], np.cumsum((runs[:, 1] - runs[:, 0]) // GROUP)])
    e, J = np.empty((bounds[-1], 9)), np.empty((bounds[-1], 9, N_COLUMN))
    weight, trim = np.sqrt(model.weight), model.trim_velocity
    if not np.isfinite(residuals_and_jacobian(model.par, starts, runs, y, delta, trim, window.dt, weight, e, J)):
        return None
    columns = np.zeros((N_COLUMN, _N + _M + 1 + 9))
    columns[: len(NAMES), :_N] = model.par[:, None] * MASK
    columns[list(_NUISANCE), range(_N, _N + _M)] = 1.0
    columns[range(len(NAMES), N_COLUMN), range(_N + _M + 1, columns.shape[1])] = 1.0
    rows = J.reshape(-1, N_COLUMN) @ columns
    rows[:, _N + _M] = e.ravel()
    grams = np.empty((len(runs), rows.shape[1], rows.shape[1]))
    for gram, a, b in zip(grams, 9 * bounds[:-1], 9 * bounds[1:], strict=True):
        gram[:] = rows[a:b].T @ rows[a:b]
    rest, by_start = slice(0, _N + _M + 1), slice(_N + _M + 1, None)
    cross, square = grams[:, by_start, rest], grams[:, by_start, by_start]
    moves = np.linalg.solve(square + np.diag(SIGMA**-2.0) / EFFECTIVE_FRACTION, cross)
    removed = np.swapaxes(cross, 1, 2) @ moves
    return grams[:, rest, rest] - removed - np.swapaxes(removed, 1, 2) + np.swapaxes(moves, 1, 2) @ square @ moves


def _identified_information(model: DerivativesModel) -> np.ndarray:
    """Return the information on each group in the unit of held-out data, (groups,).

    It is that of the identification window and, where the prior was learnt from aircraft of one type, of the prior.
    """
    D = model.par[:, None] * MASK
    identified = model.fisher_information + (model.prior_precision if model.siblings else 0.0)
    information = identified / EFFECTIVE_FRACTION
    cross = information[list(_NUISANCE)] @ D
    by_nuisance = solve(information[np.ix_(_NUISANCE, _NUISANCE)], cross)
    return np.einsum("ag,ab,bg->g", D, information, D) - np.einsum("ng,ng->g", cross, by_nuisance)


def solve(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solve A x = b, (n, n) and (n, m), for a symmetric A whose rows differ in scale and may be dependent."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-12))
    return scale[:, None] * (
        np.linalg.pinv(scale[:, None] * A * scale, rcond=1e-9, hermitian=True) @ (scale[:, None] * b)
    )
