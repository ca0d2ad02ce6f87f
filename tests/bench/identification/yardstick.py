"""The yardstick: a nonlinear small aircraft under an autopilot in Dryden gusts, and the same airframe as an oracle.

It lives here only: it shares the rigid body with the twin's own physics, so it is a yardstick and never a pretend
aircraft. Source: Beard & McLain (2012), equations 3.14-3.17 and 4.6-4.20, appendix E (Aerosonde).
"""

from math import atan2, cos, exp, pi, sin, sqrt, tan
from typing import NamedTuple

import numba as nb
import numpy as np
import scipy.optimize

from fleet.frames import G

DT, SUB = 0.04, 4  # sample time [s], physics steps in it
CRUISE = 35.0  # [m/s]
THROW = 0.5  # full throw of every surface [rad]
SERVO_S, ENGINE_S = 0.05, 0.25  # lags [s]
L_U, L_W = 200.0, 50.0  # Dryden lengths at low altitude [m]
H = 9  # height follows u v w p q r phi theta psi in the simulator's state
NOISE = (0.08, 0.08, 0.08, 0.005, 0.005, 0.005, 0.004, 0.004, 0.008, 0.3, 0.3)  # of the 9 states, airspeed, height


class Airframe(NamedTuple):
    """Mass, inertia, geometry and coefficients, in the letters of the book."""

    m: float = 13.5
    J_x: float = 0.8244
    J_y: float = 1.135
    J_z: float = 1.759
    J_xz: float = 0.1204
    S: float = 0.55
    b: float = 2.8956
    c: float = 0.18994
    S_prop: float = 0.2027
    rho: float = 1.2682
    k_motor: float = 80.0
    C_L_0: float = 0.28
    C_L_alpha: float = 3.45
    C_L_delta_e: float = -0.36
    C_D_p: float = 0.0437
    C_m_0: float = -0.02338
    C_m_alpha: float = -0.38
    C_m_q: float = -3.6
    C_m_delta_e: float = -0.5
    C_Y_beta: float = -0.98
    C_Y_delta_r: float = -0.17
    C_l_beta: float = -0.12
    C_l_p: float = -0.26
    C_l_r: float = 0.14
    C_l_delta_a: float = 0.08
    C_l_delta_r: float = 0.105
    C_n_beta: float = 0.25
    C_n_p: float = 0.022
    C_n_r: float = -0.35
    C_n_delta_a: float = 0.06
    C_n_delta_r: float = -0.032
    steepness: float = 50.0
    alpha_stall: float = 0.4712
    oswald: float = 0.9


ALIKE = ("C_L_0", "C_m_0")  # coefficients that all built aircraft share


def built(rng: np.random.Generator) -> Airframe:
    """Draw one aircraft: coefficients within 20 %, mass and inertia within 10 %."""
    own = {
        name: value * rng.uniform(0.8, 1.2)
        for name, value in Airframe()._asdict().items()
        if name.startswith("C_") and name not in ALIKE
    }
    own |= {name: getattr(Airframe(), name) * rng.uniform(0.9, 1.1) for name in ("m", "J_x", "J_y", "J_z")}
    return Airframe(**own)


@nb.njit(cache=True)
def derivative(f, x, delta, wind):
    """Give x' of x = u v w p q r phi theta psi h; delta as moved, house signs; wind in the body (3,)."""
    u, v, w, p, q, r, phi, theta = x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7]
    d_a, d_e, d_r = THROW * delta[0], -THROW * delta[1], -THROW * delta[2]  # the book's signs
    ur, vr, wr = u - wind[0], v - wind[1], w - wind[2]
    Va = max(sqrt(ur * ur + vr * vr + wr * wr), 1.0)
    alpha = atan2(wr, ur)
    beta = vr / Va
    lift = f.C_L_0 + f.C_L_alpha * alpha
    up = exp(-f.steepness * (alpha - f.alpha_stall))
    down = exp(f.steepness * (alpha + f.alpha_stall))
    stalled = (1 + up + down) / ((1 + up) * (1 + down))
    flat = 2.0 * np.sign(alpha) * sin(alpha) ** 2 * cos(alpha)
    C_L = (1 - stalled) * lift + stalled * flat + f.C_L_delta_e * d_e
    C_D = f.C_D_p + lift * lift / (pi * f.oswald * f.b * f.b / f.S)
    qS = 0.5 * f.rho * Va * Va * f.S
    half = f.b / (2 * Va)
    thrust = 0.5 * f.rho * f.S_prop * ((f.k_motor * delta[3]) ** 2 - Va * Va)
    f_x = qS * (-C_D * cos(alpha) + C_L * sin(alpha)) - f.m * G * sin(theta) + thrust
    f_y = qS * (f.C_Y_beta * beta + f.C_Y_delta_r * d_r) + f.m * G * cos(theta) * sin(phi)
    f_z = qS * (-C_D * sin(alpha) - C_L * cos(alpha)) + f.m * G * cos(theta) * cos(phi)
    l = qS * f.b * (f.C_l_beta * beta + half * (f.C_l_p * p + f.C_l_r * r) + f.C_l_delta_a * d_a + f.C_l_delta_r * d_r)
    m = qS * f.c * (f.C_m_0 + f.C_m_alpha * alpha + f.C_m_q * f.c * q / (2 * Va) + f.C_m_delta_e * d_e)
    n = qS * f.b * (f.C_n_beta * beta + half * (f.C_n_p * p + f.C_n_r * r) + f.C_n_delta_a * d_a + f.C_n_delta_r * d_r)
    gamma = f.J_x * f.J_z - f.J_xz * f.J_xz
    a, c = f.J_xz * (f.J_x - f.J_y + f.J_z), f.J_z * (f.J_z - f.J_y) + f.J_xz * f.J_xz
    d = f.J_x * (f.J_x - f.J_y) + f.J_xz * f.J_xz
    out = np.empty(10)
    out[0] = r * v - q * w + f_x / f.m
    out[1] = p * w - r * u + f_y / f.m
    out[2] = q * u - p * v + f_z / f.m
    out[3] = (a * p * q - c * q * r + f.J_z * l + f.J_xz * n) / gamma
    out[4] = ((f.J_z - f.J_x) * p * r - f.J_xz * (p * p - r * r) + m) / f.J_y
    out[5] = (d * p * q - a * q * r + f.J_xz * l + f.J_x * n) / gamma
    out[6] = p + (q * sin(phi) + r * cos(phi)) * tan(theta)
    out[7] = q * cos(phi) - r * sin(phi)
    out[8] = (q * sin(phi) + r * cos(phi)) / cos(theta)
    out[9] = u * sin(theta) - v * sin(phi) * cos(theta) - w * cos(phi) * cos(theta)
    return out


@nb.njit(cache=True)
def in_body(x, wind, gust):
    """Turn the mean wind (NED, north and east) into the body and add the gust (body)."""
    cf, sf, ct, st, cp, sp = cos(x[6]), sin(x[6]), cos(x[7]), sin(x[7]), cos(x[8]), sin(x[8])
    n, e = wind[0], wind[1]
    out = np.empty(3)
    out[0] = ct * cp * n + ct * sp * e + gust[0]
    out[1] = (sf * st * cp - cf * sp) * n + (sf * st * sp + cf * cp) * e + gust[1]
    out[2] = (cf * st * cp + sf * sp) * n + (cf * st * sp - sf * cp) * e + gust[2]
    return out


@nb.njit(cache=True)
def move(f, x, moved, delta, wind, gust):
    """Advance state and surfaces by one physics step: lags by Euler, the body by the midpoint rule."""
    h = DT / SUB
    for i in range(3):
        moved[i] += h / SERVO_S * (delta[i] - moved[i])
    moved[3] += h / ENGINE_S * (delta[3] - moved[3])
    half = x + 0.5 * h * derivative(f, x, moved, in_body(x, wind, gust))
    return x + h * derivative(f, half, moved, in_body(half, wind, gust))


@nb.njit(cache=True)
def blow(gusts, white, sigma):
    """Advance the Dryden filters (5,) by one physics step; give the gust in the body (3,)."""
    h = DT / SUB
    a_u, a_w = CRUISE / L_U, CRUISE / L_W
    gusts[0] += -h * a_u * gusts[0] + sigma[0] * sqrt(2 * a_u * h) * white[0]
    out = np.empty(3)
    out[0] = gusts[0]
    for i, a in ((1, a_u), (2, a_w)):
        s = 2 * i - 1
        gusts[s + 1] += h * gusts[s]
        gusts[s] += h * (-2 * a * gusts[s] - a * a * gusts[s + 1]) + sqrt(h) * white[i]
        out[i] = sigma[i] * sqrt(3 * a) * (gusts[s] + a / sqrt(3.0) * gusts[s + 1])
    return out


@nb.njit(cache=True)
def steer(seen, commands, pushed, memory, trim):
    """Give the surfaces: a small autopilot for course, height and airspeed with memory of three integrals.

    seen: the nine states, airspeed and height as measured; commands: course, height, airspeed.
    """
    p, q, r, phi, theta, psi, Va, height = seen[3], seen[4], seen[5], seen[6], seen[7], seen[8], seen[9], seen[10]
    phi_c = min(max(1.2 * (commands[0] - psi), -0.6), 0.6)
    low = min(max(commands[1] - height, -12.0), 12.0)
    memory[0] = min(max(memory[0] + 0.004 * DT * low, -0.15), 0.15)
    theta_c = min(max(0.022 * low + memory[0] + 0.03, -0.3), 0.35)
    slow = commands[2] - Va
    memory[1] = min(max(memory[1] + 0.015 * DT * slow, -0.3), 0.3)
    memory[2] += 0.8 * DT * (r - 2 * memory[2])  # half of a steady turn rate passes to the rudder
    delta = np.empty(4)
    delta[0] = 0.7 * (phi_c - phi) - 0.06 * p
    delta[1] = trim[1] + 1.8 * (theta_c - theta) - 0.24 * q
    delta[2] = -0.7 * (r - memory[2])
    delta[3] = trim[3] + 0.06 * slow + memory[1]
    for i in range(4):
        delta[i] = min(max(delta[i] + pushed[i], 0.0 if i == 3 else -1.0), 1.0)
    return delta


@nb.njit(cache=True)
def fly(f, x, trim, commands, pushed, wind, sigma, noise, white):
    """Fly in closed loop; give truth (N, 10), measured (N, 11), commanded (N, 4) and moved surfaces (N, 4)."""
    N = len(commands)
    truth, seen = np.empty((N, 10)), np.empty((N, 11))
    delta, moved = np.empty((N, 4)), np.empty((N, 4))
    memory, gusts, gust, now, x = np.zeros(3), np.zeros(5), np.zeros(3), trim.copy(), x.copy()
    for k in range(N):
        truth[k], moved[k] = x, now
        air = x[:3] - in_body(x, wind, gust)
        seen[k, :9] = x[:9]
        seen[k, 9] = sqrt(air[0] ** 2 + air[1] ** 2 + air[2] ** 2)
        seen[k, 10] = x[H]
        for i in range(11):
            seen[k, i] += NOISE[i] * noise[k, i]
        delta[k] = steer(seen[k], commands[k], pushed[k], memory, trim)
        for s in range(SUB):
            gust = blow(gusts, white[k * SUB + s], sigma)
            x = move(f, x, now, delta[k], wind, gust)
    return truth, seen, delta, moved


@nb.njit(cache=True)
def replay(f, x, moved, delta, wind):
    """Fly recorded commands (N, 4) open loop through the mean wind alone; give the truth (N, 10)."""
    out, calm, x, moved = np.empty((len(delta), 10)), np.zeros(3), x.copy(), moved.copy()
    for k in range(len(delta)):
        out[k] = x
        for _ in range(SUB):
            x = move(f, x, moved, delta[k], wind, calm)
    return out


@nb.njit(cache=True)
def replay_each(f, truth, moved, delta, wind, k):
    """Do so for k samples from every start; give where it ends, (N - k, 10)."""
    out = np.empty((len(delta) - k, 10))
    for i in range(len(out)):
        out[i] = replay(f, truth[i], moved[i], delta[i : i + k + 1], wind)[k]
    return out


def trimmed(f: Airframe, Va: float = CRUISE) -> tuple[np.ndarray, np.ndarray]:
    """Solve for straight level flight in still air: state (10,) at 100 m, surfaces (4,)."""

    def at(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = np.array([Va * cos(z[0]), 0, Va * sin(z[0]), 0, 0, 0, 0, z[0], 0, 100.0])
        return x, np.array([0.0, z[1], 0.0, z[2]])

    def unbalanced(z: np.ndarray) -> np.ndarray:
        return derivative(f, *at(z), np.zeros(3))[[0, 2, 4]]

    solution = scipy.optimize.root(unbalanced, [0.05, 0.2, 0.5])
    if not solution.success:
        raise ValueError(f"yardstick: found no trim at {Va:.0f} m/s, expected one; draw another aircraft")
    return at(solution.x)
