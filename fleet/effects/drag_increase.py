"""Additional drag independent of lift: open door, loose panel, ice on struts, unmodelled payload."""

from typing import Any

from fleet.effects import Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, dCD: Any, dCm: Any) -> dict[str, Any]:
    """Add drag and its pitching moment about the centre of gravity."""
    return {"C_D": dCD, "C_m": dCm}


EFFECT = Effect(
    name="drag_increase",
    stage=Stage.WRENCH,
    channel="drag",
    equation="C_D = C_D0 + dCD",
    source="Beard & McLain 2012, eq. 4.11",
    parameters=(
        Parameter("dCD", "-", "drag coefficient added", step=0.005, low=0.0, high=0.5),
        Parameter("dCm", "-", "associated pitching moment coefficient", step=0.002, low=-0.3, high=0.3, nuisance=True),
    ),
    act=act,
    of_airframe=("dCD", "dCm"),
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((0.01, 0.0), (0.03, 0.002), (0.08, -0.004)),
    confusable_with={"thrust_loss": "drag grows with dynamic pressure, thrust with throttle: fly at two speeds"},
)
