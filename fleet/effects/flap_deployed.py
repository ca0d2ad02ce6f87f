"""A flap left down, or come down by itself: lift, drag and a pitching moment at once."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage


def act(flow: Flow, dCL: Any, dCD: Any, dCm: Any) -> dict[str, Any]:
    """Add lift, drag and pitching moment."""
    return {"C_L": dCL, "C_D": dCD, "C_m": dCm}


EFFECT = Effect(
    name="flap_deployed",
    stage=Stage.WRENCH,
    channel="lift",
    equation="C_L = C_L_clean + dCL, C_D = C_D_clean + dCD, C_m = C_m_clean + dCm",
    source="Raymer 2018, chapter 12 (lift, drag and moment of flaps)",
    parameters=(
        Parameter("dCL", "-", "lift coefficient added", step=0.05, low=-1.0, high=1.5),
        Parameter("dCD", "-", "drag coefficient added", step=0.005, low=-0.05, high=0.3),
        Parameter("dCm", "-", "pitching moment coefficient added", step=0.005, low=-0.3, high=0.3),
    ),
    act=act,
    examples=((0.1, 0.006, -0.01), (0.2, 0.015, -0.02), (0.35, 0.035, -0.035)),
    confused={
        "drag_increase": "without lift and moment: look at the angle of attack",
        "icing": "ice takes lift, and comes slowly",
        "mass_change": "less weight takes no more drag",
        "actuator_offset": "an offset of the elevator brings neither lift nor drag",
    },
)
