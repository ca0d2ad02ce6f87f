"""Ice on the wing: less lift and more drag, usually increasing with time."""

from typing import Any

from fleet.effects import Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, lift_loss: Any, dCD: Any, dCm: Any) -> dict[str, Any]:
    """Reduce lift, add drag and the associated pitching moment."""
    return {"lift": -lift_loss, "C_D": dCD, "C_m": dCm}


EFFECT = Effect(
    name="icing",
    stage=Stage.WRENCH,
    channel="lift",
    equation="C_L = (1 - lift_loss) C_L_clean, C_D = C_D_clean + dCD",
    source="Bragg, Broeren & Blumenthal 2005, Progress in Aerospace Sciences 41 (iced airfoils)",
    parameters=(
        Parameter("lift_loss", "-", "fraction of lift lost", step=0.03, low=0.0, high=0.7),
        Parameter("dCD", "-", "drag coefficient added", step=0.005, low=0.0, high=0.3),
        Parameter("dCm", "-", "associated pitching moment coefficient", step=0.002, low=-0.3, high=0.3, nuisance=True),
    ),
    act=act,
    of_airframe=("dCD", "dCm"),
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((0.06, 0.01, 0.0), (0.12, 0.02, 0.002), (0.2, 0.04, 0.004)),
    confusable_with={
        "drag_increase": "does not reduce lift: compare the angle of attack",
        "air_density": "low density reduces moments too",
        "mass_change": "more weight adds no drag at the same lift",
        "flap_deployed": "a flap adds lift and a pitching moment",
    },
)
