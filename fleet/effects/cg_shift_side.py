"""A centre of gravity moved aside: one wing tank fuller, a payload that hangs on one side."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage


def act(flow: Flow, dy: Any) -> dict[str, Any]:
    """Move the centre of gravity to the right."""
    return {"y_cg": dy}


EFFECT = Effect(
    name="cg_shift_side",
    stage=Stage.MASS,
    channel="roll",
    equation="L = L_0 - dy Z, N = N_0 + dy X",
    source="Stevens, Lewis & Johnson 2016, section 2.4 (moments about another point)",
    parameters=(Parameter("dy_m", "m", "moved to the right", step=0.01, low=-1.0, high=1.0),),
    act=act,
    examples=((0.01,), (-0.03,), (0.06,)),
    confused={
        "actuator_offset": "an offset of the aileron grows with dynamic pressure: fly at two speeds",
        "prop_torque": "follows the throttle",
    },
)
