"""Rigid body over a flat earth: exact kinematics and gravity, aerodynamics from `fleet.physics.wrench`, steady wind.

    u' = r v - q w - g sin(theta) + X            phi'   = p + (q sin(phi) + r cos(phi)) tan(theta)
    v' = p w - r u + g cos(theta) sin(phi) + Y   theta' = q cos(phi) - r sin(phi)
    w' = q u - p v + g cos(theta) cos(phi) + Z   psi'   = (q sin(phi) + r cos(phi)) / cos(theta)
    p' = L   q' = M   r' = N                     (u v w over the ground; the wrench uses them minus the wind)

State x = u v w p q r phi theta psi as in `fleet.window`; delta = delta_a delta_e delta_r delta_t.

Source: Beard & McLain 2012, eq. 3.14-3.17; products of inertia and gyroscopic terms are part of the derivatives.
"""

from math import cos, sin

import numpy as np

from fleet.compiled_frames import assign
from fleet.frames import G
from fleet.physics.kernel import kernel, no_alloc_kernel
from fleet.physics.wrench import WIND, terms, wrench, wrench_jacobian

N_X = 9
MAX_PITCH = 1.5  # pitch limit of the integration, keeps cos(theta) away from zero [rad]
DIVERGENCE_LIMIT = 1e4  # magnitude of a state beyond any flight envelope


@no_alloc_kernel
def is_diverged(x: np.ndarray) -> bool:
    """Return whether a state, (9,), is beyond any flight envelope, or nan."""
    outside = False
    for i in range(N_X):
        outside |= not abs(x[i]) < DIVERGENCE_LIMIT
    return outside


@no_alloc_kernel
def rates_of_change(x: np.ndarray, delta: np.ndarray, par: np.ndarray, trim: np.ndarray, out: np.ndarray) -> None:
    """Compute x', (9,), into `out`."""
    u, v, w, p, q, r = x[0], x[1], x[2], x[3], x[4], x[5]
    phi, theta, psi = x[6], min(max(x[7], -MAX_PITCH), MAX_PITCH), x[8]
    cf, sf, ct, st, cp, sp = cos(phi), sin(phi), cos(theta), sin(theta), cos(psi), sin(psi)
    ahead, right = cp * par[WIND] + sp * par[WIND + 1], cp * par[WIND + 1] - sp * par[WIND]
    u_a, v_a, w_a = u - ct * ahead, v - sf * st * ahead - cf * right, w - cf * st * ahead + sf * right
    X, Y, Z, L, M, N = wrench(par, u_a, v_a, w_a, p, q, r, delta, trim)
    out[0] = r * v - q * w - G * st + X
    out[1] = p * w - r * u + G * ct * sf + Y
    out[2] = q * u - p * v + G * ct * cf + Z
    out[3], out[4], out[5] = L, M, N
    turn = (q * sf + r * cf) / ct
    out[6] = p + turn * st
    out[7] = q * cf - r * sf
    out[8] = turn


@no_alloc_kernel
def step(x: np.ndarray, delta: np.ndarray, par: np.ndarray, trim: np.ndarray, dt: float, work: np.ndarray) -> None:
    """Advance x by dt with constant delta: Runge-Kutta of order four.

    Args:
        x: state, changed in place, (9,)
        delta: actuator state, (4,)
        par: parameters, (37,)
        trim: U0, W0, (2,) [m/s]
        dt: step [s]
        work: scratch, (3, 9)
    """
    k, total, trial = work[0], work[1], work[2]
    rates_of_change(x, delta, par, trim, k)
    for i in range(N_X):
        total[i] = k[i]
        trial[i] = x[i] + 0.5 * dt * k[i]
    for fraction in (0.5, 1.0):
        rates_of_change(trial, delta, par, trim, k)
        for i in range(N_X):
            total[i] += 2.0 * k[i]
            trial[i] = x[i] + fraction * dt * k[i]
    rates_of_change(trial, delta, par, trim, k)
    for i in range(N_X):
        x[i] += dt / 6.0 * (total[i] + k[i])


@kernel
def free_runs(
    starts: np.ndarray,
    begins: np.ndarray,
    length: int,
    delta: np.ndarray,
    par: np.ndarray,
    trim: np.ndarray,
    dt: float,
    out: np.ndarray,
) -> None:
    """Simulate from each start with recorded inputs; rows outside every run, or after divergence, become nan.

    Args:
        starts: state of each run at its first row, (m, 9)
        begins: first row of each, (m,)
        length: maximum rows of a run; it ends with `out`
        delta: actuator state in each interval, (n, 4)
        par, trim: as in `step`
        dt: sample time [s]
        out: states, output, (n, 9)
    """
    x, work = np.empty(N_X), np.empty((3, N_X))
    out[:] = np.nan
    for m in range(len(begins)):
        assign(x, starts[m])
        for k in range(begins[m], min(begins[m] + length, len(out))):
            if is_diverged(x):
                break
            for i in range(N_X):
                out[k, i] = x[i]
            step(x, delta[k], par, trim, dt, work)


@kernel
def jacobian(
    x: np.ndarray,
    delta: np.ndarray,
    par: np.ndarray,
    trim: np.ndarray,
    F: np.ndarray,
    by_wind: np.ndarray,
    term: np.ndarray,
) -> None:
    """Compute F = d x' / d x (9, 9), d x' / d (w_n, w_e) (9, 2), and the terms of the derivatives (35,)."""
    u, v, w, p, q, r, phi, psi = x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[8]
    theta = min(max(x[7], -MAX_PITCH), MAX_PITCH)
    cf, sf, ct, st, cp, sp = cos(phi), sin(phi), cos(theta), sin(theta), cos(psi), sin(psi)
    w_n, w_e = par[WIND], par[WIND + 1]
    R = np.array(  # NED to body, its first two columns
        (
            (ct * cp, ct * sp),
            (sf * st * cp - cf * sp, sf * st * sp + cf * cp),
            (cf * st * cp + sf * sp, cf * st * sp - sf * cp),
        )
    )
    wu, wv, ww = R[0, 0] * w_n + R[0, 1] * w_e, R[1, 0] * w_n + R[1, 1] * w_e, R[2, 0] * w_n + R[2, 1] * w_e
    along, across = cp * w_n + sp * w_e, -sp * w_n + cp * w_e
    terms(u - wu, v - wv, w - ww, x[3:6], delta, trim, term)
    by_air, by_rate = np.empty((6, 3)), np.empty((6, 3))
    wrench_jacobian(par, np.array((u - wu, v - wv, w - ww)), x[3:6], delta, trim, by_air, by_rate)
    turn = np.array(  # d(u_a v_a w_a) / d(phi theta psi): minus the rotated wind
        (
            (0.0, st * along, -ct * across),
            (-ww, -sf * ct * along, -(sf * st * across - cf * along)),
            (wv, -cf * ct * along, -(cf * st * across + sf * along)),
        )
    )
    F[:] = 0.0
    for i in range(6):
        for j in range(3):
            F[i, j] = by_air[i, j]
            F[i, 3 + j] = by_rate[i, j]
            F[i, 6 + j] = by_air[i, 0] * turn[0, j] + by_air[i, 1] * turn[1, j] + by_air[i, 2] * turn[2, j]
        for j in range(2):
            by_wind[i, j] = -(by_air[i, 0] * R[0, j] + by_air[i, 1] * R[1, j] + by_air[i, 2] * R[2, j])
    by_wind[6:] = 0.0
    F[0, 1] += r
    F[0, 2] -= q
    F[0, 4] -= w
    F[0, 5] += v
    F[1, 0] -= r
    F[1, 2] += p
    F[1, 3] += w
    F[1, 5] -= u
    F[2, 0] += q
    F[2, 1] -= p
    F[2, 3] -= v
    F[2, 4] += u
    F[0, 7] -= G * ct
    F[1, 6] += G * ct * cf
    F[1, 7] -= G * st * sf
    F[2, 6] -= G * ct * sf
    F[2, 7] -= G * st * cf
    spin, theta_dot = q * sf + r * cf, q * cf - r * sf
    tan, sec = st / ct, 1.0 / ct
    F[6, 3], F[6, 4], F[6, 5], F[6, 6], F[6, 7] = 1.0, sf * tan, cf * tan, theta_dot * tan, spin * sec * sec
    F[7, 4], F[7, 5], F[7, 6] = cf, -sf, -spin
    F[8, 4], F[8, 5], F[8, 6], F[8, 7] = sf * sec, cf * sec, theta_dot * sec, spin * tan * sec
