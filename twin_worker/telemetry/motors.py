"""Motors of multirotors: their places by frame class and type, and their inputs from the motor outputs."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RotorFrame:
    """Places of the motors: right, forward and sense of the reaction torque of each, in arm lengths, (3, m) [-].

    The third row is +1 where the reaction torque turns the frame to the right.
    """

    name: str
    places: np.ndarray

    @property
    def mixer(self) -> np.ndarray:
        """Return the roll, pitch and yaw moment of the thrust of each motor, (m, 3) [-]."""
        right, forward, turn = self.places
        return np.stack([-right, forward, turn], axis=1)

    @property
    def sides(self) -> tuple[str, ...]:
        """Return the side of each motor in words."""
        rows = zip(*self.places[:2].tolist(), strict=True)
        return tuple(" ".join(filter(None, (_word(x, "rear", "front"), _word(y, "left", "right")))) for y, x in rows)


def _word(x: float, negative: str, positive: str) -> str:
    return "" if abs(x) < 0.3 else positive if x > 0 else negative


_H = np.sqrt(0.75)
FRAMES: dict[tuple[int, int], RotorFrame] = {  # ArduCopter FRAME_CLASS, FRAME_TYPE
    (1, 0): RotorFrame("quadrotor +", np.array([[1, -1, 0, 0], [0, 0, 1, -1], [1, 1, -1, -1]], float)),
    (1, 1): RotorFrame("quadrotor X", np.array([[1, -1, -1, 1], [1, -1, 1, -1], [1, 1, -1, -1]], float)),
    (2, 0): RotorFrame(
        "hexarotor +", np.array([[0, 0, -_H, _H, -_H, _H], [1, -1, -0.5, 0.5, 0.5, -0.5], [-1, 1, -1, 1, 1, -1]])
    ),
    (2, 1): RotorFrame(
        "hexarotor X", np.array([[1, -1, 0.5, -0.5, -0.5, 0.5], [0, 0, _H, -_H, _H, -_H], [-1, 1, -1, 1, 1, -1]])
    ),
}
"""Motors as ArduCopter numbers them. Source: ArduPilot documentation, "Connect ESCs and motors"."""


def rotor_frame(params: Mapping[str, float]) -> RotorFrame | None:
    """Return the frame of the parameters: ArduCopter's class and type, older FRAME, PX4 quadrotor; None: unknown."""
    if "FRAME" in params:  # before ArduCopter 3.6; the class was that of the firmware
        return FRAMES.get((1, min(int(params["FRAME"]), 2)))
    if "FRAME_CLASS" in params or "FRAME_TYPE" in params:
        return FRAMES.get((int(params.get("FRAME_CLASS", 1)), int(params.get("FRAME_TYPE", 1))))
    if params.get("CA_ROTOR_COUNT", 4.0) == 4.0:  # PX4 numbers the motors of a quadrotor X alike
        return FRAMES[1, 1]
    return None


def motor_inputs(pulses: np.ndarray, params: Mapping[str, float]) -> np.ndarray:
    """Convert motor outputs [us] to inputs between idle and full, same shape [-]."""
    low, high = params.get("MOT_PWM_MIN", 0.0) or 1000.0, params.get("MOT_PWM_MAX", 0.0) or 2000.0
    idle, full = params.get("MOT_SPIN_MIN", 0.0), params.get("MOT_SPIN_MAX", 1.0)
    return np.clip(((pulses - low) / (high - low) - idle) / (full - idle), 0.0, 1.0)
