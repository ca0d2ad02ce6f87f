"""Rotor model of a quadrotor in X from motor outputs, accelerometer, gyros, velocity and attitude, by output error.

Specific force in body axes forward, right, down, mass-normalised, with w_i the relative speed of rotor i and the
velocity through the air (u, v, w) = R' (V - wind):

    w_i' = (w_ic - w_i) / tau,   w_ic^2 = (1 - expo) u_i + expo u_i^2
    f_x  = -d sum(w_i) u - c |V| u + b_x,   f_y likewise with v
    f_z  = -k sum(w_i^2) - k_c sum(w_i) w - k_h (u^2 + v^2) + b_z
    p'   = G_p sum(s_pi w_i^2) + p_0, q' and r' likewise; r' also with the change of rotor speed

Drag of rotors is linear in airspeed, that of the frame quadratic. Wind, lag and thrust curve enter nonlinearly and are
searched for; the other parameters follow from them by linear least squares (variable projection).

Source: Beard & McLain 2012, ch. 14 (rotor thrust and torque); Faessler, Franchi & Scaramuzza 2018, eq. 2-5 (rotor
drag); Svacha, Mohta & Kumar 2017 (drag and rotor speed); Golub & Pereyra 1973 (variable projection).
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from fleet.frames import G

# ArduCopter quadrotor X and PX4 quad x: motor 1 front right, 2 rear left, 3 front left, 4 rear right.
# Roll, pitch and yaw moment of the thrust of each motor, (4, 3) [-]
MIXER_X = np.array([[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, -1.0, -1.0]])
_BIAS_STD = 0.05  # accelerometer bias of a calibrated sensor [m/s2]
_MIN_S = 30.0  # shortest flight [s]
_START = (0.0, 0.0, 0.05, 0.6)  # wind north, east [m/s], tau [s], expo [-]
_BOUNDS = ((-20.0, -20.0, 0.005, 0.0), (20.0, 20.0, 0.3, 1.0))


class RotorData(NamedTuple):
    """Equally sampled flight of one quadrotor."""

    dt: float  # [s]
    outputs: np.ndarray  # motor inputs 0..1, (N, 4) [-]
    force: np.ndarray  # specific force, body, (N, 3) [m/s2]
    rates: np.ndarray  # p, q, r, (N, 3) [rad/s]
    velocity: np.ndarray  # NED, (N, 3) [m/s]
    attitude: np.ndarray  # phi, theta, psi, (N, 3) [rad]


class RotorModel(NamedTuple):
    """Identified parameters."""

    k: float  # specific thrust of one rotor at full output [m/s2]
    k_c: float  # thrust lost in a climb [1/s]
    k_h: float  # translational lift [1/m]
    d: float  # rotor drag [1/s]
    c: float  # frame drag [1/m]
    bias: np.ndarray  # of the specific force, (3,) [m/s2]
    torque: np.ndarray  # angular acceleration per unit of mixed w^2, (3,) [rad/s2]
    trim: np.ndarray  # angular acceleration at equal outputs, as of a CG offset, (3,) [rad/s2]
    spin: float  # yaw acceleration per change of mixed rotor speed [rad/s]
    wind: np.ndarray  # mean wind north, east [m/s]
    tau: float  # motor lag [s]
    expo: float  # thrust curve [-]

    def drag(self, airspeed: float, rotor_speed: float) -> float:
        """Return the drag in level flight at `airspeed` [m/s] and mean relative `rotor_speed` [-], in m/s2."""
        return (4 * rotor_speed * self.d + self.c * airspeed) * airspeed


def rotation(attitude: np.ndarray) -> np.ndarray:
    """Return body to NED, (N, 3, 3), of roll, pitch, yaw (N, 3) [rad]."""
    (sf, st, sp), (cf, ct, cp) = np.sin(attitude.T), np.cos(attitude.T)
    rows = [
        [ct * cp, sf * st * cp - cf * sp, cf * st * cp + sf * sp],
        [ct * sp, sf * st * sp + cf * cp, cf * st * sp - sf * cp],
        [-st, sf * ct, cf * ct],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def rotor_speeds(outputs: np.ndarray, dt: float, tau: float, expo: float) -> np.ndarray:
    """Return the relative rotor speeds behind the motor lag, (N, 4) [-]."""
    u = np.clip(outputs, 0.0, 1.0)
    command = np.sqrt((1 - expo) * u + expo * u**2)
    a = np.exp(-dt / tau)
    return lfilter([0.0, 1 - a], [1.0, -a], command, axis=0, zi=command[:1] * 1.0)[0]


def identify_rotors(data: RotorData) -> RotorModel:
    """Identify the rotor model of one flight.

    Raises:
        ValueError: when the flight is too short.
    """
    seconds = len(data.outputs) * data.dt
    if seconds < _MIN_S:
        raise ValueError(f"rotor model: found {seconds:.0f} s of flight, expected {_MIN_S:.0f} s; record a longer one")
    R = rotation(data.attitude)

    def residual(x: np.ndarray) -> np.ndarray:
        return np.concatenate([part[1] for part in _force_fits(data, R, x)])

    best = least_squares(residual, _START, bounds=_BOUNDS, x_scale=(1.0, 1.0, 0.01, 0.1), diff_step=1e-4)
    (horizontal, _), (vertical, _) = _force_fits(data, R, best.x)
    tau, expo = float(best.x[2]), float(best.x[3])
    torque, trim, spin = _moments(data, rotor_speeds(data.outputs, data.dt, tau, expo))
    d, c, b_x, b_y = horizontal
    k, k_c, k_h, b_z = vertical
    bias = np.array([b_x, b_y, b_z])
    return RotorModel(k, k_c, k_h, d, c, bias, torque, trim, spin, best.x[:2].copy(), tau, expo)


def _force_fits(data: RotorData, R: np.ndarray, x: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return coefficients and residuals of the horizontal and the vertical specific force, given wind, lag, curve."""
    w = rotor_speeds(data.outputs, data.dt, x[2], x[3])
    air = np.einsum("nji,nj->ni", R, data.velocity - np.array([x[0], x[1], 0.0]))
    total, speed = w.sum(axis=1), np.linalg.norm(air, axis=1)
    zero, one = np.zeros(len(w)), np.ones(len(w))
    horizontal = np.concatenate(
        [
            np.stack([-total * air[:, 0], -speed * air[:, 0], one, zero], axis=1),
            np.stack([-total * air[:, 1], -speed * air[:, 1], zero, one], axis=1),
        ]
    )
    square = air[:, 0] ** 2 + air[:, 1] ** 2
    vertical = np.stack([-(w**2).sum(axis=1), -total * air[:, 2], -square, one], axis=1)
    targets = (np.concatenate([data.force[:, 0], data.force[:, 1]]), data.force[:, 2])
    fits = []
    for A, y, biases in ((horizontal, targets[0], 2), (vertical, targets[1], 1)):
        prior = np.zeros((biases, A.shape[1]))
        prior[:, -biases:] = np.eye(biases)
        prior *= np.sqrt(len(y)) * 0.1 / _BIAS_STD  # the prior counts as 1 % of the flight at a noise of its size
        coefficients = np.linalg.lstsq(np.vstack([A, prior]), np.concatenate([y, np.zeros(biases)]), rcond=None)[0]
        fits.append((coefficients, y - A @ coefficients))
    return fits


def _moments(data: RotorData, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return torque effectiveness, trim and reaction to a change of rotor speed.

    The equation is integrated over windows, so that the gyros are not differentiated at their sampling rate.
    """
    n = max(round(0.2 / data.dt), 2)  # window [samples], 0.2 s
    mixed, changed = w**2 @ MIXER_X, w @ MIXER_X[:, 2]
    sums = np.vstack([np.zeros((1, 3)), np.cumsum(mixed, axis=0)])[:-1] * data.dt
    torque, trim, spin = np.zeros(3), np.zeros(3), 0.0
    step = data.rates[n:] - data.rates[:-n]
    for axis in range(3):
        columns = [sums[n:, axis] - sums[:-n, axis], np.full(len(step), n * data.dt)]
        if axis == 2:
            columns.append(changed[n:] - changed[:-n])
        fit = np.linalg.lstsq(np.stack(columns, axis=1), step[:, axis], rcond=None)[0]
        torque[axis], trim[axis] = fit[:2]
        spin = float(fit[2]) if axis == 2 else spin
    return torque, trim, spin


class FreeRun(NamedTuple):
    """Fit of the free runs over a held-out stretch, 100 (1 - NRMSE)."""

    velocity: np.ndarray  # per axis, NED, (3,) [%]
    attitude: np.ndarray  # roll, pitch, yaw, (3,) [%]


def free_run(model: RotorModel, data: RotorData, horizon_s: float = 10.0, anchor_s: float = 1.0) -> FreeRun:
    """Run the model over consecutive stretches with the measured outputs as inputs and compare.

    Velocity starts at each stretch and is never corrected within it. Attitude and rates are unstable without the
    autopilot's feedback: they start again at the measurement every `anchor_s`. Velocity therefore runs on an attitude
    that is at most `anchor_s` old.
    """
    w = rotor_speeds(data.outputs, data.dt, model.tau, model.expo)
    mixed, total = w**2 @ MIXER_X * model.torque + model.trim, w.sum(axis=1)
    mixed[1:, 2] += model.spin * np.diff(w @ MIXER_X[:, 2]) / data.dt
    wind = np.array([*model.wind, 0.0])
    length, anchor = round(horizon_s / data.dt), round(anchor_s / data.dt)
    n = len(w) // length * length
    v_hat, e_hat = data.velocity[:n].copy(), data.attitude[:n].copy()
    for start in range(0, n, length):
        v, e, rates = data.velocity[start], data.attitude[start], data.rates[start]
        for i in range(start, start + length):
            if (i - start) % anchor == 0:
                e, rates = data.attitude[i], data.rates[i]
            v_hat[i], e_hat[i] = v, e
            R = rotation(e[None])[0]
            air = R.T @ (v - wind)
            speed = float(np.linalg.norm(air))
            f = -(model.d * total[i] + model.c * speed) * air
            lift = model.k * float(w[i] @ w[i]) + model.k_h * (air[0] ** 2 + air[1] ** 2)
            f[2] = -lift - model.k_c * total[i] * air[2]
            v = v + data.dt * (R @ (f + np.array([0.0, 0.0, model.bias[2]])) + np.array([0.0, 0.0, G]))
            sf, cf, tt = np.sin(e[0]), np.cos(e[0]), np.tan(e[1])
            turn = sf * rates[1] + cf * rates[2]
            e = e + data.dt * np.array(
                [rates[0] + tt * turn, cf * rates[1] - sf * rates[2], turn / max(np.cos(e[1]), 0.1)]
            )
            rates = rates + data.dt * mixed[i]
    return FreeRun(_fit(data.velocity[:n], v_hat), _fit(np.unwrap(data.attitude[:n], axis=0), e_hat, wrap=True))


def _fit(y: np.ndarray, y_hat: np.ndarray, wrap: bool = False) -> np.ndarray:
    """Return 100 (1 - |y - y_hat| / |y - mean|) per column [%]."""
    error = y - y_hat
    if wrap:
        error = (error + np.pi) % (2 * np.pi) - np.pi
    return 100 * (1 - np.linalg.norm(error, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0))
