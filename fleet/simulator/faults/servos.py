"""Servo faults between the output of the flight controller and the surface.

Commands and surfaces are fractions of full travel, -1..1, + rolls right, pitches up, yaws right.
"""

from collections import deque
from collections.abc import Callable, Mapping
from math import exp

SURFACES = ("aileron", "elevator", "rudder")
_OLDEST_S = 2.0  # length of the buffer of commands

Move = Callable[[float, float], float]
"""(command, intensity of the fault) to surface; may have state."""


def _lag(values: Mapping[str, float], dt: float) -> Move:
    at: list[float] = []

    def move(u: float, share: float) -> float:
        tau = share * values["tau_s"]
        past = at[0] if at else u
        at[:] = [u + (past - u) * exp(-dt / tau) if tau > 0 else u]
        return at[0]

    return move


def _delay(values: Mapping[str, float], dt: float) -> Move:
    said: deque[float] = deque(maxlen=round(_OLDEST_S / dt))

    def move(u: float, share: float) -> float:
        said.appendleft(u)
        return said[min(round(share * values["delay_s"] / dt), len(said) - 1)]

    return move


def _rate_limit(values: Mapping[str, float], dt: float) -> Move:
    at: list[float] = []

    def move(u: float, share: float) -> float:
        past = at[0] if at else u
        most = values["rate_per_s"] * dt / share if share > 0 else 2.0
        at[:] = [past + min(max(u - past, -most), most)]
        return at[0]

    return move


def _deadband(values: Mapping[str, float], dt: float) -> Move:
    at: list[float] = []

    def move(u: float, share: float) -> float:
        half, past = share * values["half_width"], at[0] if at else u
        at[:] = [min(max(past, u - half), u + half)]  # backlash
        return at[0]

    return move


def _saturation(values: Mapping[str, float], dt: float) -> Move:
    def move(u: float, share: float) -> float:
        most = 1 - share * (1 - values["limit"])
        return min(max(u, -most), most)

    return move


def _offset(values: Mapping[str, float], dt: float) -> Move:
    return lambda u, share: min(max(u + share * values["offset"], -1.0), 1.0)


def _stuck(values: Mapping[str, float], dt: float) -> Move:
    at: list[float] = [values["position"]] if "position" in values else []

    def move(u: float, share: float) -> float:
        if share > 0 and not at:
            at.append(u)
        return u + share * (at[0] - u) if at else u

    return move


def _loss(values: Mapping[str, float], dt: float) -> Move:
    return lambda u, share: (1 - share * values["loss"]) * u


MOVES: dict[str, Callable[[Mapping[str, float], float], Move]] = {
    "actuator_lag": _lag,
    "actuator_delay": _delay,
    "actuator_rate_limit": _rate_limit,
    "actuator_deadband": _deadband,
    "actuator_saturation": _saturation,
    "actuator_offset": _offset,
    "actuator_stuck": _stuck,
    "control_effectiveness_loss": _loss,
}

Commands = tuple[float, float, float, float]
"""delta_a, delta_e, delta_r, delta_t."""
