"""Accelerometer with a constant error: temperature, mount under stress."""

from typing import Any

from fleet.effects import Effect, Onset, Parameter, Stage


def act(readings: dict[str, Any], bias: Any, of: str = "x") -> dict[str, Any]:
    """Add the bias to one axis."""
    return {f"a_{of}": readings[f"a_{of}"] + bias}


EFFECT = Effect(
    name="accel_bias",
    stage=Stage.SENSOR,
    channel="accel",
    equation="f_reported = f + bias",
    source="Beard & McLain 2012, section 7.1 (accelerometers)",
    parameters=(Parameter("bias_mps2", "m/s2", "specific force added", step=0.1, low=-5.0, high=5.0),),
    act=act,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    targets=("x", "y", "z"),
    examples=((0.2,), (-0.4,), (0.8,)),
    confusable_with={
        "imu_misalignment": "follows the specific force: fly turns and pull-ups",
        "mass_change": "follows the load factor and is absent from the measured velocity: fly turns",
        "drag_increase": "decelerates the aircraft, a bias does not",
    },
)
