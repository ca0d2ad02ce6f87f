"""Misaligned inertial unit: gyros and accelerometers rotated together relative to the body."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Parameter, Stage

GYROS, ACCELEROMETERS = ("p", "q", "r"), ("a_x", "a_y", "a_z")


def act(readings: dict[str, Any], roll: Any, pitch: Any, yaw: Any) -> dict[str, Any]:
    """Return both vectors in the axes of the unit; the opposite rotation is the inverse."""
    turn = np.stack(np.broadcast_arrays(roll, pitch, yaw, readings["p"])[:3])
    return _turned(readings, GYROS, turn) | _turned(readings, ACCELEROMETERS, turn)


def _turned(readings: dict[str, Any], names: tuple[str, ...], turn: np.ndarray) -> dict[str, Any]:
    """Express a vector in axes rotated by a rotation vector, (3, ...) [rad], with the formula of Rodrigues."""
    vector, angle = np.stack([readings[name] for name in names]), np.sqrt((turn**2).sum(0))
    once = np.cross(vector, turn, axis=0)  # -rotation x vector
    twice = np.cross(once, turn, axis=0)
    seen = vector + np.sinc(angle / np.pi) * once + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * twice
    return dict(zip(names, seen, strict=True))


def told(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the angles in degrees."""
    return dict(zip(("roll_deg", "pitch_deg", "yaw_deg"), np.degrees(par[:3]).tolist(), strict=True))


EFFECT = Effect(
    name="imu_misalignment",
    stage=Stage.SENSOR,
    channel="imu",
    equation="f_reported = R(-rotation) f, same for omega; R by Rodrigues",
    source="Groves 2013, section 4.4.2 (cross-coupling errors); Titterton & Weston 2004, section 3.6 (rotation vector)",
    parameters=(
        Parameter("roll", "rad", "rotation about x", step=0.01, low=-0.4, high=0.4),
        Parameter("pitch", "rad", "rotation about y", step=0.01, low=-0.4, high=0.4),
        Parameter("yaw", "rad", "rotation about z", step=0.01, low=-0.4, high=0.4),
    ),
    act=act,
    told=told,
    examples=((0.02, -0.01, 0.01), (-0.03, 0.04, 0.02), (0.06, 0.05, -0.08)),
    confused={
        "accel_bias": "a bias does not follow the specific force: fly turns and pull-ups",
        "gyro_bias": "a bias is present without rotation too",
    },
)
