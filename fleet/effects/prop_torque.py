"""Reaction torque of the propeller on the airframe."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage

FULL_THRUST_PER_MASS = 0.25 * 9.80665  # thrust at full throttle, per mass [N/kg]


def act(flow: Flow, ratio: Any) -> dict[str, Any]:
    """Add a rolling moment proportional to throttle, independent of thrust."""
    return {"L": ratio * flow.body.D * FULL_THRUST_PER_MASS * flow.body.mass * flow.delta_t}


EFFECT = Effect(
    name="prop_torque",
    stage=Stage.WRENCH,
    channel="roll",
    equation="L = ratio D 0.25 m g delta_t",
    source="McCormick 1995, chapter 6 (reaction torque of the engine); 0.25 m g is a rough value",
    parameters=(
        Parameter("ratio", "-", "torque relative to full thrust times diameter", step=0.02, low=-2.0, high=2.0),
    ),
    act=act,
    of_airframe=("ratio",),
    examples=((0.03,), (-0.08,), (0.15,)),
    confusable_with={
        "actuator_offset": "an offset follows dynamic pressure, torque follows the throttle: fly at two power settings",
        "cg_shift_side": "a lateral shift of weight does not follow the throttle",
    },
)
