"""Centre of gravity moved forward or aft: shifted payload, emptied tank."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage


def act(flow: Flow, dx: Any) -> dict[str, Any]:
    """Move the centre of gravity forward."""
    return {"x_cg": dx}


EFFECT = Effect(
    name="cg_shift",
    stage=Stage.MASS,
    channel="pitch",
    equation="M = M_0 + dx Z, N = N_0 - dx Y",
    source="Stevens, Lewis & Johnson 2016, section 2.4 (moments about another point)",
    parameters=(Parameter("dx_m", "m", "shift forward", step=0.01, low=-0.5, high=0.5),),
    act=act,
    of_airframe=("dx_m",),
    examples=((0.015,), (-0.03,), (0.06,)),
    confusable_with={
        "mass_change": "changes lift too; a dropped payload often causes both: fly pull-ups",
        "actuator_offset": "the moment of an elevator offset grows with dynamic pressure: fly at two speeds",
        "slipstream_tail": "follows the throttle",
    },
)
