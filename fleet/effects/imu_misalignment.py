"""Misaligned inertial unit: gyros and accelerometers rotated together relative to the body."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Parameter, Stage

GYROS, ACCELEROMETERS = ("p", "q", "r"), ("a_x", "a_y", "a_z")


def act(readings: dict[str, Any], roll: Any, pitch: Any, yaw: Any) -> dict[str, Any]:
    """Return both vectors in the axes of the unit; the opposite rotation is the inverse."""
    rotation = np.stack(np.broadcast_arrays(roll, pitch, yaw, readings["p"])[:3])
    return _rotate(readings, GYROS, rotation) | _rotate(readings, ACCELEROMETERS, rotation)


def _rotate(readings: dict[str, Any], names: tuple[str, ...], rotation: np.ndarray) -> dict[str, Any]:
    """Express a vector in axes rotated by a rotation vector, (3, ...) [rad], with the formula of Rodrigues."""
    vector, angle = np.stack([readings[name] for name in names]), np.sqrt((rotation**2).sum(0))
    cross = np.cross(vector, rotation, axis=0)  # -rotation x vector
    double_cross = np.cross(cross, rotation, axis=0)
    rotated = vector + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * double_cross
    return dict(zip(names, rotated, strict=True))


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
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
    reported=reported,
    examples=((0.02, -0.01, 0.01), (-0.03, 0.04, 0.02), (0.06, 0.05, -0.08)),
    confusable_with={
        "accel_bias": "a bias does not follow the specific force: fly turns and pull-ups",
        "gyro_bias": "a bias is present without rotation too",
    },
)
