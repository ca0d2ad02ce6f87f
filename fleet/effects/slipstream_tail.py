"""Propeller slipstream on the tail: the effectiveness of elevator and rudder grows with thrust."""

from typing import Any

import numpy as np

from fleet.effects import Effect, Flow, Parameter, Stage

MIN_Q_BAR = 20.0  # smallest dynamic pressure for momentum theory [Pa]
MIN_THRUST_RATIO = -0.5  # limit for a windmilling propeller


def act(flow: Flow, share: Any) -> dict[str, Any]:
    """Scale the moments of the surfaces with the dynamic pressure that the propeller adds."""
    disc = np.pi * flow.body.D**2 / 4.0
    jet = share * np.maximum(flow.T / (np.maximum(flow.q_bar, MIN_Q_BAR) * disc), MIN_THRUST_RATIO)
    return {"C_m": flow.C_m_elevator * jet, "C_n": flow.C_n_rudder * jet}


EFFECT = Effect(
    name="slipstream_tail",
    stage=Stage.WRENCH,
    channel="pitch",
    equation="C_m = (1 + share T / (q_bar A)) C_m_delta_e delta_e, same for C_n of the rudder, A = pi D^2 / 4",
    source="McCormick 1995, chapter 6 (momentum theory); Selig 2014, J. Aircraft 51(6) (surfaces in the slipstream)",
    parameters=(Parameter("share", "-", "fraction of the tail in the slipstream", step=0.1, low=-1.0, high=3.0),),
    act=act,
    of_airframe=("share",),
    examples=((0.3,), (0.6,), (1.0,)),
    confusable_with={
        "control_effectiveness_loss": "does not follow the throttle: fly inputs at two power settings",
        "cg_shift": "does not follow the throttle",
    },
)
