"""The propeller turns the aircraft the other way round."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage

IDLE = 0.03 * 9.80665  # thrust whose torque an engine at idle still has, per mass [N/kg]


def act(flow: Flow, ratio: Any) -> dict[str, Any]:
    """Add a rolling moment in proportion to thrust, and a little of it without."""
    return {"L": ratio * flow.body.D * (flow.T + IDLE * flow.body.mass)}


EFFECT = Effect(
    name="prop_torque",
    stage=Stage.WRENCH,
    channel="roll",
    equation="L = ratio D (T + 0.03 m g)",
    source="McCormick 1995, chapter 6 (thrust and torque coefficients); the idle share is a round number",
    parameters=(Parameter("ratio", "-", "torque per thrust and propeller diameter", step=0.02, low=-2.0, high=2.0),),
    act=act,
    examples=((0.03,), (-0.08,), (0.15,)),
    confused={
        "actuator_offset": "an offset follows dynamic pressure, torque the throttle: fly at two powers",
        "cg_shift_side": "a weight beside the middle does not follow the throttle",
    },
)
