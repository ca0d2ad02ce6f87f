"""Ground effect: more lift and less induced drag within one span of the ground."""

from typing import Any

import numpy as np

from fleet.effects import Effect, Flow, Onset, Parameter, Stage

WING_HEIGHT_SPANS = 0.2  # height of the wing above the wheels, in spans
OSWALD = 0.8


def act(flow: Flow, lift_gain: Any, drag_loss: Any, dCm: Any) -> dict[str, Any]:
    """Add lift and reduce induced drag; both decrease with height."""
    body = flow.body
    proximity = np.exp(-2.48 * (2.0 * (np.maximum(flow.height, 0.0) / body.b + WING_HEIGHT_SPANS)) ** 0.768)
    induced = flow.C_L**2 / (np.pi * OSWALD * body.b**2 / body.S)
    return {"lift": lift_gain * proximity, "C_D": -drag_loss * proximity * induced, "C_m": dCm * proximity}


EFFECT = Effect(
    name="ground_effect",
    stage=Stage.WRENCH,
    channel="lift",
    equation="k = exp(-2.48 (2 h_wing / b)^0.768), C_L = (1 + lift_gain k) C_L_0, C_Di = (1 - drag_loss k) C_Di_0",
    source="Torenbeek 1982, appendix G-7 (after Wieselsberger); wing 0.2 b above the wheels, Oswald factor 0.8",
    parameters=(
        Parameter("lift_gain", "-", "fraction of lift gained at the ground", step=0.1, low=0.0, high=2.0),
        Parameter("drag_loss", "-", "fraction of induced drag lost at the ground", step=0.2, low=0.0, high=5.0),
        Parameter("dCm", "-", "associated pitching moment coefficient", step=0.002, low=-0.3, high=0.3, nuisance=True),
    ),
    act=act,
    of_airframe=("dCm",),
    onsets=(Onset.ALWAYS,),
    examples=((0.2, 0.8, -0.03), (0.3, 1.0, -0.05), (0.45, 1.0, -0.08)),
    confusable_with={
        "wind_shear": "a wind gradient changes airspeed, depending on heading",
        "updraft": "a single transient at any height",
        "drag_increase": "the same at every height",
    },
)
