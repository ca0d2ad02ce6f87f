"""The ground under the wing: more lift and less induced drag, within a span of it."""

from typing import Any

import numpy as np

from fleet.effects import Effect, Flow, Onset, Parameter, Stage

WING = 0.2  # height of the wing above that of the wheels, in spans
OSWALD = 0.8


def act(flow: Flow, lift_gain: Any, drag_loss: Any, dCm: Any) -> dict[str, Any]:
    """Add lift, take induced drag, fading with height."""
    body = flow.body
    near = np.exp(-2.48 * (2.0 * (np.maximum(flow.height, 0.0) / body.b + WING)) ** 0.768)
    induced = flow.C_L**2 / (np.pi * OSWALD * body.b**2 / body.S)
    return {"lift": lift_gain * near, "C_D": -drag_loss * near * induced, "C_m": dCm * near}


EFFECT = Effect(
    name="ground_effect",
    stage=Stage.WRENCH,
    channel="lift",
    equation="near = exp(-2.48 (2 h_wing / b)^0.768), C_L = (1 + lift_gain near) C_L, C_Di = (1 - drag_loss near) C_Di",
    source="Torenbeek 1982, appendix G-7 (after Wieselsberger); wing 0.2 b above the wheels, Oswald factor 0.8",
    parameters=(
        Parameter("lift_gain", "-", "share of lift gained at the ground", step=0.1, low=0.0, high=2.0),
        Parameter("drag_loss", "-", "share of induced drag lost at the ground", step=0.2, low=0.0, high=5.0),
        Parameter(
            "dCm", "-", "pitching moment coefficient that comes along", step=0.002, low=-0.3, high=0.3, aside=True
        ),
    ),
    act=act,
    onsets=(Onset.ALWAYS,),
    examples=((0.2, 0.8, -0.03), (0.3, 1.0, -0.05), (0.45, 1.0, -0.08)),
    confused={
        "wind_shear": "a gradient of wind shows in airspeed, by heading",
        "updraft": "one bump, not bound to the ground",
        "drag_increase": "the same at every height",
    },
)
