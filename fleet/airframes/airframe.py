"""Servo map from the autopilot's parameters: the surface or motor of each servo."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite

import numba as nb
import numpy as np

_FUNCTION = {4: "delta_a", 19: "delta_e", 21: "delta_r", 70: "delta_t", 77: "delta_e+a", 78: "delta_e-a"}
_INPUTS = ("delta_a", "delta_e", "delta_r", "delta_t")
_MIXES = {  # contribution of each servo's deflection to each input
    **{name: {name: 1.0} for name in _INPUTS},
    "delta_e+a": {"delta_e": 1.0, "delta_a": -1.0},  # left elevon
    "delta_e-a": {"delta_e": 1.0, "delta_a": 1.0},  # right elevon
}
_SERVOS = 8
_PX4_MOTORS, _PX4_SURFACES = 101, 201  # PWM_MAIN_FUNCn of the first motor, of the first control surface
_PX4_TYPES = {1: "delta_a", 2: "delta_a", 3: "delta_e", 4: "delta_r", 5: "delta_e+a", 6: "delta_e-a"}  # CA_SV_CSn_TYPE
_PX4_LEFT = 1  # a left aileron: up in a roll to the right


@dataclass(frozen=True)
class ServoMap:
    """Map of pulse widths to inputs: `u = (pulse - trim) @ gain`.

    Attributes:
        trim: pulse width at zero deflection, (8,) [us]
        gain_up, gain_down: inputs per pulse above and below trim, each (8, 4) [1/us]
        sentence: assumptions, or empty
    """

    trim: np.ndarray
    gain_up: np.ndarray
    gain_down: np.ndarray
    sentence: str

    def equals(self, other: "ServoMap") -> bool:
        """Return whether another map converts pulses to the same inputs."""
        pairs = ((self.trim, other.trim), (self.gain_up, other.gain_up), (self.gain_down, other.gain_down))
        return self is other or all(np.array_equal(own, theirs) for own, theirs in pairs)

    def inputs(self, pulses: np.ndarray) -> np.ndarray:
        """Convert pulse widths (n, 8) [us] to inputs (n, 4) in the order of `fleet.window.INPUTS` [-]."""
        out = np.empty((len(pulses), len(_INPUTS)))
        _inputs_of_rows(np.ascontiguousarray(pulses, float), self.trim, self.gain_up, self.gain_down, out)
        return out


@nb.njit(cache=True, nogil=True)
def _inputs_of_rows(pulses: np.ndarray, trim: np.ndarray, up: np.ndarray, down: np.ndarray, out: np.ndarray) -> None:
    """Write the inputs of every row to `out`, limited to 1.2 of full throw; throttle not below idle."""
    for k in range(len(out)):
        out[k] = 0.0
        for i in range(_SERVOS):
            offset = pulses[k, i] - trim[i]
            for j in range(4):
                out[k, j] += offset * (up[i, j] if offset > 0.0 else down[i, j])
        for j in range(4):
            low = 0.0 if j == 3 else -1.2
            if out[k, j] > 1.2 or out[k, j] < low:  # nan is preserved
                out[k, j] = 1.2 if out[k, j] > 1.2 else low


def servo_map(params: Mapping[str, float]) -> ServoMap:
    """Read SERVOn_FUNCTION, _MIN, _MAX, _TRIM, _REVERSED; without them assume aileron, elevator, throttle, rudder.

    Source: ArduPilot, "Servo functions" (4 aileron, 19 elevator, 21 rudder, 70 throttle, 77 and 78 elevons); PX4:
    PWM_MAIN_* and CA_SV_CSn_TYPE.
    """
    params = {name: value for name, value in params.items() if isfinite(value)}
    params = {**_px4_as_ardupilot(params), **params}
    functions = {n: _FUNCTION.get(int(params.get(f"SERVO{n}_FUNCTION", -1))) for n in range(1, _SERVOS + 1)}
    known = {n: name for n, name in functions.items() if name}
    sentence = ""
    if not known:
        known = {1: "delta_a", 2: "delta_e", 3: "delta_t", 4: "delta_r"}
        sentence = "servo map assumed (no SERVOn_FUNCTION): 1 aileron, 2 elevator, 3 throttle, 4 rudder"
    n_servos = {name: sum(name in _MIXES[other] for other in known.values()) for name in _INPUTS}
    trim, up, down = np.full(_SERVOS, 1500.0), np.zeros((_SERVOS, 4)), np.zeros((_SERVOS, 4))
    for n, name in known.items():
        low, high = params.get(f"SERVO{n}_MIN", 1100.0), params.get(f"SERVO{n}_MAX", 1900.0)
        centre = low if name == "delta_t" else params.get(f"SERVO{n}_TRIM", 0.5 * (low + high))
        sign = -1.0 if params.get(f"SERVO{n}_REVERSED", 0.0) else 1.0
        if name == "delta_t" and sign < 0:
            centre = high
        trim[n - 1] = centre
        for input_name, weight in _MIXES[name].items():
            column = _INPUTS.index(input_name)
            up[n - 1, column] = sign * weight / n_servos[input_name] / max(high - centre, 1.0)
            down[n - 1, column] = sign * weight / n_servos[input_name] / max(centre - low, 1.0)
    return ServoMap(trim, up, down, sentence)


def _px4_as_ardupilot(params: Mapping[str, float]) -> dict[str, float]:
    """Convert PX4's output parameters to ArduPilot's; empty without PX4 parameters."""
    numbers = {name: number for number, name in reversed(_FUNCTION.items())}
    converted: dict[str, float] = {}
    for n in range(1, _SERVOS + 1):
        function = int(params.get(f"PWM_MAIN_FUNC{n}", 0))
        kind = int(params.get(f"CA_SV_CS{function - _PX4_SURFACES}_TYPE", 0))
        name = "delta_t" if function == _PX4_MOTORS else _PX4_TYPES.get(kind)
        if name is None:
            continue
        reverse = bool(int(params.get("PWM_MAIN_REV", 0)) >> (n - 1) & 1) != (kind == _PX4_LEFT)
        converted |= {f"SERVO{n}_FUNCTION": float(numbers[name]), f"SERVO{n}_REVERSED": float(reverse)}
        converted |= {f"SERVO{n}_MIN": params.get(f"PWM_MAIN_MIN{n}", 1000.0)}
        converted |= {f"SERVO{n}_MAX": params.get(f"PWM_MAIN_MAX{n}", 2000.0)}
    return converted
