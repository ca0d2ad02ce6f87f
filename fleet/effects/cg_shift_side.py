"""Centre of gravity moved sideways: unequal wing tanks, payload on one side."""

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
    parameters=(Parameter("dy_m", "m", "shift to the right", step=0.01, low=-1.0, high=1.0),),
    act=act,
    of_airframe=("dy_m",),
    examples=((0.01,), (-0.03,), (0.06,)),
    confusable_with={
        "actuator_offset": "the moment of an aileron offset grows with dynamic pressure: fly at two speeds",
        "prop_torque": "follows the throttle",
    },
)
