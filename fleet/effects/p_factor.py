"""A propeller in oblique flow pulls harder on one side: its blade going down meets more air."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage


def act(flow: Flow, ratio: Any) -> dict[str, Any]:
    """Add the moments of a thrust line moved aside."""
    arm = ratio * flow.body.D * flow.T
    return {"N": arm * flow.alpha, "M": -arm * flow.beta}


EFFECT = Effect(
    name="p_factor",
    stage=Stage.WRENCH,
    channel="yaw",
    equation="N = ratio D T alpha, M = -ratio D T beta",
    source="Phillips 2010, Mechanics of Flight, chapter 2 (propeller in oblique flow), to first order",
    parameters=(
        Parameter("ratio", "1/rad", "thrust line moved, in propeller diameters", step=0.1, low=-10.0, high=10.0),
    ),
    act=act,
    examples=((0.3,), (-0.6,), (1.0,)),
    confused={
        "thrust_asymmetry": "does not follow the angle of attack: fly slow and fast at one power",
        "prop_torque": "rolls instead of yawing",
        "actuator_offset": "an offset of the rudder does not follow the throttle",
    },
)
