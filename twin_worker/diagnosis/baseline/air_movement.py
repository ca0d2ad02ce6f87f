"""Decide whether earlier air movement and the uncertain energy equation explain a loss of energy.

The specific excess power of a flight, less that of the simulation, is averaged over blocks of two turbulence lengths,
which are independent. The blocks before the onset determine a Bayesian regression of the force coefficients and the
variance of the air movement; the mean after the onset then has a Student distribution.
Source: MIL-F-8785C (scale lengths); Gelman et al. 2013, Bayesian Data Analysis, chapter 14.
"""

import numpy as np

from fleet.frames import G
from twin_worker.diagnosis.baseline.fit import axial_regression, stacked_coef
from twin_worker.diagnosis.data.flight import STEP_S, FlightData
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.weather import own_weather

_SCALE_RANGE_M = 10.0, 533.0  # of the vertical turbulence scale, which is the height above the ground
_ROUNDS = 10  # variance and degrees of freedom determine each other


def energy_evidence(flight: FlightData, base: Baseline, onset: float) -> float:
    """Return the log likelihood ratio of a lasting change of specific excess power from `onset` on [s], Student.

    Returns zero where the flight before the onset has less than three independent blocks.
    """
    modelled = ModelledFlight(flight, base)
    terms = modelled.equation_terms(own_weather(modelled))
    data, t, Va = axial_regression([terms]), modelled.t, terms.flow.Va
    power = Va / (G * terms.intermediate["mass"])  # climb rate per force
    A, y = data.A * power[:, None], data.y * power
    before, after = modelled.ok & (t < onset), modelled.ok & (t >= onset)
    height = float(np.clip(np.median(terms.flow.height[modelled.ok]), *_SCALE_RANGE_M))
    block_s = 2.0 * height / float(np.median(Va[modelled.ok]))
    block = np.floor((t - t[0]) / block_s).astype(int)
    blocks = [before & (block == k) for k in np.unique(block[before])]
    blocks = [rows for rows in blocks if rows.sum() * STEP_S >= 0.5 * block_s]
    if len(blocks) < 3 or not after.any():
        return 0.0
    A_b, e_b = np.stack([A[rows].mean(axis=0) for rows in blocks]), np.array([y[rows].mean() for rows in blocks])
    coef = stacked_coef(base.coef, "X")
    e_b = e_b - A_b @ coef
    prior_var = (y[before] ** 2).mean() / ((A[before] ** 2).mean(axis=0) + 1e-12)  # one term may explain all variance
    variance, change = float(e_b.var()) + 1e-9, np.zeros(len(coef))
    for _ in range(_ROUNDS):
        covariance = np.linalg.inv(A_b.T @ A_b / variance + np.diag(1.0 / prior_var))
        change = covariance @ (A_b.T @ e_b) / variance
        nu = max(len(blocks) - float(np.trace(A_b @ covariance @ A_b.T)) / variance, 1.0)
        variance = float(((e_b - A_b @ change) ** 2).sum()) / nu + 1e-9
    a = A[after].mean(axis=0)
    n_after = max(float(after.sum()) * STEP_S / block_s, 1.0)
    mean = float(y[after].mean() - a @ (coef + change))
    ratio = mean**2 / (variance / n_after + float(a @ covariance @ a))
    return 0.5 * (nu + 1.0) * float(np.log1p(ratio / nu))
