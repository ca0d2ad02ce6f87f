"""Rotor model of a multirotor with effects, and its residuals.

Specific force and angular acceleration, mass-normalised, with w_i the relative speed of rotor i, its relative thrust
T_i = (1 + m_p roll_i + m_q pitch_i + m_r yaw_i) (1 - loss_i) w_i^2, and the velocity through the air
(u, v, w) = R' (V - wind):

    w_i' = (w_ic - w_i) / tau,   w_ic^2 = (1 - expo) u_i + expo u_i^2
    f_x  = -(d sum w_i + c Va) u,   f_y likewise with v
    f_z  = -k sum T_i - k_c sum(w_i) w - k_h (u^2 + v^2) - c Va w
    p'   = a_p (sum T_i roll_i + y_c sum T_i) - j_p q r - d_p p
    q'   = a_q (sum T_i pitch_i - x_c sum T_i) + j_q p r - d_q q
    r'   = a_r (sum T_i yaw_i + n_c sum T_i) + spin (sum yaw_i w_i)' - d_r r

Channels: measured less modelled specific force and angular acceleration; derivative of the velocity less the measured
force in NED; Euler rates less those of the gyros; pressure less satellite height. An effect changes parameters or
corrects readings; with a time profile it acts with the share of each instant.

Source: Beard & McLain 2012, ch. 14 (rotor thrust and torque); Faessler, Franchi & Scaramuzza 2018 (rotor drag);
Svacha, Mohta & Kumar 2017 (drag and rotor speed).
"""

from collections.abc import Mapping

import numpy as np
from scipy.signal import butter, lfilter, sosfiltfilt

from fleet.frames import G
from twin_worker.diagnosis.multirotor.flight import DT, RotorFlight

PARAMETERS = (
    *("k", "expo", "tau", "k_c", "k_h", "d", "c", "x_c", "y_c", "n_c"),
    *("a_p", "a_q", "a_r", "d_p", "d_q", "d_r", "j_p", "j_q", "spin", "m_p", "m_q", "m_r"),
)
"""k [m/s2], expo [-], tau [s], k_c [1/s], k_h [1/m], d [1/s], c [1/m], x_c y_c n_c [-], a [rad/s2], d_* [1/s], j [-],
spin [rad/s], m [-]."""
CHANNELS = (
    *("f_x", "f_y", "f_z", "p_dot", "q_dot", "r_dot"),
    *("v_n_dot", "v_e_dot", "v_d_dot", "phi_dot", "theta_dot", "psi_dot", "baro"),
)
STEP = 5  # grid rows for each row of the residuals
STEP_S = STEP * DT  # [s]
_CUTOFF_HZ = np.array([2.0] * 6 + [0.8] * 6 + [0.8])
Profiles = Mapping[str, np.ndarray]
"""Value of each effect coordinate at every instant, (n,); absent: 0."""


def rotation(attitude: np.ndarray) -> np.ndarray:
    """Return body to NED, (n, 3, 3), of roll, pitch, yaw (n, 3) [rad]."""
    (sf, st, sp), (cf, ct, cp) = np.sin(attitude.T), np.cos(attitude.T)
    rows = [
        [ct * cp, sf * st * cp - cf * sp, cf * st * cp + sf * sp],
        [ct * sp, sf * st * sp + cf * cp, cf * st * sp - sf * cp],
        [-st, sf * ct, cf * ct],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def rotor_speeds(inputs: np.ndarray, tau: float, expo: float) -> np.ndarray:
    """Return the relative rotor speeds behind the motor lag, (n, m) [-]."""
    command = np.sqrt(np.clip((1 - expo) * inputs + expo * inputs**2, 1e-4, None))
    a = np.exp(-DT / max(tau, 1e-3))
    return np.asarray(lfilter([1 - a], [1.0, -a], command, axis=0, zi=a * command[:1])[0])


def residuals(flight: RotorFlight, parameters: np.ndarray, wind: np.ndarray, effects: Profiles) -> np.ndarray:
    """Return the filtered residuals, (N, 13), one row for every `STEP` rows of the grid.

    Args:
        flight: measurements
        parameters: as in `PARAMETERS`, (22,)
        wind: north and east, the direction it blows to, (n, 2) [m/s]
        effects: coordinates as in `effects.COORDINATES`
    """
    raw, _ = _raw(flight, parameters, wind, effects)
    return smoothed(raw)


def modelled_force(flight: RotorFlight, parameters: np.ndarray, wind: np.ndarray, effects: Profiles) -> np.ndarray:
    """Return the modelled specific force FRD, filtered, (N, 3) [m/s2]; arguments as for `residuals`."""
    _, modelled = _raw(flight, parameters, wind, effects)
    return smoothed(modelled, _CUTOFF_HZ[:3])


def smoothed(x: np.ndarray, cutoff: np.ndarray = _CUTOFF_HZ) -> np.ndarray:
    """Filter columns without phase shift and thin them to every `STEP`-th row."""
    out = np.empty_like(x)
    for hertz in np.unique(cutoff):
        columns = cutoff == hertz
        out[:, columns] = sosfiltfilt(butter(3, hertz, fs=1 / DT, output="sos"), x[:, columns], axis=0)
    return out[::STEP]


def _raw(
    flight: RotorFlight, parameters: np.ndarray, wind: np.ndarray, effects: Profiles
) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals before the filter, (n, 13), and the modelled specific force, (n, 3)."""
    p = dict(zip(PARAMETERS, parameters.tolist(), strict=True))
    n = len(flight.t)

    def effect(name: str) -> np.ndarray | float:
        return effects.get(name, 0.0)

    velocity, attitude = flight.velocity, flight.attitude
    if "latency" in effects:  # readings are older than their time
        now = flight.t + effects["latency"]
        velocity = np.stack([np.interp(now, flight.t, column) for column in velocity.T], axis=1)
    if "heading" in effects:
        attitude = attitude - np.outer(effects["heading"], (0.0, 0.0, 1.0))
    force = flight.force - np.stack([np.broadcast_to(effect(f"accel_{axis}"), n) for axis in "xyz"], axis=1)
    rates = flight.rates - np.stack([np.broadcast_to(effect(f"gyro_{axis}"), n) for axis in "pqr"], axis=1)
    R = rotation(attitude)
    full_wind = np.column_stack([wind, np.zeros(n)])
    air = np.einsum("nji,nj->ni", R, velocity - full_wind)
    w, T = _rotors(flight, p, effects)
    modelled = _specific_force(p, w, air, T, effects)
    raw = np.empty((n, len(CHANNELS)))
    raw[:, :3] = force - modelled
    raw[:, 3:6] = np.gradient(rates, DT, axis=0) - _angular_acceleration(
        p, w, T, rates, effects, mixer=flight.frame.mixer
    )
    raw[:, 6:9] = np.gradient(velocity, DT, axis=0) - np.einsum("nij,nj->ni", R, force)
    raw[:, 8] -= G
    raw[:, 9:12] = np.gradient(attitude, DT, axis=0) - _euler_rates(attitude, rates)
    raw[:, 12] = np.nan_to_num(flight.height) - effect("baro")
    return raw, modelled


def _rotors(flight: RotorFlight, p: Mapping[str, float], effects: Profiles) -> tuple[np.ndarray, np.ndarray]:
    """Return rotor speeds and relative thrusts, (n, m) each [-]."""
    w = rotor_speeds(flight.inputs, p["tau"], p["expo"])
    if "lag" in effects:  # a blend of the speeds with the healthy and with the slowest lag
        added = effects["lag"]
        most = float(added[np.argmax(np.abs(added))])
        share = added / most if most else np.zeros(len(added))
        w = w + share[:, None] * (rotor_speeds(flight.inputs, p["tau"] + most, p["expo"]) - w)
    healthy = np.ones(w.shape) + flight.frame.mixer @ np.array([p["m_p"], p["m_q"], p["m_r"]])
    for i in range(w.shape[1]):
        if (loss := effects.get(f"motor{i + 1}")) is not None:
            healthy[:, i] *= 1 - loss
    return w * np.sqrt(np.clip(healthy, 0.0, None)), w**2 * healthy


def _specific_force(
    p: Mapping[str, float], w: np.ndarray, air: np.ndarray, T: np.ndarray, effects: Profiles
) -> np.ndarray:
    total, speed = w.sum(axis=1), np.linalg.norm(air, axis=1)
    drag = p["d"] * total + p["c"] * (1 + effects.get("drag", 0.0)) * speed
    f = -drag[:, None] * air
    climb = p["k_c"] * total + p["c"] * (1 + effects.get("drag", 0.0)) * speed
    thrust = p["k"] * (1 - effects.get("thrust", 0.0)) * T.sum(axis=1)
    f[:, 2] = -thrust - climb * air[:, 2] - p["k_h"] * (air[:, 0] ** 2 + air[:, 1] ** 2)
    return np.asarray(f / (1 + np.broadcast_to(effects.get("mass", 0.0), len(f)))[:, None])


def _angular_acceleration(
    p: Mapping[str, float], w: np.ndarray, T: np.ndarray, rates: np.ndarray, effects: Profiles, *, mixer: np.ndarray
) -> np.ndarray:
    total, moments = T.sum(axis=1), T @ mixer
    thrust = 1 - effects.get("thrust", 0.0)
    right, forward = p["y_c"] + effects.get("cg_right", 0.0), p["x_c"] + effects.get("cg_forward", 0.0)
    r_p, r_q, r_r = rates.T
    out = np.empty((len(w), 3))
    out[:, 0] = p["a_p"] * thrust * (moments[:, 0] + right * total) - p["j_p"] * r_q * r_r - p["d_p"] * r_p
    out[:, 1] = p["a_q"] * thrust * (moments[:, 1] - forward * total) + p["j_q"] * r_p * r_r - p["d_q"] * r_q
    out[:, 2] = p["a_r"] * (moments[:, 2] + p["n_c"] * total) - p["d_r"] * r_r
    out[:, 2] += p["spin"] * np.gradient(w @ mixer[:, 2], DT)
    return out


def _euler_rates(attitude: np.ndarray, rates: np.ndarray) -> np.ndarray:
    phi, theta, _ = attitude.T
    p, q, r = rates.T
    turn = np.sin(phi) * q + np.cos(phi) * r
    return np.stack([p + np.tan(theta) * turn, np.cos(phi) * q - np.sin(phi) * r, turn / np.cos(theta)], axis=1)
