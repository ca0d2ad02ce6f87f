"""Equations of the simulation in coefficient form. The accelerometer provides the flow angles.

    alpha = A . (1, c_z, c_z2, q^, c_z'^, delta_e)     beta = B . (1, c_y, p^, r^, delta_r)
    m f_x = q_bar S X . (1, c_z, c_z2, delta_e, |beta|) + T . thrust terms
    J_x p' - J_xz (r' + p q) + (J_z - J_y) q r = q_bar S b L . (1, beta, p^, r^, delta_a, delta_r, c_z r^, c_z p^, c_z)
    J_z r' - J_xz (p' - q r) + (J_y - J_x) p q = q_bar S b N . (as L)
    J_y q' + J_xz (p2 - r2) + (J_x - J_z) p r = q_bar S c M . (1, c_z, q^, delta_e, c_z'^, c_z2, c_x) + M_T T

    c_z = m f_z / (q_bar S), c_x and c_y likewise; ^: made dimensionless by b / 2 Va, c / 2 Va

Flow angles from inertial velocity are poor regressors of the moments (noise, trim). Forces per dynamic pressure
contain the same gusts as the moments.
Source: Klein & Morelli 2006, section 5.2 (equation error); Beard & McLain 2012, chapter 4; equations 3.8-3.11.
"""

from typing import Any

import numpy as np

from twin_worker.diagnosis.data.card import AircraftCard

ALPHA = ("1", "c_z", "c_z2", "q", "c_z_dot", "delta_e")
BETA = ("1", "c_y", "p", "r", "delta_r")
X = ("1", "c_z", "c_z2", "delta_e", "beta")
LATERAL = ("1", "beta", "p", "r", "delta_a", "delta_r", "c_z r", "c_z p", "c_z")
M = ("1", "c_z", "q", "delta_e", "c_z_dot", "c_z2", "c_x")
THRUST = ("t", "t2", "t3", "tv", "t2v", "t3v")

TERMS = {"alpha": ALPHA, "beta": BETA, "X": X, "T": THRUST, "L": LATERAL, "M": (*M, "T"), "N": LATERAL}
"""Equation -> names of its terms, in the order of its coefficients."""

COEF_PRIOR_STD = {
    "alpha": (np.inf, np.inf, 0.05, 1.5, 1.5, 0.03),
    "beta": (np.inf, np.inf, 0.1, 0.3, 0.06),
    "X": (np.inf, np.inf, np.inf, 0.3, np.inf, *6 * (np.inf,)),
}
"""Equation -> prior standard deviation of coefficients that flight data alone do not determine, because the elevator
follows the lift at every trim. Beta: coefficients of the side force equation before inversion. X: drag, then thrust."""


def moments(rates_dot: Any, rates: Any, card: AircraftCard) -> tuple[Any, Any, Any]:
    """Return the moments L, M, N [Nm] of angular accelerations [rad/s2] at body rates [rad/s], three arrays each.

    Without a card the inertia is one and nothing couples: the moments are angular accelerations.
    """
    (p_dot, q_dot, r_dot), (p, q, r), (J_x, J_y, J_z, J_xz) = rates_dot, rates, card.inertia
    if not card.known:
        return J_x * p_dot, J_y * q_dot, J_z * r_dot
    return (
        J_x * p_dot - J_xz * (r_dot + p * q) + (J_z - J_y) * q * r,
        J_y * q_dot + J_xz * (p * p - r * r) + (J_x - J_z) * p * r,
        J_z * r_dot - J_xz * (p_dot - q * r) + (J_y - J_x) * p * q,
    )


def angular_accelerations(moments: Any, rates: Any, card: AircraftCard) -> tuple[Any, Any, Any]:
    """Return p', q', r' [rad/s2] of the moments L, M, N [Nm]: the inverse of `moments`."""
    (L, M, N), (p, q, r), (J_x, J_y, J_z, J_xz) = moments, rates, card.inertia
    if not card.known:
        return L / J_x, M / J_y, N / J_z
    L, N = L + J_xz * p * q - (J_z - J_y) * q * r, N - J_xz * q * r - (J_y - J_x) * p * q
    determinant = J_x * J_z - J_xz * J_xz
    return (
        (J_z * L + J_xz * N) / determinant,
        (M - J_xz * (p * p - r * r) - (J_x - J_z) * p * r) / J_y,
        (J_xz * L + J_x * N) / determinant,
    )


def alpha_terms(c_z: Any, c_z_dot: Any, q_hat: Any, delta_e: Any) -> np.ndarray:
    """Stack the terms of alpha, (6, n)."""
    return np.array([np.ones_like(c_z), c_z, c_z * c_z, q_hat, c_z_dot, delta_e])


def beta_terms(c_y: Any, p_hat: Any, r_hat: Any, delta_r: Any) -> np.ndarray:
    """Stack the terms of beta, (5, n)."""
    return np.array([np.ones_like(c_y), c_y, p_hat, r_hat, delta_r])


def force_terms(c_z: Any, delta_e: Any, beta: Any) -> np.ndarray:
    """Stack the terms of the axial force coefficient, (5, n)."""
    return np.array([np.ones_like(c_z), c_z, c_z * c_z, delta_e, np.abs(beta)])


def lateral_terms(beta: Any, rates: tuple[Any, Any], deltas: tuple[Any, Any], c_z: Any) -> np.ndarray:
    """Stack the terms of rolling and yawing moment coefficients, (9, n); c_z: lateral offset of the weight."""
    p, r = rates
    return np.array([np.ones_like(c_z), beta, p, r, *deltas, c_z * r, c_z * p, c_z])


def pitch_terms(c_z: Any, q_hat: Any, delta_e: Any, c_z_dot: Any, c_x: Any) -> np.ndarray:
    """Stack the terms of the pitching moment coefficient, (7, n); c_x: vertical offset of the drag."""
    return np.array([np.ones_like(c_z), c_z, q_hat, delta_e, c_z_dot, c_z * c_z, c_x])


def thrust_terms(delta_t: Any, Va: Any, density: Any, speed: float) -> np.ndarray:
    """Stack the terms of thrust, (6, n); Va in shares of the usual speed, density in shares of sea level."""
    v = Va / speed
    full = np.array([delta_t, delta_t**2, delta_t**3])
    return np.concatenate([full, full * v]) * density
