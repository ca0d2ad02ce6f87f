"""Turbulence with a Dryden spectrum; it changes the variance of airspeed and flow angles, not their mean."""

from typing import Any

import numpy as np

from fleet.effects import Effect, Flow, Parameter, Stage

TAU = 5.0  # length scale over airspeed, e.g. 100 m at 20 m/s [s]
SINES = 32


def _frequencies(rng: np.random.Generator) -> np.ndarray:
    """Draw frequencies (3, SINES) [rad/s] of sines that share the energy of a Dryden spectrum equally.

    The energy below omega is 2/pi atan(omega TAU); each axis draws its own, so that the axes do not correlate.
    """
    quantile = (np.arange(SINES) + rng.uniform(0.25, 0.75, (3, SINES))) / SINES
    return np.tan(0.5 * np.pi * quantile) / TAU


_RNG = np.random.default_rng(8785)
OMEGA = _frequencies(_RNG)
PHASE = _RNG.uniform(0.0, 2.0 * np.pi, (3, SINES))


def act(flow: Flow, intensity: Any) -> dict[str, Any]:
    """Add gusts along all three axes, identical at every call."""
    gusts = np.sin(np.multiply.outer(flow.t, OMEGA) + PHASE).sum(-1) * np.sqrt(2.0 / SINES)
    return {axis: intensity * gusts[..., i] for i, axis in enumerate(("w_n", "w_e", "w_d"))}


EFFECT = Effect(
    name="turbulence",
    stage=Stage.AIR,
    channel="air",
    equation="Phi(omega) = sigma^2 (2 TAU / pi) / (1 + (TAU omega)^2), TAU = L / Va = 5 s, on each axis",
    source="MIL-F-8785C 1980, section 3.7 (longitudinal Dryden form); Beard & McLain 2012, section 4.4",
    parameters=(Parameter("intensity_mps", "m/s", "standard deviation per axis", step=0.2, low=0.0, high=10.0),),
    act=act,
    examples=((0.5,), (1.5,), (3.0,)),
    confusable_with={"gust_discrete": "one coherent transient, not random throughout the flight"},
    variance=True,
)
