"""Less thrust at the same throttle: a nicked propeller, a tired engine, a cold cylinder."""

from typing import Any

from fleet.effects import Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, loss: Any) -> dict[str, Any]:
    """Lessen thrust by a share."""
    return {"thrust": -loss}


EFFECT = Effect(
    name="thrust_loss",
    stage=Stage.WRENCH,
    channel="thrust",
    equation="T = (1 - loss) T_healthy",
    source="Beard & McLain 2012, section 4.3 (propeller thrust)",
    parameters=(Parameter("loss", "-", "share lost; 1: the engine is out", step=0.05, low=-0.5, high=1.0),),
    act=act,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((0.08,), (0.15,), (0.3,)),
    confused={
        "drag_increase": "drag grows with dynamic pressure, thrust with throttle: fly at two speeds",
        "battery_sag": "a battery sags as charge is used, not with time",
        "icing": "ice takes lift along",
        "mass_change": "more weight takes more lift",
    },
)
