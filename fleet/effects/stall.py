"""Flow separation: above a break angle of attack lift is below the linear slope and drag is higher."""

from typing import Any

import numpy as np

from fleet.effects import Effect, Flow, Onset, Parameter, Stage

STALL_ANGLES = {f"{angle} deg": np.radians(angle) for angle in (8, 10, 12, 14)}  # alpha_s


def act(flow: Flow, slope_lost: Any, drag_slope: Any, of: str = "12 deg") -> dict[str, Any]:
    """Reduce lift and add drag in proportion to the angle of attack beyond the break."""
    excess_alpha = np.maximum(flow.alpha - STALL_ANGLES[of], 0.0)
    return {"C_L": -slope_lost * excess_alpha, "C_D": drag_slope * excess_alpha}


EFFECT = Effect(
    name="stall",
    stage=Stage.WRENCH,
    channel="lift",
    equation="d = max(alpha - alpha_s, 0), C_L = C_L_clean - slope_lost d, C_D = C_D_clean + drag_slope d",
    source="Beard & McLain 2012, eq. 4.9 (lift beyond the stall), here piecewise linear",
    parameters=(
        Parameter("slope_lost_per_rad", "1/rad", "lift slope lost beyond the break", step=0.5, low=0.0, high=15.0),
        Parameter("drag_slope_per_rad", "1/rad", "drag slope gained beyond the break", step=0.2, low=0.0, high=5.0),
    ),
    act=act,
    of_airframe=("slope_lost_per_rad", "drag_slope_per_rad"),
    onsets=(Onset.ALWAYS,),
    targets=tuple(STALL_ANGLES),
    initial_guesses=((2.0, 0.5), (5.0, 1.0), (8.0, 2.0)),
    examples=((1.5, 0.3), (3.0, 0.8), (5.0, 1.5)),
    confusable_with={
        "drag_increase": "drag at every angle of attack",
        "icing": "lift lost at every angle of attack",
        "mass_change": "more weight at every angle of attack",
    },
)
