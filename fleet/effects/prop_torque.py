"""The propeller turns the aircraft the other way round."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage

FULL = 0.25 * 9.80665  # thrust at full throttle, per mass [N/kg]


def act(flow: Flow, ratio: Any) -> dict[str, Any]:
    """Add a rolling moment in proportion to what the engine gives, whether or not the propeller pulls."""
    return {"L": ratio * flow.body.D * FULL * flow.body.mass * flow.delta_t}


EFFECT = Effect(
    name="prop_torque",
    stage=Stage.WRENCH,
    channel="roll",
    equation="L = ratio D 0.25 m g delta_t",
    source="McCormick 1995, chapter 6 (the airframe bears the engine's torque); 0.25 m g is a round number",
    parameters=(Parameter("ratio", "-", "torque per full thrust and diameter", step=0.02, low=-2.0, high=2.0),),
    act=act,
    examples=((0.03,), (-0.08,), (0.15,)),
    confused={
        "actuator_offset": "an offset follows dynamic pressure, torque the throttle: fly at two powers",
        "cg_shift_side": "a weight beside the middle does not follow the throttle",
    },
)
