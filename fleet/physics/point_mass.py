"""Point-mass model with attitude lags and an energy balance, for predictions of minutes.

    phi'' = wn^2 (phi_c + b - phi) - 2 zeta wn phi'                             theta'' likewise
    gamma' = (theta - alpha - gamma) / 0.6 s,      alpha = a_0 + a_n (n (V_0 / V)^2 - 1),      n = 1 / cos phi
    V' + g sin gamma = c_0 + c_t (delta_t - t_0) + c_v (V - V_0) + c_n (n^2 - 1)
    psi' = k g tan phi / V + b_psi
    chi_a = psi + d_psi - (theta - gamma) tan phi
    p' = V e(gamma, chi_a) + w (h / h_0)^(1/7) + drift + rest,      both first-order Gauss-Markov

Guidance and TECS are the autopilot's own laws; the loops below them are replaced by identified lags.
Source: Beard & McLain 2012, chapter 9 (guidance models); Stengel 2004, section 2.6 (energy height).
"""

from math import cos, exp, nan, sin, sqrt, tan

import numpy as np

from fleet.autopilots.laws import guide
from fleet.compiled_frames import assign
from fleet.frames import G, air_direction, wrap
from fleet.physics.kernel import inlined_kernel, kernel

STEP = 0.1  # of guidance and integration [s]
COARSE_STEP = 0.25  # the same for ensembles [s]
GAMMA_S = 0.6  # time constant of the flight-path angle [s]
_LAG_SUBSTEPS = 4  # substeps of the lags per step
_THROTTLE_S = 0.3  # of the motor from idle to full [s]
SHEAR = 1 / 7  # wind over height, open ground [-]
MIN_SHEAR_HEIGHT = 5.0  # minimum height of the wind's power law [m]
_MAX_BANK = 1.3  # maximum bank; the model diverges beyond [rad]

# columns of `parameters`: identified
WN_PHI, ZETA_PHI, B_PHI = 0, 1, 2  # [rad/s, -, rad]
WN_THETA, ZETA_THETA, B_THETA = 3, 4, 5
K_PSI, B_PSI = 6, 7  # [-, rad/s]
A_0, A_N = 8, 9  # [rad]
C_0, C_T, C_V, C_N = 10, 11, 12, 13  # [m/s2, m/s2, 1/s, m/s2]
T_0, V_0 = 14, 15  # reference throttle and true airspeed [-, m/s]
N_PARAMETERS = 16

# columns of `air`
W_N, W_E = 0, 1  # mean wind at height H_0 [m/s]
DRIFT_N, DRIFT_E, REST_N, REST_E = 2, 3, 4, 5  # slow drift of the wind, and the rest: gusts [m/s]
SCALE, D_PSI = 6, 7  # true over reported airspeed; direction through the air minus heading, wings level [-, rad]
H_0, GROUND = 8, 9  # height above ground of the mean wind, 0: no shear; p_d of the ground [m]
DRIFT, DRIFT_S, REST, REST_S = 10, 11, 12, 13  # standard deviation and time constant of drift and rest [m/s, s]
N_AIR = 14

# columns of `start`
V, PSI, PHI, P_RATE, THETA, Q_RATE, GAMMA, THROTTLE = range(3, 11)  # after p_n p_e p_d
N_START = 11


@kernel
def simulate_route(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    parameters: np.ndarray,
    air: np.ndarray,
    start: np.ndarray,
    draws: np.ndarray,
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
    theta, q_rate, gamma, thr = start[THETA], start[Q_RATE], start[GAMMA], start[THROTTLE]
    drift_decay, rest_decay = exp(-dt / air[DRIFT_S]), exp(-dt / air[REST_S])
    drift_std = air[DRIFT] * sqrt(1.0 - exp(-2.0 / air[DRIFT_S]))
    rest_std = air[REST] * sqrt(1.0 - exp(-2.0 / air[REST_S]))
    gamma_gain, steps_per_s, shear = 1.0 - exp(-dt / GAMMA_S), round(1.0 / dt), 1.0
    Va, rate = speed / air[SCALE], 0.0
    v_before = np.zeros(3)
    for k in range(len(out)):
        if not (3.0 < speed < 3.0 * parameters[V_0] and abs(phi) < _MAX_BANK):
            return k
        chi = air_direction(phi, theta, psi + air[D_PSI], gamma)
        c, s, cos_gamma = cos(chi), sin(chi), cos(gamma)
        tailwind_before = (wind[0] + wind[2]) * c + (wind[1] + wind[3]) * s
        if k > 0:
            wind[0], wind[1], wind[2], wind[3] = (
                wind[0] * drift_decay,
                wind[1] * drift_decay,
                wind[2] * rest_decay,
                wind[3] * rest_decay,
            )
        if k % steps_per_s == 0:
            if air[H_0] > 0.0:
                shear = (max(air[GROUND] - p[2], MIN_SHEAR_HEIGHT) / air[H_0]) ** SHEAR
            if k // steps_per_s < len(draws):
                z = draws[k // steps_per_s]
                wind[0], wind[1] = wind[0] + drift_std * z[0], wind[1] + drift_std * z[1]
                wind[2], wind[3] = wind[2] + rest_std * z[2], wind[3] + rest_std * z[3]
        speed -= cos_gamma * (
            (wind[0] + wind[2]) * c + (wind[1] + wind[3]) * s - tailwind_before
        )  # a gust does not change the ground velocity
        v[0] = speed * cos_gamma * c + air[W_N] * shear + wind[0] + wind[2]
        v[1] = speed * cos_gamma * s + air[W_E] * shear + wind[1] + wind[3]
        v[2] = -speed * sin(gamma)
        for j in range(3):
            p[j] += 0.5 * dt * (v_before[j] + v[j]) if k > 0 else 0.0  # trapezoidal rule: no lag in turns
            out[k, j], v_before[j] = p[j], v[j]
        euler[0], euler[1], euler[2] = phi, theta, psi
        rate += min(5.0 * dt, 1.0) * ((speed / air[SCALE] - Va) / dt - rate) if k > 0 else 0.0
        Va = speed / air[SCALE]
        phi_c, theta_c, delta_t = guide(ctl, par, legs, p, v, euler, Va, rate, dt)
        thr += min(max(delta_t - thr, -dt / _THROTTLE_S), dt / _THROTTLE_S)
        n, phi_before = 1.0 / cos(phi), phi
        theta, q_rate = _lag(theta, q_rate, theta_c, parameters[WN_THETA : B_THETA + 1], dt)
        phi, p_rate = _lag(phi, p_rate, phi_c, parameters[WN_PHI : B_PHI + 1], dt)
        alpha = parameters[A_0] + parameters[A_N] * (n * (parameters[V_0] / speed) ** 2 - 1.0)
        gamma += gamma_gain * (theta - alpha - gamma)
        accel = (
            parameters[C_0]
            + parameters[C_T] * (thr - parameters[T_0])
            + parameters[C_V] * (speed - parameters[V_0])
            + parameters[C_N] * (n * n - 1.0)
        )
        mean_tan = 0.5 * (tan(phi_before) + tan(phi))
        psi = wrap(psi + dt * (parameters[K_PSI] * G * mean_tan / speed + parameters[B_PSI]))
        speed += dt * (accel + G * v[2] / speed)
    return len(out)


@inlined_kernel
def _lag(angle: float, rate: float, command: float, lag: np.ndarray, dt: float) -> tuple[float, float]:
    """Advance a second-order lag [wn, zeta, bias] by dt."""
    h, stiff, damp = dt / _LAG_SUBSTEPS, lag[0] * lag[0], 2.0 * lag[1] * lag[0]
    for _ in range(_LAG_SUBSTEPS):
        rate += h * (stiff * (command + lag[2] - angle) - damp * rate)
        angle += h * rate
    return angle, rate


@kernel
def simulate_ensemble(
    control: tuple[np.ndarray, np.ndarray, np.ndarray],
    parameters: np.ndarray,
    air: np.ndarray,
    start: np.ndarray,
    draws: np.ndarray,
    steps: np.ndarray,
    out: np.ndarray,
) -> None:
    """Simulate the members of an ensemble in steps of `COARSE_STEP`; arguments of `simulate_route`, one row per member.

    Args:
        control: controller state (unchanged), parameters, route
        parameters, air, start, draws: (m, N_PARAMETERS), (m, N_AIR), (m, N_START), (m, seconds, 4)
        steps: look-ahead of each stored position, in steps of `COARSE_STEP`, increasing, (k,)
        out: positions, output, nan after a member diverged, (m, k, 3) [m]
    """
    path = np.empty((steps[-1] + 1, 3))
    out[:] = nan
    for i in range(len(parameters)):
        n_valid = simulate_route(
            control[0].copy(), control[1], control[2], parameters[i], air[i], start[i], draws[i], COARSE_STEP, path
        )
        for k in range(len(steps)):
            if steps[k] < n_valid:
                assign(out[i, k], path[steps[k]])
