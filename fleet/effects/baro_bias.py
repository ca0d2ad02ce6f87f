"""Pressure height with a constant error: blocked port, wrong pressure setting, changed weather."""

from typing import Any

from fleet.effects import Effect, Onset, Parameter, Stage


def act(readings: dict[str, Any], bias: Any) -> dict[str, Any]:
    """Add the bias."""
    return {"baro": readings["baro"] + bias}


EFFECT = Effect(
    name="baro_bias",
    stage=Stage.SENSOR,
    channel="baro",
    equation="h_reported = h + bias",
    source="Beard & McLain 2012, section 7.3 (absolute pressure)",
    parameters=(Parameter("bias_m", "m", "height added", step=2.0, low=-300.0, high=300.0),),
    act=act,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((5.0,), (-12.0,), (30.0,)),
    confusable_with={"gps_latency": "vanishes in level flight", "air_density": "affects airspeed and moments too"},
)
