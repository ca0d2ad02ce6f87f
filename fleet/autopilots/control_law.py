"""Shared by all control laws: controller state `ctl` (indices by name), parameter vector and table, compiled functions.

The elements below N_LEG belong to the current leg; the replay resets them separately.
"""

from collections.abc import Mapping
from math import atan2, isfinite, sqrt
from typing import NamedTuple

import numba as nb
import numpy as np

# the leg
LEG = 0  # index of the current leg
PREV_N, PREV_E, PREV_D = 1, 2, 3  # start of its line, NED [m]
FROM = slice(1, 4)  # slice of the three above
TURN = 4  # turn angle at its end [rad]
ANGLE, BEARING = 5, 6  # angle flown on the circle, last bearing to its centre [rad]
CIRCLE_REACHED, CIRCLING = 7, 8  # 1: circle reached before; 1: now on the circle
TIMER = 9  # time since reaching the circle [s]
EXIT_ANGLE = 10  # circle angle when the exit condition became true, -1 before [rad]
FOLLOW_LINE = 11  # 1: the line starts at a waypoint and is followed even to a circle; -1: no line is followed
N_LEG = 12
# L1
XTRACK, NU = 12, 13  # crosstrack integral, last course error [rad]
# airspeed filter
V_N, V_E, V_D, HAS_VELOCITY = 14, 15, 16, 17  # last ground velocity, NED [m/s]; 1: available
ACCEL, ACCEL_LP = 18, 19  # forward acceleration, low-passed [m/s2]
V_HAT, V_DOT_HAT = 20, 21  # filtered true airspeed [m/s], its bias state [m/s2]
# speed demand
V_DEM, V_DEM_LP, V_TOP = 22, 23, 24  # demanded true airspeed [m/s], low-passed rate [m/s2], upper limit [m/s]
# height demand, up is positive
H_IN, H_LIMITED, H_DEM, H_LAST = 25, 26, 27, 28  # raw, rate-limited, lagged, lagged one step ago [m]
CLIMB_SHARE, SINK_SHARE = 29, 30  # active fraction of the climb and sink limits, 0..1
# energy
STE_LP = 31  # filtered error of the total energy rate [m2/s3]
I_THR, I_SEB, I_KE = 32, 33, 34  # integrators: throttle 0..1, energy balance rate, kinetic energy [m2/s3]
THR, THR_SAT = 35, 36  # throttle before its integrator 0..1; -1, 0, +1 saturated
THETA, THETA_SAT = 37, 38  # pitch demand [rad]; -1, 0, +1 saturated
UNDERSPEED, BAD_DESCENT = 39, 40  # 1: underspeed; 1: bad descent
# rate loops
P_T, Q_T = 41, 42  # filtered rate targets [rad/s]
I_A, I_E = 43, 44  # integrators [rad of surface]
E_A, E_E, D_A, D_E = 45, 46, 47, 48  # last errors [rad/s], filtered derivatives [rad/s2]
S_A, S_E = 49, 50  # last surfaces before the limit, 1 = full throw
# scheduled change of the route
SWITCH_S, SWITCH_LEG = 51, 52  # time until the next change; 0: none [s]; leg that starts then
NEXT_S, NEXT_LEG = 53, 54  # the same of the change after it, its time from the first one on
N_CTL = 55


N_PAR = 72  # length of every parameter vector
W_N, W_E = -3, -2  # wind estimate of the autopilot, NED, direction it blows to [m/s]
LAW = -1  # code of the law, one of the three below
ARDUPLANE, PX4, TEXTBOOK = 0.0, -1.0, -2.0

__all__ = ["ARDUPLANE", "LAW", "N_CTL", "N_PAR", "PX4", "TEXTBOOK", "W_E", "W_N", "padded"]


def padded(law_parameters: np.ndarray, law: float) -> np.ndarray:
    """Pad the parameters of a law (k,) to a parameter vector without wind, (N_PAR,)."""
    par = np.zeros(N_PAR)
    par[: len(law_parameters)] = law_parameters
    par[LAW] = law
    return par


class ParameterSpec(NamedTuple):
    """One parameter: name, default and range in autopilot units, factor to SI, older names with their factor."""

    name: str
    default: float
    factor: float
    low: float
    high: float
    old_names: tuple[tuple[str, float], ...] = ()  # (older name, older unit in units of the new one)


def eas2tas(altitude_m: float) -> float:
    """Return the ratio of true to equivalent airspeed at a height above sea level [m]. Source: ISA, troposphere."""
    h = min(max(altitude_m, -500.0), 11_000.0) if isfinite(altitude_m) else 0.0
    return float((1 - 2.25577e-5 * h) ** (-4.25588 / 2))


def lookup(spec: ParameterSpec, values: Mapping[str, float]) -> float | None:
    """Return the value by current or older name; None if it is missing, not finite or out of range."""
    for name, unit in ((spec.name, 1.0), *spec.old_names):
        value = values.get(name)
        if value is not None and isfinite(value) and spec.low <= value * unit <= spec.high:
            return value * unit
    return None


# no fastmath: nan means "no airspeed sensor"; nothing raises inside
array_kernel = nb.njit(cache=True, error_model="numpy", nogil=True)
# without arrays: reference counting took half of the run time
kernel = nb.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]


@nb.njit(cache=True, error_model="numpy", inline="always")
def hypot(x, y):  # type: ignore[no-untyped-def]
    """Return the length of a horizontal vector, without the overflow checks of `math.hypot`."""
    return sqrt(x * x + y * y)


@kernel
def clip(x: float, low: float, high: float) -> float:
    """Limit x; nan stays nan."""
    return low if x < low else (high if x > high else x)


@kernel
def angle_to(v_n: float, v_e: float, n: float, e: float) -> float:
    """Return the angle from one horizontal vector to another, right positive [rad]."""
    return atan2(v_n * e - v_e * n, v_n * n + v_e * e)
