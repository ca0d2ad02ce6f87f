"""Asymmetric thrust: one of two engines weaker, bent mount."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage


def act(flow: Flow, arm: Any) -> dict[str, Any]:
    """Add the yawing moment of thrust with a lever arm."""
    return {"N": arm * flow.T}


EFFECT = Effect(
    name="thrust_asymmetry",
    stage=Stage.WRENCH,
    channel="yaw",
    equation="N = arm T",
    source="Stevens, Lewis & Johnson 2016, section 2.5 (moments of thrust); Etkin & Reid 1996, section 3.5",
    parameters=(Parameter("arm_m", "m", "thrust line left of the centre of gravity", step=0.02, low=-3.0, high=3.0),),
    act=act,
    of_airframe=("arm_m",),
    examples=((0.03,), (-0.08,), (0.2,)),
    confusable_with={
        "p_factor": "follows the angle of attack: fly slow and fast at one power",
        "actuator_offset": "a rudder offset does not follow the throttle",
        "thrust_loss": "adds no moment",
    },
)
