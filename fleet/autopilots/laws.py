"""Common interface of all control laws; the last element of `par` selects the law.

    par, absent = parameters(law, values, altitude_m)         law: a name in LAWS
    ctl = init(par, legs, k, start, p, v, euler, Va, theta_c, delta_t)
    phi_c, theta_c, delta_t = guide(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
    delta_a, delta_e, delta_r = stabilise(ctl, par, phi_c, theta_c, euler, rates, Va, dt)

All but `parameters` are compiled, change `ctl` in place and have the arguments of the ArduPlane law. The replay on
telemetry is in `shadow`. To add a law, add a folder with `parameters, init, begin, fly, stabilise, align_integrators,
LAW` and a branch in each function below.
"""

from collections.abc import Callable, Mapping
from math import hypot
from typing import NamedTuple

import numba as nb
import numpy as np

from fleet.autopilots import arduplane, px4_fixedwing, textbook
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.arduplane.guide import align_integrators as shift_arduplane
from fleet.autopilots.arduplane.guide import assume_commanded_speed
from fleet.autopilots.arduplane.guide import fly as fly_arduplane
from fleet.autopilots.control_law import (
    ARDUPLANE,
    COURSE,
    FOLLOW_LINE,
    H_IN,
    HAS_VELOCITY,
    LAW,
    LEG,
    N_LEG,
    NEXT_LEG,
    NEXT_S,
    PX4,
    SWITCH_LEG,
    SWITCH_S,
    TEXTBOOK,
    V_D,
    V_E,
    V_HAT,
    V_N,
    W_E,
    W_N,
    ParameterSpec,
    array_kernel,
    kernel,
    lookup,
    padded,
)

inlined = nb.njit(cache=True, error_model="numpy", inline="always")


class ControlLaw(NamedTuple):
    """One control law: description, code in `par`, parameter function, parameter names and parameter table."""

    description: str
    code: float
    parameters: Callable[[Mapping[str, float], float], tuple[np.ndarray, tuple[str, ...]]]
    names: tuple[str, ...]
    table: tuple[ParameterSpec, ...]

    @property
    def defaults(self) -> dict[str, float]:
        """Return the defaults by name, in the units of the autopilot."""
        return {row.name: float(row.default) for row in self.table}


LAWS = {
    "arduplane": ControlLaw(arduplane.LAW, ARDUPLANE, arduplane.parameters, arduplane.NAMES, arduplane.TABLE),
    "px4": ControlLaw(px4_fixedwing.LAW, PX4, px4_fixedwing.parameters, px4_fixedwing.NAMES, px4_fixedwing.TABLE),
    "px4_l1": ControlLaw(
        px4_fixedwing.LAW_L1, PX4, px4_fixedwing.l1_parameters, px4_fixedwing.L1_NAMES, px4_fixedwing.L1_TABLE
    ),
    "textbook": ControlLaw(textbook.LAW, TEXTBOOK, textbook.parameters, textbook.NAMES, textbook.TABLE),
}
NAMES = frozenset(name for law in LAWS.values() for name in law.names)
"""Names of all parameters that at least one law reads."""


def parameters(law: str, values: Mapping[str, float], altitude_m: float = 0.0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert autopilot parameters to the parameter vector of one law, without wind.

    Args:
        law: name in `LAWS`
        values: parameters in the names and units of the autopilot
        altitude_m: height above mean sea level [m]
    Returns:
        par: (N_PAR,)
        absent: names that are missing, not finite or out of range; `par` contains their defaults
    """
    par, absent = LAWS[law].parameters(values, altitude_m)
    return (padded(par, ARDUPLANE) if law == "arduplane" else par), absent


def vector(law: str, resolved: Mapping[str, float], altitude_m: float = 0.0) -> np.ndarray:
    """Convert the result of `read` to the parameter vector of one law, without wind, (N_PAR,)."""
    if law == "arduplane":
        return padded(arduplane.vector(resolved, altitude_m), ARDUPLANE)
    return LAWS[law].parameters(resolved, altitude_m)[0]


def read(law: str, values: Mapping[str, float]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return all parameters of a law by current name, in the units of the autopilot, and the names at defaults."""
    if law == "arduplane":
        return arduplane.read(values)
    matches = {row.name: lookup(row, values) for row in LAWS[law].table}
    absent = tuple(name for name, value in matches.items() if value is None)
    return {**LAWS[law].defaults, **{name: value for name, value in matches.items() if value is not None}}, absent


def with_wind(par: np.ndarray, w_n: float, w_e: float) -> np.ndarray:
    """Return a copy of `par` with a wind, NED, direction it blows to [m/s]."""
    par = par.copy()
    par[W_N], par[W_E] = w_n, w_e
    return par


@inlined
def law_code(par: np.ndarray) -> float:
    """Return the code of the law; a last element that is no code belongs to an ArduPlane vector."""
    return par[par.shape[0] + LAW]


@array_kernel
def init(
    par: np.ndarray,
    legs: np.ndarray,
    k: int,
    start: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    euler: np.ndarray,
    Va: float,
    theta_c: float,
    delta_t: float,
) -> np.ndarray:
    """Initialise on leg `k` with bumpless transfer of pitch and throttle; arguments as for `arduplane.init`."""
    law = law_code(par)
    if law == PX4:
        return px4_fixedwing.init(par, legs, k, start, p, v, euler, Va, theta_c, delta_t)
    if law == TEXTBOOK:
        return textbook.init(par, legs, k, start, p, v, euler, Va, theta_c, delta_t)
    return arduplane.init(par, legs, k, start, p, v, euler, Va, theta_c, delta_t)


@array_kernel
def engage(
    par: np.ndarray,
    legs: np.ndarray,
    start: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    euler: np.ndarray,
    Va: float,
    theta_c: float,
    delta_t: float,
) -> np.ndarray:
    """Initialise on the first leg in steady state of the speed demand; arguments as for `init`."""
    ctl = init(par, legs, 0, start, p, v, euler, Va, theta_c, delta_t)
    if law_code(par) >= ARDUPLANE:
        assume_commanded_speed(ctl, par, legs)
    return ctl


@kernel
def _height_states(par: np.ndarray) -> int:
    """Return how many of the states from H_IN on are heights: one with PX4, which has a rate after it."""
    return 1 if law_code(par) == PX4 else 4


@array_kernel
def remember(ctl: np.ndarray, par: np.ndarray, h: float) -> np.ndarray:
    """Return the state for `restore`, with heights relative to the aircraft at height `h` [m], (N_CTL,)."""
    memory = ctl.copy()
    for j in range(H_IN, H_IN + _height_states(par)):
        memory[j] -= h
    return memory


@kernel
def restore(ctl: np.ndarray, par: np.ndarray, memory: np.ndarray, h: float) -> None:
    """Continue speed, height and attitude control from an earlier state, at height `h` [m].

    An autopilot resets none of these when its route changes. The leg, and what is measured, stay as they are in `ctl`.
    """
    if law_code(par) == TEXTBOOK:  # its states beyond the leg describe the route as well
        return
    for j in range(N_LEG, COURSE):
        if j not in (V_N, V_E, V_D, HAS_VELOCITY, V_HAT):
            ctl[j] = memory[j]
    for j in range(H_IN, H_IN + _height_states(par)):
        ctl[j] += h


@kernel
def begin(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, k: int, p: np.ndarray) -> None:
    """Switch to leg `k` at the aircraft position `p`, NED (3,) [m]."""
    law = law_code(par)
    if law == PX4:
        px4_fixedwing.begin(ctl, par, legs, k, p)
    elif law == TEXTBOOK:
        textbook.begin(ctl, par, legs, k, p)
    else:
        leg_rules.begin(ctl, par, legs, k, p)


@kernel
def switch_when_due(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, p: np.ndarray, dt: float) -> None:
    """Count down to the scheduled change of the route, and start its leg at `p`, NED (3,) [m], when it is due."""
    ctl[SWITCH_S] -= dt
    if ctl[SWITCH_S] <= 0.0:
        begin(ctl, par, legs, int(ctl[SWITCH_LEG]), p)
        if law_code(par) >= ARDUPLANE:
            ctl[FOLLOW_LINE] = -1.0
        ctl[SWITCH_S], ctl[SWITCH_LEG] = ctl[NEXT_S], ctl[NEXT_LEG]
        ctl[NEXT_S] = 0.0


@kernel
def fly(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    euler: np.ndarray,
    Va: float,
    Va_dot: float,
    dt: float,
) -> tuple[float, float, float, bool]:
    """Run one guidance step on the current leg; return the result of `guide` and whether the leg is complete."""
    law = law_code(par)
    if law == PX4:
        return px4_fixedwing.fly(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
    if law == TEXTBOOK:
        return textbook.fly(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
    return fly_arduplane(ctl, par, legs, p, v, euler, Va, Va_dot, dt)


@kernel
def _guide_generic(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    euler: np.ndarray,
    Va: float,
    Va_dot: float,
    dt: float,
) -> tuple[float, float, float]:
    """Run one guidance step of a law other than ArduPlane."""
    phi_c, theta_c, delta_t, leg_done = fly(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
    if leg_done and int(ctl[LEG]) + 1 < legs.shape[0]:
        begin(ctl, par, legs, int(ctl[LEG]) + 1, p)
    return phi_c, theta_c, delta_t


@kernel
def guide(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    euler: np.ndarray,
    Va: float,
    Va_dot: float,
    dt: float,
) -> tuple[float, float, float]:
    """Run one guidance step at about 10 Hz; switch to the next leg when one is complete, and stay on the last.

    Arguments and result as for `arduplane.guide`.
    """
    if ctl[SWITCH_S] > 0.0:
        switch_when_due(ctl, par, legs, p, dt)
    if law_code(par) < ARDUPLANE:
        return _guide_generic(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
    # `arduplane.guide` inlined: a further call costs 10 % of the time
    phi_c, theta_c, delta_t, leg_done = fly_arduplane(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
    if leg_done and int(ctl[LEG]) + 1 < legs.shape[0]:
        leg_rules.begin(ctl, par, legs, int(ctl[LEG]) + 1, p)
    return phi_c, theta_c, delta_t


@inlined
def stabilise(
    ctl: np.ndarray,
    par: np.ndarray,
    phi_c: float,
    theta_c: float,
    euler: np.ndarray,
    rates: np.ndarray,
    Va: float,
    dt: float,
) -> tuple[float, float, float]:
    """Return the surfaces for a commanded attitude at about 50 Hz; arguments as for `arduplane.stabilise`."""
    law = law_code(par)
    if law >= ARDUPLANE:
        return arduplane.stabilise(ctl, par, phi_c, theta_c, euler, rates, Va, dt)
    if law == PX4:
        return px4_fixedwing.stabilise(ctl, par, phi_c, theta_c, euler, rates, Va, dt)
    return textbook.stabilise(ctl, par, phi_c, theta_c, euler, rates, Va, dt)


@kernel
def align_integrators(ctl: np.ndarray, par: np.ndarray, residual: np.ndarray, reported: np.ndarray) -> None:
    """Shift the integrators by the output residuals; arguments as for ArduPlane."""
    law = law_code(par)
    if law == PX4:
        px4_fixedwing.align_integrators(ctl, par, residual, reported)
    elif law == TEXTBOOK:
        textbook.align_integrators(ctl, par, residual, reported)
    else:
        shift_arduplane(ctl, par, residual, reported)


@kernel
def height_demand(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, p: np.ndarray, v: np.ndarray) -> float:
    """Return the height demand above the origin [m]; p, v: position and ground velocity, NED, (3,)."""
    law = law_code(par)
    if law == PX4:
        return px4_fixedwing.height_demand(ctl, par, legs, p, hypot(v[0], v[1]))
    if law == TEXTBOOK:
        return textbook.height_demand(ctl, legs, p)
    return leg_rules.height_demand(ctl, par, legs, p)
