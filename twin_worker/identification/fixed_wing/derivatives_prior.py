"""Prior of an aircraft's derivatives before its first flight, from its airframe or its class.

Classes are scaled so that lift equals weight at the flown speed: with k = V / U0 and l = b / span of the aircraft,
forces per velocity grow with k, moments per deflection with l, per rate with k, per velocity with k l.
"""

from math import cos

import numpy as np

from fleet.airframes import Airframe, derivatives
from fleet.frames import G
from fleet.physics.wrench import NAMES, OFFSETS

_DOUBT = {  # added to the derivative's magnitude; the sum is scaled by `doubt` of the airframe
    "X": {"0": 2.0, "u": 0.2, "w": 0.3, "de": 1.2, "dt": 1.0, "ww": 0.05},
    "Z": {"0": 3.0, "u": 0.3, "w": 0.3, "q": 0.3, "de": 1.0},
    "M": {"0": 3.0, "u": 0.05, "w": 0.01, "q": 0.1, "de": 0.1, "dt": 1.0},
    "Y": {"v": 0.05, "p": 0.3, "r": 0.3, "da": 0.4, "dr": 0.4, "0": 0.5},
    "L": {"v": 0.01, "p": 0.1, "r": 0.1, "da": 0.1, "dr": 0.1, "0": 2.0},
    "N": {"v": 0.01, "p": 0.1, "r": 0.1, "da": 0.1, "dr": 0.1, "0": 0.5},
}
_FLOOR = {f"{row}_{per}": doubt for row, doubts in _DOUBT.items() for per, doubt in doubts.items()}
_ACROSS = {"L_r": ("L_p", 0.3), "N_p": ("L_p", 0.3), "L_dr": ("L_da", 0.1), "N_da": ("L_da", 0.1)}
_WIND = 2.0  # standard deviation of the wind estimate [m/s]
_SPANS = 0.3, 20.0  # valid range [m]


def prior(airframe: Airframe, at: np.ndarray, trim: np.ndarray, wind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the parameters of `fleet.physics.wrench`, each (37,).

    Args:
        airframe: the aircraft or its class; without a span it is scaled by its speed
        trim_velocity: U0, W0, mean air-relative velocity forward and down, (2,) [m/s]
        trim: mean inputs delta_a delta_e delta_r delta_t, (4,)
        wind: mean wind, NED, the direction it blows to, (2,) or (3,) [m/s]
    """
    mean = dict.fromkeys(NAMES, 0.0)
    floor = dict(_FLOOR)
    if airframe.scale:
        k = airframe.value["speed"] / at[0]
        l = airframe.value["b"] / float(np.clip(airframe.span, *_SPANS)) if airframe.span else k
        mean |= {n: v * _scale(n, k, l) for n, v in derivatives(airframe, airframe.value["speed"]).items()}
        floor |= {n: _FLOOR[n] * l for n in ("M_0", "M_dt", "L_0", "N_0")}
    else:
        mean |= derivatives(airframe, float(at[0]))
    mean["X_0"] = G * at[1] / at[0] - mean["X_dt"] * trim[3] - mean["X_de"] * trim[1]
    mean["Z_0"] = -G * cos(at[1] / at[0]) - mean["Z_de"] * trim[1]
    mean["M_0"] = -mean["M_de"] * trim[1] - mean["M_dt"] * trim[3]
    for name, (of, share) in _ACROSS.items():
        floor[name] += share * abs(mean[of])
    par = np.array([mean[name] for name in NAMES])
    known = np.abs(par)
    known[list(OFFSETS)] = 0.0
    sigma = airframe.value["doubt"] * (known + [floor.get(name, 0.0) for name in NAMES])
    par[-2:], sigma[-2:] = wind[:2], _WIND
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
