"""Does a hidden effect act: the same flight with and without it, the difference over the noise of the sensors."""

import numpy as np

from fleet.pretend.conceal.record import Log
from fleet.pretend.faults.fault import Fault

NOISE: dict[str, float] = {  # as in `sensors`: of one reading, before any smoothing
    **dict.fromkeys(("p", "q", "r"), 0.003),  # [rad/s]
    **dict.fromkeys(("a_x", "a_y", "a_z"), 0.07),  # [m/s2]
    **dict.fromkeys(("phi", "theta", "psi"), 0.0044),  # [rad]
    **dict.fromkeys(("v_n", "v_e", "v_d"), 0.075),  # [m/s]
    **dict.fromkeys(("p_n", "p_e", "p_d"), 0.5),  # [m]
    "Va": 0.25,  # [m/s]
    "baro": 0.4,  # [m]
    "satellites": 1.5,  # [m]
    **dict.fromkeys(("aileron", "elevator", "throttle", "rudder"), 0.01),  # shares of full travel
}
_NAMES = list(NOISE)
_TELLING = [name for name in _NAMES if name not in ("p_n", "p_e", "v_n", "v_e", "satellites")]  # where, is no evidence
LEAST = 2.0  # rms difference over the noise


def acts(fault: Fault, with_it: Log, without: Log) -> tuple[float, str]:
    """Compare two flights of one seed, while the effect is there.

    Returns:
        rms difference over the noise in the most telling channel, and which that is
    """
    there = np.array([fault.share(t) > 0 for t in with_it.t])
    difference = (with_it.seen - without.seen)[there]
    turns = [_NAMES.index(name) for name in ("phi", "psi")]
    difference[:, turns] = np.angle(np.exp(1j * difference[:, turns]))
    rms = dict(zip(_NAMES, np.sqrt(np.mean(difference**2, axis=0)) / np.array(list(NOISE.values())), strict=True))
    best = max(_TELLING, key=lambda name: rms[name])
    return float(rms[best]), best
