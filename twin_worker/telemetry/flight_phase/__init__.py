"""Phase of a flight segment: climb, level, turn or descent."""

import numpy as np

from fleet.window import Window

MODES = ("climb", "level", "turn", "descent")
_TURN = 0.2  # minimum mean bank of a turn [rad]
_CLIMB = 0.7  # minimum mean vertical speed of a climb or descent [m/s]


def mode_of(stretch: Window) -> str:
    """Return the phase of a window: turn by mean bank, else climb or descent by mean vertical speed."""
    bank = float(np.abs(stretch.columns(("phi",))[stretch.ok]).mean())
    return mode_named(bank, -float(stretch.v[stretch.ok, 2].mean()))


def mode_named(bank: float, up: float) -> str:
    """Return the phase for a mean absolute bank [rad] and a mean vertical speed [m/s]."""
    if bank > _TURN:
        return "turn"
    return "climb" if up > _CLIMB else "descent" if up < -_CLIMB else "level"
