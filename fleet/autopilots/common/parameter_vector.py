"""Common layout of all parameter vectors: one length, and the last elements of `par`.

    par = [parameters of the law, 0 ..., W_N, W_E, LAW]      ctl = [leg, see `controller_state`; states of the law]

An unpadded ArduPlane vector ends in true over equivalent airspeed, which is positive and thus differs from all codes.
"""

import numpy as np

from fleet.autopilots.common.controller_state import N_CTL

N_PAR = 72  # length of every parameter vector
W_N, W_E = -3, -2  # wind estimate of the autopilot, NED, direction it blows to [m/s]
LAW = -1  # code of the law, one of the three below
ARDUPLANE, PX4, TEXTBOOK = 0.0, -1.0, -2.0

__all__ = ["ARDUPLANE", "LAW", "N_CTL", "N_PAR", "PX4", "TEXTBOOK", "W_E", "W_N", "padded"]


def padded(law_parameters: np.ndarray, law: float) -> np.ndarray:
    """Pad the parameters of a law (k,) to a parameter vector without wind, (N_PAR,)."""
    par = np.zeros(N_PAR)
    par[: len(law_parameters)] = law_parameters
    par[LAW] = law
    return par
