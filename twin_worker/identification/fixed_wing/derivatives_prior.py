"""Prior of an aircraft's derivatives before its first flight, from its airframe or its class.

Classes are scaled so that lift equals weight at the flown speed: with k = V / U0 and l = b / span of the aircraft,
forces per velocity grow with k, moments per deflection with l, per rate with k, per velocity with k l.
"""

from math import cos

import numpy as np

from fleet.airframes import Airframe, derivatives
from fleet.frames import G
from fleet.physics.wrench import NAMES, OFFSETS

_SIGMA_TABLE = {  # added to the derivative's magnitude; the sum is scaled by `doubt` of the airframe
    "X": {"0": 2.0, "u": 0.2, "w": 0.3, "de": 1.2, "dt": 1.0, "ww": 0.05},
    "Z": {"0": 3.0, "u": 0.3, "w": 0.3, "q": 0.3, "de": 1.0},
    "M": {"0": 3.0, "u": 0.05, "w": 0.01, "q": 0.1, "de": 0.1, "dt": 1.0},
    "Y": {"v": 0.05, "p": 0.3, "r": 0.3, "da": 0.4, "dr": 0.4, "0": 0.5},
    "L": {"v": 0.01, "p": 0.1, "r": 0.1, "da": 0.1, "dr": 0.1, "0": 2.0},
    "N": {"v": 0.01, "p": 0.1, "r": 0.1, "da": 0.1, "dr": 0.1, "0": 0.5},
}
_SIGMA_FLOOR = {f"{row}_{per}": sigma for row, row_sigmas in _SIGMA_TABLE.items() for per, sigma in row_sigmas.items()}
_CROSS_TERMS = {"L_r": ("L_p", 0.3), "N_p": ("L_p", 0.3), "L_dr": ("L_da", 0.1), "N_da": ("L_da", 0.1)}
_WIND_SIGMA = 2.0  # standard deviation of the wind estimate [m/s]
_SPAN_RANGE = 0.3, 20.0  # valid range [m]


def prior(
    airframe: Airframe, trim_velocity: np.ndarray, trim: np.ndarray, wind: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the parameters of `fleet.physics.wrench`, each (37,).

    Args:
        airframe: the aircraft or its class; without a span it is scaled by its speed
        trim_velocity: U0, W0, mean air-relative velocity forward and down, (2,) [m/s]
        trim: mean inputs delta_a delta_e delta_r delta_t, (4,)
        wind: mean wind, NED, the direction it blows to, (2,) or (3,) [m/s]
    """
    mean = dict.fromkeys(NAMES, 0.0)
    floor = dict(_SIGMA_FLOOR)
    if airframe.scale:
        k = airframe.value["speed"] / trim_velocity[0]
        l = airframe.value["b"] / float(np.clip(airframe.span, *_SPAN_RANGE)) if airframe.span else k
        mean |= {n: v * _scale(n, k, l) for n, v in derivatives(airframe, airframe.value["speed"]).items()}
        floor |= {n: _SIGMA_FLOOR[n] * l for n in ("M_0", "M_dt", "L_0", "N_0")}
    else:
        mean |= derivatives(airframe, float(trim_velocity[0]))
    mean["X_0"] = G * trim_velocity[1] / trim_velocity[0] - mean["X_dt"] * trim[3] - mean["X_de"] * trim[1]
    mean["Z_0"] = -G * cos(trim_velocity[1] / trim_velocity[0]) - mean["Z_de"] * trim[1]
    mean["M_0"] = -mean["M_de"] * trim[1] - mean["M_dt"] * trim[3]
    for name, (main, fraction) in _CROSS_TERMS.items():
        floor[name] += fraction * abs(mean[main])
    par = np.array([mean[name] for name in NAMES])
    magnitude = np.abs(par)
    magnitude[list(OFFSETS)] = 0.0
    sigma = airframe.value["doubt"] * (magnitude + [floor.get(name, 0.0) for name in NAMES])
    par[-2:], sigma[-2:] = wind[:2], _WIND_SIGMA
    return par, sigma


def _scale(name: str, k: float, l: float) -> float:
    """Return the scale factor from speed and span of the class to those of the aircraft."""
    force, per = name[0] in "XYZ", name[2:]
    if per in ("q", "p", "r"):
        return k * k / l if force else k
    if per == "ww":
        return k * k
    power = k if per in ("u", "v", "w") else 1.0
    return power if force else power * l
