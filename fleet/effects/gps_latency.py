"""Satellite velocity and height that come late: a slow receiver, a smoothing filter, a wrong time stamp."""

from typing import Any

import numpy as np

from fleet.effects import Effect, Parameter, Stage

LATE = ("v_n", "v_e", "v_d", "h")


def act(readings: dict[str, Any], latency: Any) -> dict[str, Any]:
    """Return what was a while ago; undone to first order."""
    t = readings["t"]
    return {name: np.interp(t - latency, t, readings[name]) for name in LATE}


EFFECT = Effect(
    name="gps_latency",
    stage=Stage.SENSOR,
    channel="gps",
    equation="v_reported(t) = v(t - latency), h alike",
    source="Skog & Handel 2011, IEEE Trans. Intelligent Transportation Systems 12(4) (time errors of GPS-aided INS)",
    parameters=(Parameter("latency_s", "s", "how late; below zero: the rest is late", step=0.05, low=-1.0, high=1.5),),
    act=act,
    examples=((0.1,), (0.2,), (0.4,)),
    confused={
        "wind_steady": "wind leaves acceleration and attitude in step",
        "imu_misalignment": "follows what is felt, not how it changes",
    },
)
