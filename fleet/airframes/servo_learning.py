"""Learn the servo map from flight, where no parameter tells which output moves which surface.

In flight with stabilisation an autopilot moves ailerons by the roll error, the elevator by the pitch error, each damped
by its rate, and the motor by the throttle that it reports. A regression of each output on these signals shows its
surface and its sign. An output that follows roll like the ailerons, on the usual channel of the rudder, is the rudder.
Source: ArduPlane, APM_Control roll and pitch controllers, KFF_RDDRMIX.
"""

import numpy as np

from fleet.airframes.airframe import ServoMap, servo_map

MIN_ROWS = 100
_MIN_R2 = 0.5  # share of an output's variance that the signals must explain [-]
_MIN_STD_US = 5.0  # an output that moves less tells nothing [us]
_MIXED = 0.5  # weights of roll and pitch whose ratio is above this belong to a mixed surface [-]
_RUDDER_OUTPUT = 4
_AILERON, _ELEVATOR, _RUDDER, _THROTTLE = 4, 19, 21, 70  # SERVOn_FUNCTION
_ELEVONS, _V_TAIL = (77, 78), (79, 80)  # left, right
_NAMES = {_AILERON: "aileron", _ELEVATOR: "elevator", _RUDDER: "rudder", _THROTTLE: "throttle"}
_NAMES |= dict.fromkeys(_ELEVONS, "elevon") | dict.fromkeys(_V_TAIL, "V-tail")


def learn_servo_map(pulses: np.ndarray, errors: np.ndarray, rates: np.ndarray, throttle: np.ndarray) -> ServoMap | None:
    """Return the servo map that flight shows; None where roll or pitch has no clear output.

    Args:
        pulses: (n, 8) or (n, 16) [us]
        errors: commanded minus actual roll and pitch, (n, 2) [rad]
        rates: p, q, (n, 2) [rad/s]
        throttle: as reported, (n,) [-]
    """
    signals = np.column_stack([errors, throttle, rates])
    valid = np.isfinite(signals).all(axis=1) & np.isfinite(pulses).all(axis=1)
    if valid.sum() < MIN_ROWS:
        return None
    scaled = signals[valid] - signals[valid].mean(axis=0)
    scaled /= np.maximum(scaled.std(axis=0), 1e-9)
    moved = {n: _weights(scaled, pulses[valid, n - 1]) for n in range(1, pulses.shape[1] + 1)}
    weights = {n: weight for n, weight in moved.items() if weight is not None}
    functions = _functions(weights)
    if not {_AILERON, *_ELEVONS} & set(functions.values()) or not {_ELEVATOR, *_ELEVONS, *_V_TAIL} & set(
        functions.values()
    ):
        return None
    params: dict[str, float] = {}
    for n, function in functions.items():
        params[f"SERVO{n}_FUNCTION"] = float(function)
        params[f"SERVO{n}_REVERSED"] = float(_sign(function, weights[n]) < 0)
        if function != _THROTTLE:
            params[f"SERVO{n}_TRIM"] = float(np.clip(pulses[valid, n - 1].mean(), 1300.0, 1700.0))
    text = ", ".join(f"{n} {_NAMES[function]}" for n, function in sorted(functions.items()))
    learned = servo_map(params)
    return ServoMap(learned.trim, learned.gain_up, learned.gain_down, f"servo map learnt from flight: {text}")


def _weights(signals: np.ndarray, pulse: np.ndarray) -> np.ndarray | None:
    """Return the weights of roll error, pitch error and throttle [us per standard deviation]; None if not explained."""
    deviation = pulse - pulse.mean()
    if deviation.std() < _MIN_STD_US:
        return None
    weights, *_ = np.linalg.lstsq(signals, deviation, rcond=None)
    r2 = 1.0 - np.sum((deviation - signals @ weights) ** 2) / np.sum(deviation**2)
    return weights[:3] if r2 >= _MIN_R2 else None


def _functions(weights: dict[int, np.ndarray]) -> dict[int, int]:
    """Return the function of each output by its dominant signal."""
    functions: dict[int, int] = {}
    mixed: list[int] = []
    for n, weight in weights.items():
        roll, pitch, throttle = np.abs(weight)
        if throttle > max(roll, pitch):
            functions[n] = _THROTTLE
        elif min(roll, pitch) > _MIXED * max(roll, pitch):
            mixed.append(n)
        else:
            functions[n] = _AILERON if roll > pitch else _ELEVATOR
    ailerons = [n for n, function in functions.items() if function == _AILERON]
    if _RUDDER_OUTPUT in ailerons and len(ailerons) > 1:
        functions[_RUDDER_OUTPUT] = _RUDDER
    left, right = _V_TAIL if ailerons else _ELEVONS
    for n in mixed:
        same = weights[n][0] * weights[n][1] > 0
        if ailerons:  # the left half of a V-tail is pitch plus yaw, and yaw follows roll
            functions[n] = left if same else right
        else:  # the left elevon is pitch minus roll
            functions[n] = right if same else left
    return functions


def _sign(function: int, weight: np.ndarray) -> float:
    """Return the sign of an output: of its pitch weight for the elevator and mixed surfaces, else of its own signal."""
    column = {_AILERON: 0, _RUDDER: 0, _THROTTLE: 2}.get(function, 1)
    return float(np.sign(weight[column]))
