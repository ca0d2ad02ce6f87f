"""Point-mass model with attitude lags and an energy balance, for predictions of minutes.

    phi'' = wn^2 (phi_c + b - phi) - 2 zeta wn phi'                             theta'' likewise
    gamma' = (theta - alpha - gamma) / 0.6 s,      alpha = a_0 + a_n (n (V_0 / V)^2 - 1),      n = 1 / cos phi
    V' + g sin gamma = c_0 + c_t (delta_t - t_0) + c_v (V - V_0) + c_n (n^2 - 1)
    psi' = k g tan phi / V + b_psi
    p' = V e(gamma, psi + d_psi) + w (h / h_0)^(1/7) + drift + rest,      both first-order Gauss-Markov

Guidance and TECS are the autopilot's own laws; the loops below them are replaced by identified lags.
Source: Beard & McLain 2012, chapter 9 (guidance models); Stengel 2004, section 2.6 (energy height).
"""

from math import cos, exp, nan, sin, sqrt, tan

import numpy as np

from fleet.autopilots.laws import guide
from fleet.frames import G, wrap
from fleet.physics.kernel import inlined, kernel

STEP = 0.1  # of guidance and integration [s]
COARSE = 0.25  # the same for ensembles [s]
GAMMA_S = 0.6  # time constant of the flight-path angle [s]
_INNER = 4  # substeps of the lags per step
_THROTTLE_S = 0.3  # of the motor from idle to full [s]
_SHEAR = 1 / 7  # wind over height, open ground [-]
_LOWEST = 5.0  # minimum height of the wind's power law [m]
_STEEPEST = 1.3  # maximum bank; the model diverges beyond [rad]

# columns of `parameters`: identified
WN_PHI, ZETA_PHI, B_PHI = 0, 1, 2  # [rad/s, -, rad]
WN_THETA, ZETA_THETA, B_THETA = 3, 4, 5
K_PSI, B_PSI = 6, 7  # [-, rad/s]
A_0, A_N = 8, 9  # [rad]
C_0, C_T, C_V, C_N = 10, 11, 12, 13  # [m/s2, m/s2, 1/s, m/s2]
T_0, V_0 = 14, 15  # reference throttle and true airspeed [-, m/s]
N_BODY = 16

# columns of `air`
W_N, W_E = 0, 1  # mean wind at height H_0 [m/s]
DRIFT_N, DRIFT_E, REST_N, REST_E = 2, 3, 4, 5  # slow drift of the wind, and the rest: gusts [m/s]
SCALE, D_PSI = 6, 7  # true over reported airspeed, direction through the air minus heading [-, rad]
H_0, GROUND = 8, 9  # height above ground of the mean wind, 0: no shear; p_d of the ground [m]
DRIFT, DRIFT_S, REST, REST_S = 10, 11, 12, 13  # standard deviation and time constant of drift and rest [m/s, s]
N_AIR = 14

# columns of `start`
V, PSI, PHI, P_RATE, THETA, Q_RATE, GAMMA, THR = range(3, 11)  # after p_n p_e p_d
N_START = 11


@kernel
def fly(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    body: np.ndarray,
    air: np.ndarray,
    start: np.ndarray,
    chance: np.ndarray,
    dt: float,
    out: np.ndarray,
) -> int:
    """Simulate the flight along the route.

    Args:
        ctl, par, legs: controller state (changed in place), controller parameters, route
        parameters: identified model parameters, (N_PARAMETERS,)
        air: wind and sensor biases, (N_AIR,)
        start: (N_START,): p NED [m], V [m/s], psi, phi [rad], p [rad/s], theta [rad], q [rad/s], gamma [rad], throttle
        draws: standard normal draws of each second: drift north, east, rest north, east, (seconds, 4); empty: none
        dt: step, an integer fraction of a second [s]
        out: positions, output, NED, (k, 3) [m]; out[0] is the start
    Returns:
        number of valid rows of `out`; fewer than len(out) after divergence
    """
    p, v, euler, wind = start[:3].copy(), np.zeros(3), np.zeros(3), air[DRIFT_N : REST_E + 1].copy()
    speed, psi, phi, p_rate = start[V], start[PSI], start[PHI], start[P_RATE]
    theta, q_rate, gamma, thr = start[THETA], start[Q_RATE], start[GAMMA], start[THR]
    fade_d, fade_r = exp(-dt / air[DRIFT_S]), exp(-dt / air[REST_S])
    kick_d = air[DRIFT] * sqrt(1.0 - exp(-2.0 / air[DRIFT_S]))
    kick_r = air[REST] * sqrt(1.0 - exp(-2.0 / air[REST_S]))
    follow, each, higher = 1.0 - exp(-dt / GAMMA_S), round(1.0 / dt), 1.0
    Va, rate = speed / air[SCALE], 0.0
    for k in range(len(out)):
        for j in range(3):
            out[k, j] = p[j]
        if not (3.0 < speed < 3.0 * body[V_0] and abs(phi) < _STEEPEST):
            return k
        c, s, level = cos(psi + air[D_PSI]), sin(psi + air[D_PSI]), cos(gamma)
        was = (wind[0] + wind[2]) * c + (wind[1] + wind[3]) * s
        if k > 0:
            wind[0], wind[1], wind[2], wind[3] = wind[0] * fade_d, wind[1] * fade_d, wind[2] * fade_r, wind[3] * fade_r
        if k % each == 0:
            if air[H_0] > 0.0:
                higher = (max(air[GROUND] - p[2], _LOWEST) / air[H_0]) ** _SHEAR
            if k // each < len(chance):
                z = chance[k // each]
                wind[0], wind[1] = wind[0] + kick_d * z[0], wind[1] + kick_d * z[1]
                wind[2], wind[3] = wind[2] + kick_r * z[2], wind[3] + kick_r * z[3]
        speed -= level * (
            (wind[0] + wind[2]) * c + (wind[1] + wind[3]) * s - was
        )  # a gust does not change the ground velocity
        v[0] = speed * level * c + air[W_N] * higher + wind[0] + wind[2]
        v[1] = speed * level * s + air[W_E] * higher + wind[1] + wind[3]
        v[2] = -speed * sin(gamma)
        euler[0], euler[1], euler[2] = phi, theta, psi
        rate += min(5.0 * dt, 1.0) * ((speed / air[SCALE] - Va) / dt - rate) if k > 0 else 0.0
        Va = speed / air[SCALE]
        phi_c, theta_c, delta_t = guide(ctl, par, legs, p, v, euler, Va, rate, dt)
        thr += min(max(delta_t - thr, -dt / _THROTTLE_S), dt / _THROTTLE_S)
        n = 1.0 / cos(phi)
        theta, q_rate = _lag(theta, q_rate, theta_c, body[WN_THETA : B_THETA + 1], dt)
        phi, p_rate = _lag(phi, p_rate, phi_c, body[WN_PHI : B_PHI + 1], dt)
        alpha = body[A_0] + body[A_N] * (n * (body[V_0] / speed) ** 2 - 1.0)
        gamma += follow * (theta - alpha - gamma)
        pull = body[C_0] + body[C_T] * (thr - body[T_0]) + body[C_V] * (speed - body[V_0]) + body[C_N] * (n * n - 1.0)
        psi = wrap(psi + dt * (body[K_PSI] * G * tan(phi) / speed + body[B_PSI]))
        speed += dt * (pull + G * v[2] / speed)
        for j in range(3):
            p[j] += dt * v[j]
    return len(out)


@inlined
def _lag(at: float, rate: float, command: float, lag: np.ndarray, dt: float) -> tuple[float, float]:
    """Advance a second-order lag [wn, zeta, bias] by dt."""
    h, stiff, damp = dt / _INNER, lag[0] * lag[0], 2.0 * lag[1] * lag[0]
    for _ in range(_INNER):
        rate += h * (stiff * (command + lag[2] - at) - damp * rate)
        at += h * rate
    return at, rate


@kernel
def bundle(
    control: tuple[np.ndarray, np.ndarray, np.ndarray],
    body: np.ndarray,
    air: np.ndarray,
    start: np.ndarray,
    chance: np.ndarray,
    at: np.ndarray,
    out: np.ndarray,
) -> None:
    """Simulate the members of an ensemble in steps of `COARSE_STEP`; arguments of `simulate_route`, one row per member.

    Args:
        control: controller state (unchanged), parameters, route
        parameters, air, start, draws: (m, N_PARAMETERS), (m, N_AIR), (m, N_START), (m, seconds, 4)
        steps: look-ahead of each stored position, in steps of `COARSE_STEP`, increasing, (k,)
        out: positions, output, nan after a member diverged, (m, k, 3) [m]
    """
    flown = np.empty((at[-1] + 1, 3))
    out[:] = nan
    for i in range(len(body)):
        done = fly(control[0].copy(), control[1], control[2], body[i], air[i], start[i], chance[i], COARSE, flown)
        for k in range(len(at)):
            if at[k] < done:
                out[i, k] = flown[at[k]]
