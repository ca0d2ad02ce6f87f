"""Single horizontal gust: a transient of shape 1 - cos."""

from fleet.effects import Effect, Onset, Parameter, Stage
from fleet.effects.wind_steady import act, reported

EFFECT = Effect(
    name="gust_discrete",
    stage=Stage.AIR,
    channel="air",
    equation="w = w_max (1 - cos(2 pi (t - t0) / T)) / 2",
    source="MIL-F-8785C 1980, section 3.7 (discrete gust); FAR 25.341 (1 - cos)",
    parameters=(
        Parameter("w_n", "m/s", "peak wind to the north", step=0.5, low=-25.0, high=25.0),
        Parameter("w_e", "m/s", "peak wind to the east", step=0.5, low=-25.0, high=25.0),
    ),
    act=act,
    reported=reported,
    onsets=(Onset.BUMP,),
    examples=((2.0, -1.0), (-3.0, 4.0), (6.0, 6.0)),
    confusable_with={
        "turbulence": "random throughout the flight, not one coherent transient",
        "wind_steady": "a gust ends, a change of wind persists",
        "updraft": "a horizontal gust changes airspeed and sideslip, an updraft the angle of attack",
    },
)
