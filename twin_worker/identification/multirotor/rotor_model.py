"""Rotor model of a quadrotor in X from motor outputs, accelerometer, gyros, velocity and attitude, by output error.

Specific force in body axes forward, right, down, mass-normalised, with w_i the relative speed of rotor i and the
velocity through the air (u, v, w) = R' (V - wind):

    w_i' = (w_ic - w_i) / tau,   w_ic^2 = (1 - expo) u_i + expo u_i^2
    f_x  = -d sum(w_i) u - c |V| u + b_x,   f_y likewise with v
    f_z  = -k sum(w_i^2) - k_c sum(w_i) w - k_h (u^2 + v^2) + b_z
    p'   = sum(G_pi w_i^2) - d_p p, q' and r' likewise; r' also with the change of rotor speed

Drag of rotors is linear in airspeed, that of the frame quadratic. Wind, lag and thrust curve enter nonlinearly and are
searched for; the other parameters follow from them by linear least squares (variable projection).
The wind is one constant vector for the whole flight; where it varies, drag and wind take up the difference.

Source: Beard & McLain 2012, ch. 14 (rotor thrust and torque); Faessler, Franchi & Scaramuzza 2018 (rotor
drag); Svacha, Mohta & Kumar 2017 (drag and rotor speed); Golub & Pereyra 1973 (variable projection).
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.optimize import least_squares
from scipy.signal import lfilter

from fleet.compiled_frames import wrap
from fleet.frames import G

# ArduCopter quadrotor X and PX4 quad x: motor 1 front right, 2 rear left, 3 front left, 4 rear right.
# Roll, pitch and yaw moment of the thrust of each motor, (4, 3) [-]
MIXER_X = np.array([[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, -1.0, -1.0]])
_BIAS_STD = 0.05  # accelerometer bias of a calibrated sensor [m/s2]
_MEMORY_S = 0.3  # of the autoregression of the residuals [s]
_WINDOW_S = 0.2  # over which moments are integrated [s]
_PASSES = 3  # of the search, with the whitening of the previous one
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
    offset: float  # vertical acceleration that the velocities show beside the above, down [m/s2]
    torque: np.ndarray  # angular acceleration about each axis by each motor at full speed, (4, 3) [rad/s2]
    damping: np.ndarray  # of p, q, r, (3,) [1/s]
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

    The autopilot answers gusts with the outputs, so the residuals are not independent of them: equations and residuals
    are whitened by an autoregression of the residuals, renewed after each search (generalised least squares).

    Raises:
        ValueError: when the flight is too short.
    """
    seconds = len(data.outputs) * data.dt
    if seconds < _MIN_S:
        raise ValueError(f"rotor model: found {seconds:.0f} s of flight, expected {_MIN_S:.0f} s; record a longer one")
    R = rotation(data.attitude)
    order = round(_MEMORY_S / data.dt)
    whitening = [np.ones(1)] * 3
    x = np.array(_START)
    for _ in range(_PASSES):

        def residual(x: np.ndarray, filters: list[np.ndarray] = whitening) -> np.ndarray:
            return np.concatenate([fit.whitened for fit in _force_fits(data, R, x, filters)])

        x = least_squares(residual, x, bounds=_BOUNDS, x_scale=(1.0, 1.0, 0.01, 0.1), diff_step=1e-4).x
        horizontal, vertical = _force_fits(data, R, x, whitening)
        raw = (*np.split(horizontal.raw, 2), vertical.raw)
        whitening = [autoregression(r - r.mean(), order) for r in raw]
    horizontal, vertical = _force_fits(data, R, x, whitening)
    tau, expo = float(x[2]), float(x[3])
    torque, damping, spin = _moments(data, rotor_speeds(data.outputs, data.dt, tau, expo))
    d, c, b_x, b_y = horizontal.coefficients
    k, k_c, k_h, b_z = vertical.coefficients
    bias = np.array([b_x, b_y, b_z])
    model = RotorModel(k, k_c, k_h, d, c, bias, 0.0, torque, damping, spin, x[:2].copy(), tau, expo)
    return model._replace(offset=_vertical_offset(model, data, R))


def autoregression(r: np.ndarray, order: int) -> np.ndarray:
    """Return the prediction error filter of a series, 1 - a_1 z^-1 ..., (order + 1,), by Yule-Walker."""
    n = len(r)
    covariance = np.array([r[: n - lag] @ r[lag:] for lag in range(order + 1)]) / n
    a = solve_toeplitz(covariance[:-1], covariance[1:])
    std = np.sqrt(max(covariance[0] - a @ covariance[1:], 1e-12))
    return np.concatenate([[1.0], -a]) / std


class _ForceFit(NamedTuple):
    coefficients: np.ndarray
    raw: np.ndarray  # residual [m/s2]
    whitened: np.ndarray


def specific_force(model: RotorModel, w: np.ndarray, air: np.ndarray) -> np.ndarray:
    """Return the specific force without sensor bias at rotor speeds w (N, 4) [-] and air velocity (N, 3), in m/s2."""
    total, speed = w.sum(axis=1), np.linalg.norm(air, axis=1)
    f = -(model.d * total + model.c * speed)[:, None] * air
    lift = model.k * (w**2).sum(axis=1) + model.k_h * (air[:, 0] ** 2 + air[:, 1] ** 2)
    f[:, 2] = -lift - model.k_c * total * air[:, 2]
    return f


def _vertical_offset(model: RotorModel, data: RotorData, R: np.ndarray) -> float:
    """Return the mean vertical acceleration that velocities show and the model lacks [m/s2]; free of sensor bias."""
    w = rotor_speeds(data.outputs, data.dt, model.tau, model.expo)
    air = np.einsum("nji,nj->ni", R, data.velocity - np.array([*model.wind, 0.0]))
    modelled = np.einsum("nj,nj->n", R[:, 2], specific_force(model, w, air)) + G
    seconds = (len(w) - 1) * data.dt
    return float((data.velocity[-1, 2] - data.velocity[0, 2]) / seconds - modelled[:-1].mean())


def _force_fits(data: RotorData, R: np.ndarray, x: np.ndarray, whitening: list[np.ndarray]) -> list[_ForceFit]:
    """Return the fits of the horizontal and the vertical specific force, given wind, lag and thrust curve."""
    w = rotor_speeds(data.outputs, data.dt, x[2], x[3])
    air = np.einsum("nji,nj->ni", R, data.velocity - np.array([x[0], x[1], 0.0]))
    total, speed = w.sum(axis=1), np.linalg.norm(air, axis=1)
    zero, one = np.zeros(len(w)), np.ones(len(w))
    forward = np.stack([-total * air[:, 0], -speed * air[:, 0], one, zero, data.force[:, 0]], axis=1)
    right = np.stack([-total * air[:, 1], -speed * air[:, 1], zero, one, data.force[:, 1]], axis=1)
    square = air[:, 0] ** 2 + air[:, 1] ** 2
    down = np.stack([-(w**2).sum(axis=1), -total * air[:, 2], -square, one, data.force[:, 2]], axis=1)
    fits = []
    for blocks, filters, biases in (((forward, right), whitening[:2], 2), ((down,), whitening[2:], 1)):
        raw = np.vstack(blocks)
        white = np.vstack([lfilter(f, [1.0], b, axis=0)[len(f) :] for f, b in zip(filters, blocks, strict=True)])
        prior = np.zeros((biases, raw.shape[1] - 1))
        prior[:, -biases:] = np.eye(biases) / _BIAS_STD
        A, y = np.vstack([white[:, :-1], prior]), np.concatenate([white[:, -1], np.zeros(biases)])
        coefficients = np.linalg.lstsq(A, y, rcond=None)[0]
        fits.append(_ForceFit(coefficients, raw[:, -1] - raw[:, :-1] @ coefficients, y - A @ coefficients))
    return fits


def _moments(data: RotorData, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return torque effectiveness of each motor (4, 3), rate damping (3,) and reaction to a change of rotor speed.

    The equation is integrated over windows, so that the gyros are not differentiated at their sampling rate. An offset
    of the centre of gravity and differences between motors both appear as unequal effectiveness.
    """
    n = max(round(_WINDOW_S / data.dt), 2)
    changed = w @ MIXER_X[:, 2]
    integrated = np.cumsum(np.hstack([w**2, data.rates]), axis=0) * data.dt
    sums = integrated[n - 1 : -1] - np.vstack([np.zeros((1, 7)), integrated[: -n - 1]])
    torque, damping, spin = np.zeros((4, 3)), np.zeros(3), 0.0
    step = data.rates[n:] - data.rates[:-n]
    for axis in range(3):
        columns = [sums[:, :4], -sums[:, 4 + axis, None]]
        if axis == 2:
            columns.append((changed[n:] - changed[:-n])[:, None])
        fit = np.linalg.lstsq(np.hstack(columns), step[:, axis], rcond=None)[0]
        torque[:, axis], damping[axis] = fit[:4], fit[4]
        spin = float(fit[5]) if axis == 2 else spin
    return torque, damping, spin


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
    moment = w**2 @ model.torque
    moment[1:, 2] += model.spin * np.diff(w @ MIXER_X[:, 2]) / data.dt
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
            f = specific_force(model, w[i : i + 1], air[None])[0]
            v = v + data.dt * (R @ f + np.array([0.0, 0.0, G + model.offset]))
            sf, cf, tt = np.sin(e[0]), np.cos(e[0]), np.tan(e[1])
            turn = sf * rates[1] + cf * rates[2]
            e = e + data.dt * np.array(
                [rates[0] + tt * turn, cf * rates[1] - sf * rates[2], turn / max(np.cos(e[1]), 0.1)]
            )
            rates = rates + data.dt * (moment[i] - model.damping * rates)
    return FreeRun(_fit(data.velocity[:n], v_hat), _fit(np.unwrap(data.attitude[:n], axis=0), e_hat, angles=True))


def _fit(y: np.ndarray, y_hat: np.ndarray, angles: bool = False) -> np.ndarray:
    """Return 100 (1 - |y - y_hat| / |y - mean|) per column [%]."""
    error = y - y_hat
    if angles:
        error = wrap(error)
    return 100 * (1 - np.linalg.norm(error, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0))
