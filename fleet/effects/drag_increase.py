"""More drag, whatever the lift: a door, a loose panel, ice on the struts, an unmodelled payload."""

from typing import Any

from fleet.effects import Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, dCD: Any) -> dict[str, Any]:
    """Add drag."""
    return {"C_D": dCD}


EFFECT = Effect(
    name="drag_increase",
    stage=Stage.WRENCH,
    channel="drag",
    equation="C_D = C_D0 + dCD",
    source="Beard & McLain 2012, eq. 4.11",
    parameters=(Parameter("dCD", "-", "drag coefficient added", step=0.005, low=-0.05, high=0.5),),
    act=act,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((0.01,), (0.03,), (0.08,)),
    confused={"thrust_loss": "drag grows with dynamic pressure, thrust with throttle: fly at two speeds"},
)
