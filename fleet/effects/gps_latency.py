"""Delayed satellite velocity and height: slow receiver, smoothing filter, wrong time stamp."""

from typing import Any

import numpy as np

from fleet.effects import Effect, Parameter, Stage

DELAYED_READINGS = ("v_n", "v_e", "v_d", "h")


def act(readings: dict[str, Any], latency: Any) -> dict[str, Any]:
    """Return the delayed readings; the negated parameter is the inverse to first order."""
    t = readings["t"]
    return {name: np.interp(t - latency, t, readings[name]) for name in DELAYED_READINGS}


EFFECT = Effect(
    name="gps_latency",
    stage=Stage.SENSOR,
    channel="gps",
    equation="v_reported(t) = v(t - latency), same for h",
    source="Skog & Handel 2011, IEEE Trans. Intelligent Transportation Systems 12(4) (time errors of GPS-aided INS)",
    parameters=(
        Parameter(
            "latency_s", "s", "latency; below zero: the other sensors are delayed", step=0.05, low=-1.0, high=1.5
        ),
    ),
    act=act,
    examples=((0.1,), (0.2,), (0.4,)),
    confusable_with={
        "wind_steady": "wind keeps velocity in phase with acceleration and attitude",
        "imu_misalignment": "follows the measured vector, not its rate of change",
    },
)
