"""What the vectors of all laws share: one length, and the last slots of `par`.

    par = [the law's own numbers, 0 ..., W_N, W_E, LAW]      ctl = [the leg, as in arduplane.state; the law's own]

A vector of ArduPlane's parameters alone ends in true over equivalent airspeed, which is above zero: it needs no mark.
"""

import numpy as np

from fleet.autopilots.common.controller_state import N_CTL

N_PAR = 72  # length of every parameter vector
W_N, W_E = -3, -2  # wind the autopilot believes in, NED, where it blows to [m/s]
LAW = -1  # one of the three below
ARDUPLANE, PX4, TEXTBOOK = 0.0, -1.0, -2.0

__all__ = ["ARDUPLANE", "LAW", "N_CTL", "N_PAR", "PX4", "TEXTBOOK", "W_E", "W_N", "padded"]


def padded(own: np.ndarray, law: float) -> np.ndarray:
    """Return a law's own numbers (k,) as a parameter vector in calm air, (N_PAR,)."""
    par = np.zeros(N_PAR)
    par[: len(own)] = own
    par[LAW] = law
    return par
