"""What telemetry lacks for a model to be identified, and what that costs: one sentence."""

import numpy as np

from twin_worker.telemetry.history import History

_NEEDS_HZ = {"attitude": 5.0, "velocity": 2.0, "position": 2.0, "servo": 5.0}  # for surfaces and modes to be seen
_OVER_S = 20.0  # rates are taken over as much [s]


def rate_hz(history: History, kind: str) -> float:
    """Return the rate of one kind of row of late [Hz]; 0 where none came."""
    t, _ = history.look(kind, history.newest - _OVER_S)
    if not len(t):
        return 0.0
    gaps = np.diff(t)
    return float(1.0 / np.median(gaps)) if len(gaps) else 1.0 / _OVER_S


def lacking(history: History) -> str:
    """Say which kinds of row never came and which come too seldom; empty where everything is there."""
    none = [kind for kind in (*_NEEDS_HZ, "air") if not len(history.look(kind)[0])]
    slow = {kind: rate_hz(history, kind) for kind in _NEEDS_HZ if kind not in none}
    said = [f"no {', '.join(none)} rows yet"] if none else []
    said += [
        f"{kind} at {rate:.1f} Hz, identification needs {_NEEDS_HZ[kind]:.0f} Hz"
        for kind, rate in slow.items()
        if rate < 0.9 * _NEEDS_HZ[kind]
    ]
    return "; ".join(said)
