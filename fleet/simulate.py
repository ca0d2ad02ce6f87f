"""The only loop of the twin: route -> autopilot -> surfaces -> linear model -> position."""

from math import cos, exp, sin, sqrt

import numba as nb
import numpy as np

from fleet.autopilots.arduplane import guide, stabilise
from fleet.frames import wrap

GUST_S = 4.0  # time in which a gust fades [s]
GUIDE_EVERY = 2  # model steps between guidance steps; 0.08 s on the 0.04 s grid
N_STATE = 12  # p_n p_e p_d, u v w, p q r, phi theta psi


@nb.njit(cache=True)
def _body_to_ned(u: float, v: float, w: float, phi: float, theta: float, psi: float) -> tuple[float, float, float]:
    cf, sf, ct, st, cp, sp = cos(phi), sin(phi), cos(theta), sin(theta), cos(psi), sin(psi)
    return (
        ct * cp * u + (sf * st * cp - cf * sp) * v + (cf * st * cp + sf * sp) * w,
        ct * sp * u + (sf * st * sp + cf * cp) * v + (cf * st * sp - sf * cp) * w,
        -st * u + sf * ct * v + cf * ct * w,
    )


@nb.njit(cache=True)
def _step(D: np.ndarray, at: np.ndarray, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Advance x' = at + A (x - at) + B (u - at) + c, D = [A B c], at = [x_mean u_mean]."""
    n, m = len(x), len(u)
    out = np.empty(n)
    for i in range(n):
        s = at[i] + D[i, n + m]
        for j in range(n):
            s += D[i, j] * (x[j] - at[j])
        for j in range(m):
            s += D[i, n + j] * (u[j] - at[n + j])
        out[i] = s
    return out


@nb.njit(cache=True)
def simulate(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    lon: np.ndarray,
    lon_at: np.ndarray,
    lat: np.ndarray,
    lat_at: np.ndarray,
    state: np.ndarray,
    command: np.ndarray,
    air: np.ndarray,
    dt: float,
    out: np.ndarray,
) -> int:
    """Fly the twin ahead: the autopilot closes the loop around the two linear models, on the route, in the mean wind.

    x(k+1) = A x(k) + B u(k), u(k) from the controller.  Source: Huang 2021, eq. 23-26 and figure 3.

    Args:
        ctl: controller state, changed in place, (N_CTL,)
        par: controller parameters
        legs: route, (n, 9), see `fleet.mission`
        lon: [A B c] of u w q theta | delta_e delta_t bank, unscaled deviations, (4, 8)
        lon_at: means the deviations are from, states then inputs, (7,)
        lat, lat_at: the same of phi psi p r v | delta_a delta_r, (5, 8) and (7,)
        state: start, (12,): p NED [m], u v w air-relative FRD [m/s], p q r [rad/s], phi theta psi [rad]
        command: phi_c, theta_c [rad] in force at the start, (2,)
        air: w_n, w_e wind [m/s], true over reported airspeed [-], gust: airspeed beyond what the mean wind explains,
            fading with `GUST_S` [m/s], (4,)
        dt: step [s]
        out: states along the flight, filled in, (n, 12); out[0] is the start
    Returns:
        rows of `out` that are good; fewer than len(out) where the twin left its envelope (diverged)
    """
    x_lon = np.array([state[3], state[5], state[7], state[10]])
    x_lat = np.array([state[9], state[11], state[6], state[8], state[4]])
    p = state[:3].copy()
    v = np.empty(3)
    phi_c, theta_c, delta_t = command[0], command[1], lon_at[5]
    u_lon, u_lat = np.empty(3), np.empty(2)
    Va_last, Va_dot = (sqrt(state[3] ** 2 + state[4] ** 2 + state[5] ** 2) + air[3]) / air[2], 0.0
    fade, left = exp(-dt / GUST_S), 1.0
    fast = 3.0 * max(lon_at[0], 5.0)
    for k in range(len(out)):
        phi, theta, psi = x_lat[0], x_lon[3], wrap(x_lat[1])
        V = sqrt(x_lon[0] ** 2 + x_lat[4] ** 2 + x_lon[1] ** 2)
        if not (abs(phi) < 1.4 and abs(theta) < 1.2 and 3.0 < V < fast):
            return k
        out[k, :3] = p
        out[k, 3], out[k, 4], out[k, 5] = x_lon[0], x_lat[4], x_lon[1]
        out[k, 6], out[k, 7], out[k, 8] = x_lat[2], x_lon[2], x_lat[3]
        out[k, 9], out[k, 10], out[k, 11] = phi, theta, psi
        v[0], v[1], v[2] = _body_to_ned(x_lon[0], x_lat[4], x_lon[1], phi, theta, psi)
        v[0] += air[0]
        v[1] += air[1]
        Va = (V + left * air[3]) / air[2]
        euler, rates = np.array([phi, theta, psi]), np.array([x_lat[2], x_lon[2], x_lat[3]])
        if k % GUIDE_EVERY == 0:
            Va_dot += 0.25 * ((Va - Va_last) / (GUIDE_EVERY * dt) - Va_dot)
            Va_last = Va
            phi_c, theta_c, delta_t = guide(ctl, par, legs, p, v, euler, Va, Va_dot, GUIDE_EVERY * dt)
        delta_a, delta_e, delta_r = stabilise(ctl, par, phi_c, theta_c, euler, rates, Va, dt)
        u_lon[0], u_lon[1], u_lon[2] = delta_e, delta_t, np.tan(phi) * sin(phi)
        u_lat[0], u_lat[1] = delta_a, delta_r
        x_lon, x_lat = _step(lon, lon_at, x_lon, u_lon), _step(lat, lat_at, x_lat, u_lat)
        left *= fade
        for i in range(3):
            p[i] += v[i] * dt
    return len(out)
