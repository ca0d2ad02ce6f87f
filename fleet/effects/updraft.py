"""Crossing of rising or sinking air: thermal, slope lift, mountain wave."""

from typing import Any

from fleet.effects import Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, speed: Any) -> dict[str, Any]:
    """Add vertical wind."""
    return {"w_d": -speed}


EFFECT = Effect(
    name="updraft",
    stage=Stage.AIR,
    channel="air",
    equation="w_d = -w_up (1 - cos(2 pi (t - t0) / T)) / 2",
    source="Allen 2006, AIAA 2006-1510 (updrafts met by small aircraft); profile 1 - cos",
    parameters=(Parameter("speed_mps", "m/s", "peak upward air speed", step=0.3, low=-15.0, high=15.0),),
    act=act,
    onsets=(Onset.BUMP,),
    examples=((2.5,), (-4.0,), (6.0,)),
    confusable_with={
        "gust_discrete": "a horizontal gust changes airspeed and sideslip, depending on heading",
        "turbulence": "random throughout the flight, not one coherent transient",
    },
)
