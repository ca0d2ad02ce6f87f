"""Yaw damping changed: fin damaged, or a pod far from the centre of gravity."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage


def act(flow: Flow, dC_n_r: Any) -> dict[str, Any]:
    """Add a yawing moment proportional to the yawing rate."""
    return {"C_n": dC_n_r * flow.r * flow.body.b / (2.0 * flow.Va)}


EFFECT = Effect(
    name="yaw_damping",
    stage=Stage.WRENCH,
    channel="yaw",
    equation="C_n + dC_n_r r b / (2 Va)",
    source="Beard & McLain 2012, section 4.2 (C_n_r); fin",
    parameters=(
        Parameter("dC_n_r", "1/rad", "change of C_n_r; above zero: less damping", step=0.02, low=-2.0, high=2.0),
    ),
    act=act,
    of_airframe=("dC_n_r",),
    examples=((0.03,), (-0.06,), (-0.12,)),
    confusable_with={
        "control_effectiveness_loss": "damping acts in steady turns without rudder too",
        "gyro_bias": "a bias does not grow with the rate",
    },
)
