"""Pitch damping changed: horizontal tail damaged, or its distance from the centre of gravity differs."""

from typing import Any

from fleet.effects import Effect, Flow, Parameter, Stage


def act(flow: Flow, dC_m_q: Any) -> dict[str, Any]:
    """Add a pitching moment proportional to the pitching rate."""
    return {"C_m": dC_m_q * flow.q * flow.body.c / (2.0 * flow.Va)}


EFFECT = Effect(
    name="pitch_damping",
    stage=Stage.WRENCH,
    channel="pitch",
    equation="C_m + dC_m_q q c / (2 Va)",
    source="Beard & McLain 2012, section 4.2 (C_m_q); horizontal tail",
    parameters=(
        Parameter("dC_m_q", "1/rad", "change of C_m_q; above zero: less damping", step=1.0, low=-100.0, high=100.0),
    ),
    act=act,
    of_airframe=("dC_m_q",),
    examples=((3.0,), (-5.0,), (7.0,)),
    confusable_with={
        "control_effectiveness_loss": "lost effectiveness attenuates slow elevator movements too",
        "gyro_bias": "a bias does not grow with the rate",
    },
)
