"""Servo map from the autopilot's parameters or an airframe file: the surface or motor of each servo."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite

import numba as nb
import numpy as np

_FUNCTION = {4: "delta_a", 19: "delta_e", 21: "delta_r", 70: "delta_t", 77: "delta_e+a", 78: "delta_e-a"}
_FUNCTION |= {79: "delta_e+r", 80: "delta_e-r", 24: "flaperon_left", 25: "flaperon_right"}
_FUNCTION |= {73: "throttle_left", 74: "throttle_right"}
_INPUTS = ("delta_a", "delta_e", "delta_r", "delta_t")
_MIXES = {  # contribution of each servo's deflection to each input
    **{name: {name: 1.0} for name in _INPUTS},
    "delta_e+a": {"delta_e": 1.0, "delta_a": -1.0},  # left elevon
    "delta_e-a": {"delta_e": 1.0, "delta_a": 1.0},  # right elevon
    "delta_e+r": {"delta_e": 1.0, "delta_r": 1.0},  # left half of a V-tail
    "delta_e-r": {"delta_e": 1.0, "delta_r": -1.0},  # right half
    "flaperon_left": {"delta_a": 1.0},  # flaps move the two in opposite directions: they cancel
    "flaperon_right": {"delta_a": 1.0},
    "throttle_left": {"delta_t": 1.0},  # differential thrust: their mean is the throttle
    "throttle_right": {"delta_t": 1.0},
}
_MOTORS = ("delta_t", "throttle_left", "throttle_right")
SERVO_COUNT = 16
"""Outputs of a servo map; telemetry has the first eight or all of them."""
_PX4_PORTS = (("PWM_MAIN", 0), ("PWM_AUX", 8))  # prefix of the parameters, number of outputs before the first
_PX4_MOTORS, _PX4_SURFACES = 101, 201  # PWM_MAIN_FUNCn of the first motor, of the first control surface
_PX4_TYPES = {1: "delta_a", 2: "delta_a", 3: "delta_e", 4: "delta_r", 5: "delta_e+a", 6: "delta_e-a"}  # CA_SV_CSn_TYPE
_PX4_TYPES |= {7: "delta_e+r", 8: "delta_e-r"}
ASSUMED = "servo map assumed"
"""Beginning of the sentence of a map without any source."""
_OLD_CHANNELS = {4: ("RCMAP_ROLL", 1), 19: ("RCMAP_PITCH", 2), 70: ("RCMAP_THROTTLE", 3), 21: ("RCMAP_YAW", 4)}
_OLD_SIGNS = {1: (1, 1), 2: (1, -1), 3: (-1, 1), 4: (-1, -1)}  # ELEVON_OUTPUT, VTAIL_OUTPUT: up up, up down, ...
_PX4_LEFT = 1  # a left aileron: up in a roll to the right
_CARD_NUMBERS = {"aileron": 4, "elevator": 19, "rudder": 21, "throttle": 70, "elevon_left": 77, "elevon_right": 78}
_CARD_NUMBERS |= {"v_tail_left": 79, "v_tail_right": 80, "flaperon_left": 24, "flaperon_right": 25}
_CARD_NUMBERS |= {"throttle_left": 73, "throttle_right": 74}
_CARD_PULSES = ("min", "trim", "max")
_MIN_PULSE_US, _MAX_PULSE_US = 400.0, 2600.0  # of a servo in an airframe file


@dataclass(frozen=True)
class ServoMap:
    """Map of pulse widths to inputs: `u = (pulse - trim) @ gain`.

    Attributes:
        trim: pulse width at zero deflection, (16,) [us]
        gain_up, gain_down: inputs per pulse above and below trim, each (16, 4) [1/us]
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
        """Convert pulse widths (n, 8) or (n, 16) [us] to inputs (n, 4) in the order of `fleet.window.INPUTS` [-].

        An output without a pulse (0, or not in telemetry) adds nothing: an input is the mean of those that have one.
        """
        out = np.empty((len(pulses), len(_INPUTS)))
        _inputs_of_rows(np.ascontiguousarray(pulses, float), self.trim, self.gain_up, self.gain_down, out)
        return out


@nb.njit(cache=True, nogil=True)
def _inputs_of_rows(pulses: np.ndarray, trim: np.ndarray, up: np.ndarray, down: np.ndarray, out: np.ndarray) -> None:
    """Write the inputs of every row to `out`, limited to 1.2 of full throw; throttle not below idle."""
    servos, present = np.zeros(4), np.zeros(4)  # outputs of each input; those with a pulse
    for j in range(4):
        for i in range(len(trim)):
            servos[j] += up[i, j] != 0.0
    for k in range(len(out)):
        out[k], present[:] = 0.0, 0.0
        for i in range(min(pulses.shape[1], len(trim))):
            if pulses[k, i] == 0.0:
                continue
            offset = pulses[k, i] - trim[i]
            for j in range(4):
                out[k, j] += offset * (up[i, j] if offset > 0.0 else down[i, j])
                present[j] += up[i, j] != 0.0
        for j in range(4):
            if 0.0 < present[j] < servos[j]:
                out[k, j] *= servos[j] / present[j]
            low = 0.0 if j == 3 else -1.2
            if out[k, j] > 1.2 or out[k, j] < low:  # nan is preserved
                out[k, j] = 1.2 if out[k, j] > 1.2 else low


def servo_map(params: Mapping[str, float]) -> ServoMap:
    """Read SERVOn_FUNCTION, _MIN, _MAX, _TRIM, _REVERSED; without them assume aileron, elevator, throttle, rudder.

    Source: ArduPilot, "Servo functions" (4 aileron, 19 elevator, 21 rudder, 70 throttle, 77 and 78 elevons, 79 and 80
    V-tail, 24 and 25 flaperons, 73 and 74 differential thrust), before 3.8 RCn_FUNCTION, ELEVON_OUTPUT, VTAIL_OUTPUT;
    PX4: PWM_MAIN_* (outputs 1 to 8), PWM_AUX_* (9 to 16) and CA_SV_CSn_TYPE.
    """
    params = {name: value for name, value in params.items() if isfinite(value)}
    params = {**_px4_as_ardupilot(params), **_old_as_ardupilot(params), **params}
    functions = {n: _FUNCTION.get(int(params.get(f"SERVO{n}_FUNCTION", -1))) for n in range(1, SERVO_COUNT + 1)}
    known = {n: name for n, name in functions.items() if name}
    sentence = ""
    if not known:
        known = {1: "delta_a", 2: "delta_e", 3: "delta_t", 4: "delta_r"}
        sentence = f"{ASSUMED} (no SERVOn_FUNCTION): 1 aileron, 2 elevator, 3 throttle, 4 rudder"
    n_servos = {name: sum(name in _MIXES[other] for other in known.values()) for name in _INPUTS}
    trim, up, down = np.full(SERVO_COUNT, 1500.0), np.zeros((SERVO_COUNT, 4)), np.zeros((SERVO_COUNT, 4))
    for n, name in known.items():
        low, high = params.get(f"SERVO{n}_MIN", 1100.0), params.get(f"SERVO{n}_MAX", 1900.0)
        is_motor = name in _MOTORS
        centre = low if is_motor else params.get(f"SERVO{n}_TRIM", 0.5 * (low + high))
        sign = -1.0 if params.get(f"SERVO{n}_REVERSED", 0.0) else 1.0
        if is_motor and sign < 0:
            centre = high
        trim[n - 1] = centre
        for input_name, weight in _MIXES[name].items():
            column = _INPUTS.index(input_name)
            up[n - 1, column] = sign * weight / n_servos[input_name] / max(high - centre, 1.0)
            down[n - 1, column] = sign * weight / n_servos[input_name] / max(centre - low, 1.0)
    return ServoMap(trim, up, down, sentence)


def servo_parameters(file: str, entries: object) -> dict[str, float]:
    """Convert the `[[servo]]` tables of an airframe file to SERVOn_FUNCTION, _REVERSED, _MIN, _TRIM, _MAX.

    Args:
        file: name of the file, for messages
        entries: tables with `surface` and `output` (1 to 16); optional `sign` (1 or -1), `min`, `trim`, `max` [us]

    Raises:
        ValueError: if a table is no servo; the message names the entry to correct.
    """
    params: dict[str, float] = {}
    for entry in entries if isinstance(entries, list) else [entries]:
        table = entry if isinstance(entry, dict) else {}
        surface, output, sign = table.get("surface"), table.get("output"), table.get("sign", 1)
        if surface not in _CARD_NUMBERS:
            names = ", ".join(_CARD_NUMBERS)
            raise ValueError(f"{file}: found servo surface = {surface!r}, expected one of {names}; correct it")
        if isinstance(output, bool) or not isinstance(output, int) or not 1 <= output <= SERVO_COUNT:
            raise ValueError(f"{file}: found output = {output!r} of {surface}, expected 1 to {SERVO_COUNT}; correct it")
        if f"SERVO{output}_FUNCTION" in params:
            raise ValueError(f"{file}: found output {output} twice, expected one surface for each; correct it")
        if sign not in (1, -1):
            raise ValueError(f"{file}: found sign = {sign!r} of {surface}, expected 1 or -1; correct it")
        params |= {f"SERVO{output}_FUNCTION": float(_CARD_NUMBERS[surface]), f"SERVO{output}_REVERSED": float(sign < 0)}
        given = {name: table[name] for name in _CARD_PULSES if name in table}
        for name, pulse in given.items():
            if isinstance(pulse, bool) or not isinstance(pulse, int | float):
                raise ValueError(f"{file}: found {name} = {pulse!r} of {surface}, expected a pulse width; correct it")
            params[f"SERVO{output}_{name.upper()}"] = float(pulse)
        if not _rise([_MIN_PULSE_US, *given.values(), _MAX_PULSE_US]):
            text = ", ".join(f"{name} = {pulse:g}" for name, pulse in given.items())
            limits = f"rising pulse widths of {_MIN_PULSE_US:.0f} to {_MAX_PULSE_US:.0f} us"
            raise ValueError(f"{file}: found {text} of {surface}, expected {limits}; correct it")
    return params


def _rise(values: list[float]) -> bool:
    return all(a < b for a, b in pairwise(values))  # false for nan


def _px4_as_ardupilot(params: Mapping[str, float]) -> dict[str, float]:
    """Convert PX4's output parameters to ArduPilot's; empty without PX4 parameters."""
    numbers = {name: number for number, name in reversed(_FUNCTION.items())}
    converted: dict[str, float] = {}
    for prefix, before in _PX4_PORTS[::-1]:  # outputs of MAIN beyond the eighth replace those of AUX
        for n in range(1, SERVO_COUNT - before + 1):
            function = int(params.get(f"{prefix}_FUNC{n}", 0))
            kind = int(params.get(f"CA_SV_CS{function - _PX4_SURFACES}_TYPE", 0))
            name = "delta_t" if function == _PX4_MOTORS else _PX4_TYPES.get(kind)
            if name is None:
                continue
            servo = f"SERVO{before + n}"
            reverse = bool(int(params.get(f"{prefix}_REV", 0)) >> (n - 1) & 1) != (kind == _PX4_LEFT)
            converted |= {f"{servo}_FUNCTION": float(numbers[name]), f"{servo}_REVERSED": float(reverse)}
            converted |= {f"{servo}_MIN": params.get(f"{prefix}_MIN{n}", 1000.0)}
            converted |= {f"{servo}_MAX": params.get(f"{prefix}_MAX{n}", 2000.0)}
    return converted


def _old_as_ardupilot(params: Mapping[str, float]) -> dict[str, float]:
    """Convert the output parameters of ArduPlane before 3.8 to the later ones; empty for later firmware.

    Outputs 1 to 4 follow RCMAP_*, all others RCn_FUNCTION. With ELEVON_OUTPUT the outputs of pitch and roll carry
    (pitch - roll) and (pitch + roll), with VTAIL_OUTPUT those of pitch and yaw (pitch - yaw) and (pitch + yaw), each
    with a sign. Source: ArduPlane 3.7 documentation, "Elevon planes", "V-tail planes".
    """
    if not any(f"RC{n}_REV" in params for n in range(1, 5)) or any(name.startswith("SERVO1_") for name in params):
        return {}
    channel = {number: int(params.get(name, default)) for number, (name, default) in _OLD_CHANNELS.items()}
    functions = {n: int(params.get(f"RC{n}_FUNCTION", 0)) for n in range(1, SERVO_COUNT + 1)}
    functions |= {n: number for number, n in channel.items() if 1 <= n <= SERVO_COUNT}
    signs = {n: 1.0 if params.get(f"RC{n}_REV", 1.0) >= 0 else -1.0 for n in functions}
    for name, across, pair in (("ELEVON_OUTPUT", 4, (77, 78)), ("VTAIL_OUTPUT", 21, (80, 79))):
        mixing = _OLD_SIGNS.get(int(params.get(name, 0.0)))
        if mixing is not None:  # reversed inputs of the mixer: both outputs by pitch, their order by the other
            pitch, other = channel[19], channel[across]
            both, order = signs.get(pitch, 1.0), signs.get(pitch, 1.0) * signs.get(other, 1.0)
            first, second = pair if order > 0 else pair[::-1]
            functions |= {pitch: first, other: second}
            signs |= {pitch: both * mixing[0], other: both * mixing[1]}
    converted: dict[str, float] = {}
    for n, function in functions.items():
        converted[f"SERVO{n}_FUNCTION"], converted[f"SERVO{n}_REVERSED"] = float(function), float(signs.get(n, 1.0) < 0)
        for key in ("MIN", "MAX", "TRIM"):
            if f"RC{n}_{key}" in params:
                converted[f"SERVO{n}_{key}"] = params[f"RC{n}_{key}"]
    return converted
