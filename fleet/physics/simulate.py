"""Closed-loop simulation of the twin: route -> autopilot -> surfaces -> aircraft model -> position."""

from math import cos, exp, sin, sqrt

import numba as nb
import numpy as np

from fleet.autopilots.laws import guide, stabilise
from fleet.frames import wrap
from fleet.physics.dynamics import N_X, step
from fleet.physics.kernel import kernel
from fleet.physics.wrench import WIND

TAU = np.array([0.05, 0.05, 0.05, 0.25])  # delta_a delta_e delta_r delta_t of a small aircraft [s]


@kernel
def lagged(commands: np.ndarray, dt: float, tau: np.ndarray) -> np.ndarray:
    """Return the mean actuator state in each interval, (n, 4), from the commands at its start, (n, 4).

    Args:
        commands: delta_a delta_e delta_r delta_t, constant over each interval [-]
        dt: sample time [s]
        tau: time constants, (4,) [s]
    """
    gain = 1.0 - np.exp(-dt / tau)
    out, state = np.empty_like(commands), commands[0].copy()
    for k in range(len(commands)):
        for i in range(4):
            step = gain[i] * (commands[k, i] - state[i])
            out[k, i] = state[i] + 0.5 * step
            state[i] += step
    return out


GUST_S = 4.0  # decay time of a gust [s]
GUIDE_EVERY = 2  # model steps between guidance steps; 0.08 s on the 0.04 s grid
N_STATE = 12  # p_n p_e p_d, u v w, p q r, phi theta psi


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _body_to_ned(u: float, v: float, w: float, phi: float, theta: float, psi: float) -> tuple[float, float, float]:
    cf, sf, ct, st, cp, sp = cos(phi), sin(phi), cos(theta), sin(theta), cos(psi), sin(psi)
    return (
        ct * cp * u + (sf * st * cp - cf * sp) * v + (cf * st * cp + sf * sp) * w,
        ct * sp * u + (sf * st * sp + cf * cp) * v + (cf * st * sp - sf * cp) * w,
        -st * u + sf * ct * v + cf * ct * w,
    )


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _linear_axis(D: np.ndarray, mean: np.ndarray, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the next state x' = x_mean + A (x - x_mean) + B (u - u_mean) + c; D = [A B c], mean = [x_mean u_mean]."""
    n, m = len(x), len(u)
    out = np.empty(n)
    for i in range(n):
        s = mean[i] + D[i, n + m]
        for j in range(n):
            s += D[i, j] * (x[j] - mean[j])
        for j in range(m):
            s += D[i, n + j] * (u[j] - mean[n + j])
        out[i] = s
    return out


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _linear_step(
    lon: np.ndarray, lon_mean: np.ndarray, lat: np.ndarray, lat_mean: np.ndarray, x: np.ndarray, delta: np.ndarray
) -> None:
    """Advance both linear axes, x (9,) in the order of `fleet.window`."""
    bank = np.tan(x[6]) * sin(x[6])
    x_lon = _linear_axis(lon, lon_mean, np.array([x[0], x[2], x[4], x[7]]), np.array([delta[1], delta[3], bank]))
    x_lat = _linear_axis(lat, lat_mean, np.array([x[6], x[8], x[3], x[5], x[1]]), np.array([delta[0], delta[2]]))
    x[0], x[2], x[4], x[7] = x_lon
    x[6], x[8], x[3], x[5], x[1] = x_lat


@nb.njit(cache=True, error_model="numpy", nogil=True)
def simulate(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    plant: tuple,
    state: np.ndarray,
    command: np.ndarray,
    air: np.ndarray,
    dt: float,
    out: np.ndarray,
) -> int:
    """Simulate the flight along the route: the autopilot closes the loop around the aircraft model, in the mean wind.

    x(k+1) = f(x(k), u(k)), u(k) from the controller.  Source: Huang 2021, eq. 23-26 and figure 3.

    Args:
        ctl: controller state, changed in place, (N_CTL,)
        par: controller parameters; the last element selects the law, see `fleet.autopilots.laws`
        legs: route, (n, 9), see `fleet.mission`
        plant: from `linear_plant` or `coupled_plant`
        state: start, (12,): p NED [m], u v w air-relative FRD [m/s], p q r [rad/s], phi theta psi [rad]
        command: phi_c, theta_c [rad], delta_a, delta_e, delta_r, delta_t at the start, (6,)
        air: w_n, w_e wind [m/s], true over reported airspeed [-], gust: airspeed not explained by the mean wind,
            decaying with `GUST_S` [m/s], (4,)
        dt: step [s]
        out: states along the flight, output, (n, 12); out[0] is the start
    Returns:
        number of valid rows of `out`; fewer than len(out) after divergence
    """
    lon, lon_mean, lat, lat_mean, aero, trim, tau = plant
    coupled = len(aero) > 0
    p, x = state[:3].copy(), state[3:].copy()
    phi_c, theta_c = command[0], command[1]
    delta, actuator_state, gain = command[2:].copy(), command[2:].copy(), 1.0 - np.exp(-dt / tau)
    change, delta_mean = np.empty(4), np.empty(4)  # the loop allocates no array
    work, v, v_before, euler = np.empty((3, N_X)), np.empty(3), np.zeros(3), np.empty(3)
    Va_last, Va_dot = (sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2) + air[3]) / air[2], 0.0
    gust_decay, gust_fraction = exp(-dt / GUST_S), 1.0
    max_speed = 3.0 * max(trim[0], 5.0)
    for k in range(len(out)):
        V = sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
        if not (abs(x[6]) < 1.4 and abs(x[7]) < 1.2 and 3.0 < V < max_speed):
            return k
        v[0], v[1], v[2] = _body_to_ned(x[0], x[1], x[2], x[6], x[7], x[8])
        v[0] += air[0]
        v[1] += air[1]
        for i in range(3):
            p[i] += 0.5 * dt * (v_before[i] + v[i]) if k > 0 else 0.0  # trapezoidal rule: no lag in turns
            out[k, i], v_before[i] = p[i], v[i]
        for i in range(N_X):
            out[k, 3 + i] = x[i]
        out[k, 11] = wrap(x[8])
        Va = (V + gust_fraction * air[3]) / air[2]
        euler[0], euler[1], euler[2] = x[6], x[7], out[k, 11]
        if k % GUIDE_EVERY == 0:
            Va_dot += 0.25 * ((Va - Va_last) / (GUIDE_EVERY * dt) - Va_dot)
            Va_last = Va
            phi_c, theta_c, delta[3] = guide(ctl, par, legs, p, v, euler, Va, Va_dot, GUIDE_EVERY * dt)
        delta[0], delta[1], delta[2] = stabilise(ctl, par, phi_c, theta_c, euler, x[3:6], Va, dt)
        if coupled:
            for i in range(4):
                change[i] = gain[i] * (delta[i] - actuator_state[i])
                delta_mean[i] = actuator_state[i] + 0.5 * change[i]
            step(x, delta_mean, aero, trim, dt, work)
            for i in range(4):
                actuator_state[i] += change[i]
        else:
            _linear_step(lon, lon_mean, lat, lat_mean, x, delta)
        gust_fraction *= gust_decay
    return len(out)


def linear_plant(lon: np.ndarray, lon_mean: np.ndarray, lat: np.ndarray, lat_mean: np.ndarray) -> tuple:
    """Create a plant of two linear axes.

    Args:
        lon: [A B c] of u w q theta | delta_e delta_t bank, unscaled deviations, (4, 8)
        lon_mean: reference of the deviations, states then inputs, (7,)
        lat, lat_mean: the same of phi psi p r v | delta_a delta_r, (5, 8) and (7,)
    """
    return lon, lon_mean, lat, lat_mean, np.empty(0), lon_mean[:2].copy(), TAU


def coupled_plant(par: np.ndarray, trim: np.ndarray) -> tuple:
    """Create a plant of derivatives, (37,), see `fleet.physics.wrench`, at U0 W0, (2,) [m/s]; air-relative, no wind."""
    windless = par.copy()
    windless[WIND:] = 0.0
    no_axis = np.empty((0, 0))
    return no_axis, np.empty(0), no_axis, np.empty(0), windless, trim, TAU
