"""Roll damping changed: wing tip lost, tip tanks, tip ice."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage


def act(flow: Flow, dC_l_p: Any) -> dict[str, Any]:
    """Add a rolling moment proportional to the rolling rate."""
    return {"C_l": dC_l_p * flow.p * flow.body.b / (2.0 * flow.Va), "C_l_p": dC_l_p}


EFFECT = Effect(
    name="roll_damping",
    stage=Stage.WRENCH,
    channel="roll",
    equation="C_l + dC_l_p p b / (2 Va)",
    source="Beard & McLain 2012, section 4.2 (C_l_p); wings",
    parameters=(
        Parameter("dC_l_p", "1/rad", "change of C_l_p; above zero: less damping", step=0.05, low=-3.0, high=3.0),
    ),
    act=act,
    of_airframe=("dC_l_p",),
    examples=((0.1,), (-0.2,), (0.3,)),
    confusable_with={
        "control_effectiveness_loss": "lost effectiveness attenuates slow and fast rolls alike: fly both",
        "gyro_bias": "a bias does not grow with the rate",
    },
)
