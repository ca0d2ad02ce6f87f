"""Rotor model: thrust and drag of a multirotor from its motor inputs, and the answer of its attitude to the command.

With u_i the input of motor i, the relative thrusts T_i, their mean T, the mean relative rotor speed w, the velocity
through the air (u, v, w_b) = R' (V - wind) and the airspeed Va:

    T_i = (1 - e) u_i + e u_i^2,   w = mean sqrt(T_i)
    f_x = -(d w + c Va) u,   f_y = -(d w + c Va) v
    f_z = -k T - (k_c w + c Va) w_b - k_h (u^2 + v^2)
    V'  = R(phi + phi_0, theta + theta_0, psi) f + g
    phi''   = wn_phi^2 (phi_c + b_phi - phi) - 2 zeta_phi wn_phi phi'
    theta'' likewise

An autopilot stabilises the attitude, so its answer to the commanded attitude is the model, not that to the single
motors: without the autopilot a multirotor is unstable, and a free run from its motor outputs diverges within seconds.

Source: Beard & McLain 2012, ch. 14 (rotor thrust); Faessler, Franchi & Scaramuzza 2018 (rotor drag); Svacha, Mohta &
Kumar 2017 (drag and rotor speed, translational lift); Kamel, Burri & Siegwart 2017 (second-order answer of the
attitude to its command).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, sin, sqrt

import numba as nb
import numpy as np

from fleet.frames import G
from twin_worker.identification.multirotor.rotor_window import DT, RotorWindow

VELOCITY_PARAMETERS = ("k", "e", "k_c", "k_h", "d", "c", "w_n", "w_e", "phi_0", "theta_0")
ATTITUDE_PARAMETERS = ("wn_phi", "zeta_phi", "b_phi", "wn_theta", "zeta_theta", "b_theta")
PARAMETERS = VELOCITY_PARAMETERS + ATTITUDE_PARAMETERS
"""k [m/s2], e [-], k_c [1/s], k_h [1/m], d [1/s], c [1/m], w_n w_e [m/s], phi_0 theta_0 [rad], wn [rad/s], zeta [-],
b [rad]."""
N_VELOCITY, N_PAR = len(VELOCITY_PARAMETERS), len(PARAMETERS)
STATES = ("v_n", "v_e", "v_d", "phi", "theta")
"""Predicted states, NED [m/s] and [rad]; the start of a run has the rates of phi and theta too."""
N_START = 9  # v_n v_e v_d phi theta, rates of phi and theta, gust north and east
_EXPO, _EXPO_STD = 0.6, 0.1  # thrust curve where the autopilot does not report one, and error of its value [-]
_EXPO_NAMES = ("MOT_THST_EXPO", "THR_MDL_FAC")
_MEAN = np.array([0.0, 0.0, 0.4, 0.002, 0.2, 0.01, 0.0, 0.0, 0.0, 0.0, 8.0, 0.8, 0.0, 8.0, 0.8, 0.0])
_STD = np.array([0.0, 0.0, 0.3, 0.003, 0.12, 0.006, 6.0, 6.0, 0.02, 0.02, 4.0, 0.3, 0.02, 4.0, 0.3, 0.02])
_RETENTION = 0.8  # retained fraction of the information of earlier flight [-]
_DRIFT_STD = np.array([0.0] * 6 + [1.5, 1.5] + [0.0] * 8)  # change of the mean wind since then [m/s]
_THRUST_STD = 0.3  # of the full thrust, relative to that which the mean input of the flight carries [-]
LOW = np.array([1.0, 0.0, 0.0, -0.02, 0.0, 0.0, -30.0, -30.0, -0.2, -0.2, 1.0, 0.3, -0.2, 1.0, 0.3, -0.2])
HIGH = np.array([300.0, 1.2, 4.0, 0.05, 2.0, 0.1, 30.0, 30.0, 0.2, 0.2, 40.0, 2.0, 0.2, 40.0, 2.0, 0.2])
"""Limits of the parameters: outside of them a run may leave the flight envelope."""


@dataclass(frozen=True)
class RotorModel:
    """Identified rotor model.

    Attributes:
        par: values in the order of `PARAMETERS`, (16,)
        information: of the flight, and of the prior, (16, 16)
        prior_precision: of the prior alone, (16, 16)
        weight: of the residuals of `STATES`, inverse variances, (5,)
        has_command: the commanded attitude was known; without it the attitude parameters are those of the prior
        hover: mean motor input of the flight [-]
        speed: mean airspeed of the flight [m/s]
        t0, t1: first and last instant of the identification [s since 1970]
        steps: steps of the search
    """

    par: np.ndarray
    information: np.ndarray
    prior_precision: np.ndarray
    weight: np.ndarray
    has_command: bool
    hover: float
    speed: float
    t0: float
    t1: float
    steps: int

    @property
    def covariance(self) -> np.ndarray:
        """Return the covariance of the parameters, (16, 16)."""
        return np.linalg.inv(self.information)

    def __str__(self) -> str:
        return (
            f"thrust over mass {self.thrust:.2f} ± {self.thrust_std:.2f} m/s2 at a motor input of "
            f"{100 * self.hover:.0f} %, drag {self.drag:.3f} ± {self.drag_std:.3f} 1/s at {self.speed:.0f} m/s, wind "
            f"{np.hypot(*self.wind):.1f} m/s"
        )

    @property
    def wind(self) -> np.ndarray:
        """Return the mean wind, north and east, the direction it blows to, (2,) [m/s]."""
        return self.par[[PARAMETERS.index("w_n"), PARAMETERS.index("w_e")]]

    @property
    def _relative_thrust(self) -> float:
        """Return the thrust at the mean motor input of the flight over that at full input [-]."""
        e = float(self.par[PARAMETERS.index("e")])
        return (1 - e) * self.hover + e * self.hover**2

    @property
    def drag(self) -> float:
        """Return the drag over airspeed at the rotor speed and the airspeed of the flight [1/s]."""
        d, c = self.par[[PARAMETERS.index(name) for name in ("d", "c")]]
        return float(d * np.sqrt(self._relative_thrust) + c * self.speed)

    @property
    def drag_std(self) -> float:
        """Return the standard deviation of `drag` [1/s]."""
        slope = np.zeros(N_PAR)
        slope[PARAMETERS.index("d")] = np.sqrt(self._relative_thrust)
        slope[PARAMETERS.index("c")] = self.speed
        return float(np.sqrt(slope @ self.covariance @ slope))

    @property
    def thrust(self) -> float:
        """Return the thrust over mass at the mean motor input of the flight [m/s2]."""
        return float(self.par[0] * self._relative_thrust)

    @property
    def thrust_std(self) -> float:
        """Return the standard deviation of `thrust` [m/s2]."""
        slope = np.array([self._relative_thrust, self.par[0] * (self.hover**2 - self.hover)])
        return float(np.sqrt(slope @ self.covariance[:2, :2] @ slope))


def prior(window: RotorWindow, params: Mapping[str, float], base: RotorModel | None) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and precision of the parameters before the window, (16,) and (16, 16).

    Before any flight the full thrust is that which carries the aircraft at the mean motor input of the window; later
    the base, a model of earlier flight, is known better than the flight after it, except its wind.
    """
    if base is not None:
        covariance = base.covariance / _RETENTION
        covariance[np.diag_indices(N_PAR)] += _DRIFT_STD**2
        return base.par, np.linalg.inv(covariance)
    mean, std = _MEAN.copy(), _STD.copy()
    expo = next((params[name] for name in _EXPO_NAMES if 0.0 <= params.get(name, -1.0) <= 1.0), _EXPO)
    T, _ = thrust_and_speed(window.inputs[window.ok], expo)
    tilt = np.cos(window.attitude[window.ok, 0]) * np.cos(window.attitude[window.ok, 1])
    mean[:2] = G / max(float((T * tilt).mean()), 1e-2), expo
    std[:2] = _THRUST_STD * mean[0], _EXPO_STD
    return np.clip(mean, LOW, HIGH), np.diag(std**-2.0)


def thrust_and_speed(inputs: np.ndarray, e: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean relative thrust and rotor speed of motor inputs (n, m), (n,) each [-]."""
    T = np.maximum((1 - e) * inputs + e * inputs**2, 0.0)
    return T.mean(axis=1), np.sqrt(T).mean(axis=1)


def start_states(window: RotorWindow, rows: np.ndarray) -> np.ndarray:
    """Return the measured states at rows (k,) without a gust, (k, 9)."""
    no_gust = np.zeros((len(rows), 2))
    return np.concatenate([window.velocity[rows], window.attitude[rows, :2], window.rates[rows], no_gust], axis=1)


def free_run(
    par: np.ndarray, window: RotorWindow, rows: np.ndarray, starts: np.ndarray, length: int, *, commanded: bool
) -> np.ndarray:
    """Simulate runs of `length` steps from start states.

    Args:
        par: parameters, (16,)
        window: motor inputs, heading, and the commanded or measured attitude
        rows: first row of each run, (k,)
        starts: states there, and the gust of the run, (k, 9)
        length: steps
        commanded: the attitude answers to the command; otherwise it is the measured one
    Returns:
        `STATES` from the start on, (k, length + 1, 5)
    """
    T, speed = thrust_and_speed(window.inputs, float(par[1]))
    out = np.empty((len(rows), length + 1, len(STATES)))
    _simulate(par, T, speed, window.attitude, window.command, rows, starts, commanded, out)
    return out


@nb.njit(cache=True, nogil=True)
def _simulate(
    par: np.ndarray,
    T: np.ndarray,
    rotor_speed: np.ndarray,
    attitude: np.ndarray,
    command: np.ndarray,
    rows: np.ndarray,
    starts: np.ndarray,
    commanded: bool,
    out: np.ndarray,
) -> None:
    phi_0, theta_0 = par[8], par[9]
    for run in range(len(rows)):
        row = rows[run]
        n, e, d, phi, theta, phi_rate, theta_rate = starts[run, :7]
        w_n, w_e = par[6] + starts[run, 7], par[7] + starts[run, 8]
        for step in range(out.shape[1]):
            out[run, step, 0] = n
            out[run, step, 1] = e
            out[run, step, 2] = d
            out[run, step, 3] = phi
            out[run, step, 4] = theta
            if step == out.shape[1] - 1:
                break
            thrust, w = 0.5 * (T[row] + T[row + 1]), 0.5 * (rotor_speed[row] + rotor_speed[row + 1])
            f_n, f_e, f_d = _acceleration(
                par, n - w_n, e - w_e, d, phi + phi_0, theta + theta_0, attitude[row, 2], thrust, w
            )
            if commanded:
                phi_c = 0.5 * (command[row, 0] + command[row + 1, 0]) + par[12]
                theta_c = 0.5 * (command[row, 1] + command[row + 1, 1]) + par[15]
                phi, phi_rate = _second_order(phi, phi_rate, phi_c, par[10], par[11])
                theta, theta_rate = _second_order(theta, theta_rate, theta_c, par[13], par[14])
            else:
                phi, theta = attitude[row + 1, 0], attitude[row + 1, 1]
            row += 1
            l_n, l_e, l_d = _acceleration(  # at the end of the step
                par,
                n + DT * f_n - w_n,
                e + DT * f_e - w_e,
                d + DT * f_d,
                phi + phi_0,
                theta + theta_0,
                attitude[row, 2],
                thrust,
                w,
            )
            n, e, d = n + 0.5 * DT * (f_n + l_n), e + 0.5 * DT * (f_e + l_e), d + 0.5 * DT * (f_d + l_d)


@nb.njit(cache=True, nogil=True)
def _second_order(x: float, rate: float, target: float, wn: float, zeta: float) -> tuple[float, float]:
    """Return the state of a second-order lag one step later, the target constant, by RK4 in half steps."""
    h = 0.5 * DT
    for _ in range(2):
        a1 = wn * wn * (target - x) - 2.0 * zeta * wn * rate
        r2 = rate + 0.5 * h * a1
        a2 = wn * wn * (target - x - 0.5 * h * rate) - 2.0 * zeta * wn * r2
        r3 = rate + 0.5 * h * a2
        a3 = wn * wn * (target - x - 0.5 * h * r2) - 2.0 * zeta * wn * r3
        r4 = rate + h * a3
        a4 = wn * wn * (target - x - h * r3) - 2.0 * zeta * wn * r4
        x += h / 6.0 * (rate + 2.0 * r2 + 2.0 * r3 + r4)
        rate += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    return x, rate


@nb.njit(cache=True, nogil=True)
def _acceleration(
    par: np.ndarray,
    north: float,
    east: float,
    down: float,
    phi: float,
    theta: float,
    psi: float,
    thrust: float,
    w: float,
) -> tuple[float, float, float]:
    """Return the acceleration NED at a velocity through the air, NED, and an attitude."""
    k, k_c, k_h, d, c = par[0], par[2], par[3], par[4], par[5]
    sf, cf, st, ct, sp, cp = sin(phi), cos(phi), sin(theta), cos(theta), sin(psi), cos(psi)
    r01, r02 = sf * st * cp - cf * sp, cf * st * cp + sf * sp
    r11, r12 = sf * st * sp + cf * cp, cf * st * sp - sf * cp
    u = ct * cp * north + ct * sp * east - st * down
    v = r01 * north + r11 * east + sf * ct * down
    b = r02 * north + r12 * east + cf * ct * down
    Va = sqrt(u * u + v * v + b * b)
    drag = d * w + c * Va
    f_x, f_y, f_z = -drag * u, -drag * v, -k * thrust - (k_c * w + c * Va) * b - k_h * (u * u + v * v)
    return (
        ct * cp * f_x + r01 * f_y + r02 * f_z,
        ct * sp * f_x + r11 * f_y + r12 * f_z,
        -st * f_x + sf * ct * f_y + cf * ct * f_z + G,
    )
