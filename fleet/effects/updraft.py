"""Rising or sinking air that is crossed: a thermal, a slope, the wave behind a ridge."""

from typing import Any

from fleet.effects import Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, speed: Any) -> dict[str, Any]:
    """Add wind upwards."""
    return {"w_d": -speed}


EFFECT = Effect(
    name="updraft",
    stage=Stage.AIR,
    channel="air",
    equation="w_d = -w_up (1 - cos(2 pi (t - t0) / T)) / 2",
    source="Allen 2006, AIAA 2006-1510 (updrafts met by small aircraft); bump of 1 - cos for its profile",
    parameters=(Parameter("speed_mps", "m/s", "air upwards at its height", step=0.3, low=-15.0, high=15.0),),
    act=act,
    onsets=(Onset.BUMP,),
    examples=((2.5,), (-4.0,), (6.0,)),
    confused={
        "gust_discrete": "a gust along the ground shows in airspeed and sideslip, by heading",
        "turbulence": "one coherent bump, not scatter all along",
    },
)
