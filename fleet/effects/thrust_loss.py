"""Less thrust at the same throttle: damaged propeller, worn engine, failed cylinder."""

from typing import Any

from fleet.effects import Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, loss: Any) -> dict[str, Any]:
    """Return the relative decrement of thrust."""
    return {"thrust": -loss}


EFFECT = Effect(
    name="thrust_loss",
    stage=Stage.WRENCH,
    channel="thrust",
    equation="T = (1 - loss) T_healthy",
    source="Beard & McLain 2012, section 4.3 (propeller thrust)",
    parameters=(Parameter("loss", "-", "fraction lost; 1: engine off", step=0.05, low=0.0, high=1.0),),
    act=act,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((0.08,), (0.15,), (0.3,)),
    confusable_with={
        "drag_increase": "drag grows with dynamic pressure, thrust with throttle: fly at two speeds",
        "battery_sag": "battery sag follows the charge used, not time",
        "icing": "ice reduces lift too",
        "mass_change": "more weight needs more lift",
    },
)
