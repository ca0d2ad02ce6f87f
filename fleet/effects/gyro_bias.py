"""Gyro with a constant error: temperature, vibration, initialisation while moving."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Onset, Parameter, Stage


def act(readings: dict[str, Any], bias: Any, of: str = "p") -> dict[str, Any]:
    """Add the bias to one axis."""
    return {of: readings[of] + bias}


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the bias in degrees per second."""
    return {"bias_dps": float(np.degrees(par[0]))}


EFFECT = Effect(
    name="gyro_bias",
    stage=Stage.SENSOR,
    channel="gyro",
    equation="omega_reported = omega + bias",
    source="Beard & McLain 2012, section 7.2 (rate gyros)",
    parameters=(Parameter("bias", "rad/s", "rate added", step=0.005, low=-0.3, high=0.3),),
    act=act,
    reported=reported,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    targets=("p", "q", "r"),
    examples=((0.01,), (-0.02,), (0.05,)),
    confusable_with={"imu_misalignment": "vanishes without turning", "heading_bias": "a constant angle, not a rate"},
)
