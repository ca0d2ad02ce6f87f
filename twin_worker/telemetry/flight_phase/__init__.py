"""Phase of a stretch of flight: climb, level, turn or descent."""

import numpy as np

from fleet.window import Window

MODES = ("climb", "level", "turn", "descent")
_TURN = 0.2  # mean bank of a turn [rad]
_CLIMB = 0.7  # mean vertical speed of a climb or descent [m/s]


def mode_of(stretch: Window) -> str:
    """Name the mode of a stretch: a turn by its mean bank, else climb or descent by its mean vertical speed."""
    bank = float(np.abs(stretch.columns(("phi",))[stretch.ok]).mean())
    return mode_named(bank, -float(stretch.v[stretch.ok, 2].mean()))


def mode_named(bank: float, up: float) -> str:
    """Name the mode by the mean bank, without its sign [rad], and the mean vertical speed [m/s]."""
    if bank > _TURN:
        return "turn"
    return "climb" if up > _CLIMB else "descent" if up < -_CLIMB else "level"
