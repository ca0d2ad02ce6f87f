"""Airframes of simulated multirotors: mass, inertia, rotors and drag in the parameters of RotorPy, with variations.

Source: parameter names and orders of magnitude of RotorPy (Folk, Paulos & Kumar 2023), scaled to a 10-inch and an
18-inch quadrotor; thrust to weight 2.3 and 2.1.
"""

from typing import NamedTuple

import numpy as np

# motor 1 front right, 2 rear left, 3 front left, 4 rear right: forward and left arm, in arm lengths [-]
ARMS = ((1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0))
SPINS = (-1.0, -1.0, 1.0, 1.0)  # sign of the reaction torque about the upward axis; motors 1 and 2 turn to the left


class MultirotorType(NamedTuple):
    """One airframe; the unit of each value is that of RotorPy."""

    mass: float  # [kg]
    inertia: tuple[float, float, float]  # Ixx, Iyy, Izz [kg m2]
    arm: float  # forward and sideways distance of each rotor from the centre [m]
    top_speed: float  # of a rotor [rad/s]
    k_eta: float  # thrust [N s2/rad2]
    k_m: float  # reaction torque [N m s2/rad2]
    k_d: float  # rotor drag, linear in airspeed and rotor speed [kg/rad]
    k_z: float  # thrust lost in a climb [kg/rad]
    k_h: float  # translational lift [kg/m]
    drag: tuple[float, float, float]  # of the frame, quadratic in airspeed [kg/m]
    tau_m: float  # time constant of motors [s]
    expo: float  # thrust curve of motor and propeller: thrust = (1 - expo) u + expo u^2 [-]
    cg: tuple[float, float] = (0.0, 0.0)  # centre of gravity, forward and left of the centre of the rotors [m]


TYPES = {
    "quad": MultirotorType(
        *(1.5, (0.029, 0.029, 0.055), 0.18, 1000.0, 8.5e-6, 1.4e-7, 8.5e-5, 2.0e-4, 3.0e-3),
        *((0.018, 0.018, 0.03), 0.04, 0.65),
    ),
    "quad_large": MultirotorType(
        *(6.3, (0.18, 0.20, 0.33), 0.32, 550.0, 1.07e-4, 2.1e-6, 5.0e-4, 1.1e-3, 1.0e-2),
        *((0.06, 0.06, 0.10), 0.07, 0.6),
    ),
}
_SPREAD = {"mass": 0.05, "k_eta": 0.03, "k_m": 0.05, "k_d": 0.12, "k_z": 0.1, "k_h": 0.1, "tau_m": 0.1, "expo": 0.05}
_DRAG_SPREAD, _MOTOR_SPREAD = 0.12, 0.015  # of the frame drag; between the motors of one aircraft [-]


def draw_airframe(kind: MultirotorType, rng: np.random.Generator) -> tuple[MultirotorType, np.ndarray]:
    """Draw one aircraft of a type: its parameters, and the relative rotor speed of each motor (4,) [-]."""
    factors = {name: 1 + spread * _normal(rng) for name, spread in _SPREAD.items()}
    values = {name: getattr(kind, name) * factor for name, factor in factors.items()}
    drag = 1 + _DRAG_SPREAD * _normal(rng)
    values["drag"] = tuple(drag * c for c in kind.drag)
    values["inertia"] = tuple(factors["mass"] * i for i in kind.inertia)
    motors = np.array([1 + _MOTOR_SPREAD * _normal(rng) for _ in ARMS])
    return kind._replace(**values), motors


def _normal(rng: np.random.Generator) -> float:
    return float(np.clip(rng.standard_normal(), -2, 2))


def rotorpy_parameters(kind: MultirotorType) -> dict:
    """Return the parameters as RotorPy takes them; forward, left, up."""
    Ixx, Iyy, Izz = kind.inertia
    c_Dx, c_Dy, c_Dz = kind.drag
    centre = np.array([*kind.cg, 0.0])
    return {
        "mass": kind.mass,
        "Ixx": Ixx,
        "Iyy": Iyy,
        "Izz": Izz,
        "Ixy": 0.0,
        "Ixz": 0.0,
        "Iyz": 0.0,
        "num_rotors": 4,
        "rotor_directions": np.array(SPINS),
        "rotor_speed_min": 0.0,
        "rotor_pos": {f"r{k + 1}": kind.arm * np.array([*arm, 0.0]) - centre for k, arm in enumerate(ARMS)},
        "rotor_speed_max": kind.top_speed,
        "k_eta": kind.k_eta,
        "k_m": kind.k_m,
        "k_d": kind.k_d,
        "k_z": kind.k_z,
        "k_h": kind.k_h,
        "k_flap": 0.0,
        "tau_m": kind.tau_m,
        "c_Dx": c_Dx,
        "c_Dy": c_Dy,
        "c_Dz": c_Dz,
    }


def hover_thrust(kind: MultirotorType) -> float:
    """Return weight over maximum thrust [-]."""
    return kind.mass * 9.81 / (4 * kind.k_eta * kind.top_speed**2)
