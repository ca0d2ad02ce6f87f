"""Battery discharge: thrust at the same throttle decreases with the charge used."""

from typing import Any

from fleet.effects import Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, sag: Any) -> dict[str, Any]:
    """Reduce thrust in proportion to the integral of throttle."""
    return {"thrust": -sag * flow.throttle_time / 100.0}


EFFECT = Effect(
    name="battery_sag",
    stage=Stage.WRENCH,
    channel="thrust",
    equation="T = (1 - sag used / 100 s) T_full, used = integral of delta_t",
    source="Traub 2011, J. Aircraft 48(2) (discharge of batteries), to first order",
    parameters=(
        Parameter("sag_per_100s", "-", "thrust fraction lost in 100 s of full throttle", step=0.03, low=0.0, high=1.0),
    ),
    act=act,
    onsets=(Onset.ALWAYS,),
    examples=((0.15,), (0.25,), (0.4,)),
    confusable_with={
        "thrust_loss": "develops at once or with time, not with the charge used",
        "drag_increase": "drag grows with dynamic pressure, not with the charge used",
    },
)
