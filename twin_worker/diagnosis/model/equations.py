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

from collections.abc import Mapping
from math import asin, atan2, cos, sin, sqrt
from typing import Any

import numba as nb
import numpy as np

RHO_0 = 1.225  # density at sea level [kg/m3]

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


INCREMENTS = (
    *("thrust", "lift", "side", "C_L", "C_D", "C_Y", "C_l", "C_m", "C_n"),
    *("L", "M", "N", "mass", "x_cg", "y_cg"),
)
"""Rows of `stack_increments`: increments of effects on forces, moments and mass; `side` scales the side force."""
_ROW_OF = {name: row for row, name in enumerate(INCREMENTS)}
_THRUST, _LIFT, _SIDE, _CL, _CD, _CY, _Cl, _Cm, _Cn, _L, _M, _N, _MASS, _X_CG, _Y_CG = range(len(INCREMENTS))


def stack_increments(increments: Mapping[str, Any], n: int) -> np.ndarray:
    """Return increments by name as an array, rows as `INCREMENTS`, zero where absent, (15, n)."""
    out = np.zeros((len(INCREMENTS), n))
    for name, x in increments.items():
        if (row := _ROW_OF.get(name)) is not None:
            out[row] = x
    return out


@nb.njit(cache=True)
def moments(rates_dot: Any, rates: Any, inertia: tuple[float, float, float, float], coupled: bool) -> Any:
    """Return the moments L, M, N [Nm] of angular accelerations [rad/s2] at body rates [rad/s], three arrays each.

    Args:
        rates_dot: p', q', r'; rates: p, q, r; each three arrays (n,)
        inertia: J_x J_y J_z J_xz [kg m2]
        coupled: False without a card: the inertia is one, and the moments are angular accelerations
    """
    (p_dot, q_dot, r_dot), (p, q, r), (J_x, J_y, J_z, J_xz) = rates_dot, rates, inertia
    if not coupled:
        return J_x * p_dot, J_y * q_dot, J_z * r_dot
    return (
        J_x * p_dot - J_xz * (r_dot + p * q) + (J_z - J_y) * q * r,
        J_y * q_dot + J_xz * (p * p - r * r) + (J_x - J_z) * p * r,
        J_z * r_dot - J_xz * (p_dot - q * r) + (J_y - J_x) * p * q,
    )


@nb.njit(cache=True)
def angular_accelerations(
    wrench: np.ndarray, rates: np.ndarray, inertia: tuple[float, float, float, float], coupled: bool
) -> np.ndarray:
    """Return p', q', r', (3, n) [rad/s2], of the moments L, M, N, (3, n) [Nm]: the inverse of `moments`."""
    J_x, J_y, J_z, J_xz = inertia
    out = np.empty_like(wrench)
    determinant = J_x * J_z - J_xz * J_xz
    for k in range(wrench.shape[1]):
        (L, M, N), (p, q, r) = wrench[:, k], rates[:, k]
        if not coupled:
            out[0, k], out[1, k], out[2, k] = L / J_x, M / J_y, N / J_z
            continue
        L, N = L + J_xz * p * q - (J_z - J_y) * q * r, N - J_xz * q * r - (J_y - J_x) * p * q
        out[0, k] = (J_z * L + J_xz * N) / determinant
        out[1, k] = (M - J_xz * (p * p - r * r) - (J_x - J_z) * p * r) / J_y
        out[2, k] = (J_xz * L + J_x * N) / determinant
    return out


@nb.vectorize(cache=True)
def density(h: Any) -> Any:
    """Return the density of the standard atmosphere at height h [m], [kg/m3]; a free run may leave the atmosphere."""
    ratio = 1.0 - 2.25577e-5 * h
    if ratio < 0.1:
        ratio = 0.1
    elif ratio > 2.0:
        ratio = 2.0
    return RHO_0 * ratio**4.2559


@nb.njit(cache=True)
def air_data(
    R: np.ndarray, ground: np.ndarray, wind: np.ndarray, h: np.ndarray, d_rho: np.ndarray, least_Va: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return airspeed [m/s], alpha, beta [rad], density [kg/m3] and dynamic pressure [Pa], (n,) each.

    Args:
        R: rotations from body to NED, (3, 3, n)
        ground, wind: velocity of the aircraft and of the air over the ground, NED, (3, n) [m/s]
        h: height [m]; d_rho: relative increment of the density; each (n,)
        least_Va: lower limit of the airspeed [m/s]
    Source: Beard & McLain 2012, equations 2.7 and 2.8.
    """
    n = len(h)
    Va, alpha, beta, rho, q_bar = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for k in range(n):
        a, b, c = ground[0, k] - wind[0, k], ground[1, k] - wind[1, k], ground[2, k] - wind[2, k]
        u = R[0, 0, k] * a + R[1, 0, k] * b + R[2, 0, k] * c
        v = R[0, 1, k] * a + R[1, 1, k] * b + R[2, 1, k] * c
        w = R[0, 2, k] * a + R[1, 2, k] * b + R[2, 2, k] * c
        speed = sqrt(u * u + v * v + w * w)
        if speed < least_Va:  # not max(): nan stays nan
            speed = least_Va
        side = v / speed
        if side > 1.0:
            side = 1.0
        elif side < -1.0:
            side = -1.0
        Va[k], alpha[k], beta[k] = speed, atan2(w, u), asin(side)
        rho[k] = density(h[k]) * (1.0 + d_rho[k])
        q_bar[k] = 0.5 * rho[k] * speed * speed
    return Va, alpha, beta, rho, q_bar


@nb.njit(cache=True)
def gradient(x: np.ndarray, dt: float) -> np.ndarray:
    """Return the derivative of x, (n,), by central differences, one-sided at the ends, (n,)."""
    out = np.empty_like(x)
    last = len(x) - 1
    out[0], out[last] = (x[1] - x[0]) / dt, (x[last] - x[last - 1]) / dt
    for k in range(1, last):
        out[k] = (x[k + 1] - x[k - 1]) / (2.0 * dt)
    return out


@nb.njit(cache=True)
def alpha_terms(c_z: np.ndarray, c_z_dot: np.ndarray, q_hat: np.ndarray, delta_e: np.ndarray) -> np.ndarray:
    """Stack the terms of alpha, (6, n)."""
    out = np.ones((6, len(c_z)))
    out[1], out[2], out[3], out[4], out[5] = c_z, c_z * c_z, q_hat, c_z_dot, delta_e
    return out


@nb.njit(cache=True)
def beta_terms(c_y: np.ndarray, p_hat: np.ndarray, r_hat: np.ndarray, delta_r: np.ndarray) -> np.ndarray:
    """Stack the terms of beta, (5, n)."""
    out = np.ones((5, len(c_y)))
    out[1], out[2], out[3], out[4] = c_y, p_hat, r_hat, delta_r
    return out


@nb.njit(cache=True)
def force_terms(c_z: np.ndarray, delta_e: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Stack the terms of the axial force coefficient, (5, n)."""
    out = np.ones((5, len(c_z)))
    out[1], out[2], out[3], out[4] = c_z, c_z * c_z, delta_e, np.abs(beta)
    return out


@nb.njit(cache=True)
def lateral_terms(
    beta: np.ndarray, p: np.ndarray, r: np.ndarray, delta_a: np.ndarray, delta_r: np.ndarray, c_z: np.ndarray
) -> np.ndarray:
    """Stack the terms of rolling and yawing moment coefficients, (9, n); c_z: lateral offset of the weight."""
    out = np.ones((9, len(c_z)))
    out[1], out[2], out[3], out[4], out[5] = beta, p, r, delta_a, delta_r
    out[6], out[7], out[8] = c_z * r, c_z * p, c_z
    return out


@nb.njit(cache=True)
def pitch_terms(
    c_z: np.ndarray, q_hat: np.ndarray, delta_e: np.ndarray, c_z_dot: np.ndarray, c_x: np.ndarray
) -> np.ndarray:
    """Stack the terms of the pitching moment coefficient, (7, n); c_x: vertical offset of the drag."""
    out = np.ones((7, len(c_z)))
    out[1], out[2], out[3], out[4], out[5], out[6] = c_z, q_hat, delta_e, c_z_dot, c_z * c_z, c_x
    return out


@nb.njit(cache=True)
def thrust_terms(delta_t: np.ndarray, Va: np.ndarray, density_ratio: np.ndarray, speed: float) -> np.ndarray:
    """Stack the terms of thrust, (6, n); Va in shares of the usual speed, density in shares of sea level."""
    out = np.empty((6, len(delta_t)))
    for k in range(len(delta_t)):
        power = density_ratio[k]
        for term in range(3):
            power *= delta_t[k]
            out[term, k] = power
            out[term + 3, k] = power * (Va[k] / speed)
    return out


@nb.njit(cache=True, error_model="numpy")
def body_coefficients(
    f: np.ndarray, q_S: np.ndarray, mass: float, increments: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return mass [kg], force [N], and c_z, c_y of the clean aircraft, without scaling and increments of effects.

    Args:
        f: specific force, FRD, (3, n) [m/s2]
        q_S: dynamic pressure times wing area, (n,) [N]
        mass: without effects [kg]
        increments: as `stack_increments`, (15, n)
    Returns:
        (n,), (3, n), (n,), (n,)
    """
    n = len(q_S)
    masses, force, c_z, c_y = np.empty(n), np.empty((3, n)), np.empty(n), np.empty(n)
    for k in range(n):
        d = increments[:, k]
        masses[k] = mass * (1.0 + d[_MASS])
        for axis in range(3):
            force[axis, k] = masses[k] * f[axis, k]
        c_z[k] = (force[2, k] / q_S[k] + d[_CL]) / (1.0 + d[_LIFT])
        c_y[k] = (force[1, k] / q_S[k] - d[_CY]) * (1.0 + d[_SIDE])
    return masses, force, c_z, c_y


@nb.njit(cache=True)
def axial_force(
    coefficient: np.ndarray, T: np.ndarray, alpha: np.ndarray, c_z: np.ndarray, q_S: np.ndarray, increments: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return axial force X and thrust with the increments of effects, (n,) each [N].

    Args:
        coefficient: axial force of the clean aircraft without thrust [-]
        T: thrust of the healthy engine [N]
        alpha: angle of attack [rad]
        c_z: coefficient of the vertical body force, clean aircraft
        q_S: dynamic pressure times wing area [N]; each (n,)
        increments: as `stack_increments`, (15, n)
    """
    X, thrust = np.empty_like(T), np.empty_like(T)
    for k in range(len(T)):
        d = increments[:, k]
        lift = d[_CL] - d[_LIFT] * c_z[k]  # increment over the clean lift coefficient
        thrust[k] = T[k] * (1.0 + d[_THRUST])
        X[k] = q_S[k] * (coefficient[k] + lift * sin(alpha[k]) - d[_CD] * cos(alpha[k])) + thrust[k]
    return X, thrust


@nb.njit(cache=True)
def body_moments(
    coefficients: np.ndarray,
    T: np.ndarray,
    force: np.ndarray,
    q_S: np.ndarray,
    lengths: tuple[float, float, float],
    increments: np.ndarray,
) -> np.ndarray:
    """Return the moments L, M, N with the increments of effects, (3, n) [Nm].

    Gravity acts at the centre of gravity, the aerodynamic force at an offset from it.

    Args:
        coefficients: of the moments of the clean aircraft without thrust, (3, n)
        T: thrust, (n,) [N]
        force: FRD, (3, n) [N]
        q_S: dynamic pressure times wing area, (n,) [N]
        lengths: span, chord, pitching moment per thrust [m]
        increments: as `stack_increments`, (15, n)
    """
    span, chord, M_T = lengths
    out = np.empty_like(coefficients)
    for k in range(len(q_S)):
        d = increments[:, k]
        x, y = d[_X_CG], d[_Y_CG]
        out[0, k] = q_S[k] * span * (coefficients[0, k] + d[_Cl]) + d[_L] - y * force[2, k]
        out[1, k] = q_S[k] * chord * (coefficients[1, k] + d[_Cm]) + d[_M] + T[k] * M_T + x * force[2, k]
        out[2, k] = q_S[k] * span * (coefficients[2, k] + d[_Cn]) + d[_N] + y * force[0, k] - x * force[1, k]
    return out


@nb.njit(cache=True)
def solve_c_z(A: np.ndarray, lift_angle: np.ndarray) -> np.ndarray:
    """Solve A1 c_z + A2 c_z2 = lift_angle for c_z, the root near zero."""
    c_z = lift_angle / A[1]
    for _ in range(3):
        c_z = c_z - (A[1] * c_z + A[2] * c_z**2 - lift_angle) / (A[1] + 2 * A[2] * c_z)
    return c_z
