"""Servo faults between the output of the flight controller and the surface.

Commands and surfaces are fractions of full travel, -1..1, + rolls right, pitches up, yaws right.
"""

from collections import deque
from collections.abc import Callable, Mapping
from math import exp, pi, sin

SURFACES = ("aileron", "elevator", "rudder")
_BUFFER_S = 2.0  # length of the buffer of commands

ServoFault = Callable[[float, float], float]
"""(command, intensity of the fault) to surface; may have state."""


def _lag(values: Mapping[str, float], dt: float) -> ServoFault:
    state: list[float] = []

    def apply(u: float, intensity: float) -> float:
        tau = intensity * values["tau_s"]
        previous = state[0] if state else u
        state[:] = [u + (previous - u) * exp(-dt / tau) if tau > 0 else u]
        return state[0]

    return apply


def _delay(values: Mapping[str, float], dt: float) -> ServoFault:
    history: deque[float] = deque(maxlen=round(_BUFFER_S / dt))

    def apply(u: float, intensity: float) -> float:
        history.appendleft(u)
        return history[min(round(intensity * values["delay_s"] / dt), len(history) - 1)]

    return apply


def _rate_limit(values: Mapping[str, float], dt: float) -> ServoFault:
    state: list[float] = []

    def apply(u: float, intensity: float) -> float:
        previous = state[0] if state else u
        max_step = values["rate_per_s"] * dt / intensity if intensity > 0 else 2.0
        state[:] = [previous + min(max(u - previous, -max_step), max_step)]
        return state[0]

    return apply


def _deadband(values: Mapping[str, float], dt: float) -> ServoFault:
    state: list[float] = []

    def apply(u: float, intensity: float) -> float:
        half_width, previous = intensity * values["half_width"], state[0] if state else u
        state[:] = [min(max(previous, u - half_width), u + half_width)]  # backlash
        return state[0]

    return apply


def _saturation(values: Mapping[str, float], dt: float) -> ServoFault:
    def apply(u: float, intensity: float) -> float:
        limit = 1 - intensity * (1 - values["limit"])
        return min(max(u, -limit), limit)

    return apply


def _offset(values: Mapping[str, float], dt: float) -> ServoFault:
    return lambda u, share: min(max(u + share * values["offset"], -1.0), 1.0)


def _stuck(values: Mapping[str, float], dt: float) -> ServoFault:
    state: list[float] = [values["position"]] if "position" in values else []

    def apply(u: float, intensity: float) -> float:
        if intensity > 0 and not state:
            state.append(u)
        return u + intensity * (state[0] - u) if state else u

    return apply


def _loss(values: Mapping[str, float], dt: float) -> ServoFault:
    return lambda u, share: (1 - share * values["loss"]) * u


SERVO_FAULTS: dict[str, Callable[[Mapping[str, float], float], ServoFault]] = {
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
CommandFault = Callable[[float, float, Commands], Commands]
"""(time [s], intensity of the fault, commands) to surfaces and motor."""


def _crossed_linkage(values: Mapping[str, float]) -> CommandFault:
    """Couple the rudder to the aileron."""

    def apply(t: float, intensity: float, commands: Commands) -> Commands:
        a, e, r, thrust = commands
        return a, e, min(max(r + intensity * values["gain"] * a, -1.0), 1.0), thrust

    return apply


def _loose_hinge(values: Mapping[str, float]) -> CommandFault:
    """Add an elevator oscillation independent of the command."""

    def apply(t: float, intensity: float, commands: Commands) -> Commands:
        a, e, r, thrust = commands
        return a, e + intensity * values["half_width"] * sin(2 * pi * values["hertz"] * t), r, thrust

    return apply


COMMAND_FAULTS: dict[str, Callable[[Mapping[str, float]], CommandFault]] = {
    "_crossed_linkage": _crossed_linkage,
    "_loose_hinge": _loose_hinge,
}
"""Faults that are no property of one servo."""
