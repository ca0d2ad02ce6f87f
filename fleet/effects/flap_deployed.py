"""Flap left down or deployed unintentionally: lift, drag and pitching moment together."""

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
    of_airframe=("dCL", "dCD", "dCm"),
    examples=((0.1, 0.006, -0.01), (0.2, 0.015, -0.02), (0.35, 0.035, -0.035)),
    confusable_with={
        "drag_increase": "changes neither lift nor moment: compare the angle of attack",
        "icing": "ice reduces lift and develops slowly",
        "mass_change": "less weight adds no drag",
        "actuator_offset": "an elevator offset adds neither lift nor drag",
    },
)
