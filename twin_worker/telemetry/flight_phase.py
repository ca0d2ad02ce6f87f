"""Phase of a flight segment: climb, level, turn or descent."""

import numpy as np

from fleet.window import Window

PHASES = ("climb", "level", "turn", "descent")
_TURN_BANK = 0.2  # minimum mean bank of a turn [rad]
_MIN_CLIMB_RATE = 0.7  # minimum mean vertical speed of a climb or descent [m/s]


def phase_of(window: Window) -> str:
    """Return the phase of a window: turn by mean bank, else climb or descent by mean vertical speed."""
    bank = float(np.abs(window.columns(("phi",))[window.ok]).mean())
    return classify_phase(bank, -float(window.v[window.ok, 2].mean()))


def classify_phase(bank: float, climb_rate: float) -> str:
    """Return the phase for a mean absolute bank [rad] and a mean vertical speed [m/s]."""
    if bank > _TURN_BANK:
        return "turn"
    return "climb" if climb_rate > _MIN_CLIMB_RATE else "descent" if climb_rate < -_MIN_CLIMB_RATE else "level"
