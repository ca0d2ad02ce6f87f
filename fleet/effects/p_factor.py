"""P-factor: in oblique flow the descending propeller blade produces more thrust."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage


def act(flow: Flow, ratio: Any) -> dict[str, Any]:
    """Add the moments of a displaced thrust line."""
    arm = ratio * flow.body.D * flow.T
    return {"N": arm * flow.alpha, "M": -arm * flow.beta}


EFFECT = Effect(
    name="p_factor",
    stage=Stage.WRENCH,
    channel="yaw",
    equation="N = ratio D T alpha, M = -ratio D T beta",
    source="Phillips 2010, Mechanics of Flight, chapter 2 (propeller in oblique flow), to first order",
    parameters=(
        Parameter(
            "ratio",
            "1/rad",
            "shift of the thrust line per angle, in propeller diameters",
            step=0.1,
            low=-10.0,
            high=10.0,
        ),
    ),
    act=act,
    of_airframe=("ratio",),
    examples=((0.3,), (-0.6,), (1.0,)),
    confusable_with={
        "thrust_asymmetry": "does not follow the angle of attack: fly slow and fast at one power",
        "prop_torque": "is a rolling moment, not a yawing moment",
        "actuator_offset": "a rudder offset does not follow the throttle",
    },
)
