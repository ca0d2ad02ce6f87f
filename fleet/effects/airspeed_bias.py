"""Airspeed sensor with a constant error: zero calibrated in wind."""

from typing import Any

from fleet.effects import Effect, Onset, Parameter, Stage


def act(readings: dict[str, Any], bias: Any) -> dict[str, Any]:
    """Add the bias."""
    return {"Va": readings["Va"] + bias}


EFFECT = Effect(
    name="airspeed_bias",
    stage=Stage.SENSOR,
    channel="airspeed",
    equation="Va_reported = Va + bias",
    source="Beard & McLain 2012, section 7.3 (differential pressure)",
    parameters=(Parameter("bias_mps", "m/s", "airspeed added", step=0.5, low=-15.0, high=15.0),),
    act=act,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((1.0,), (-2.0,), (4.0,)),
    confusable_with={
        "airspeed_scale": "a scale error grows with speed: fly at two speeds",
        "wind_steady": "wind depends on heading: fly a full turn",
    },
)
