"""Check of the telemetry that identification requires."""

import numpy as np

from twin_worker.telemetry.history import History

_NEEDS_HZ = {"attitude": 5.0, "velocity": 2.0, "position": 2.0, "servo": 5.0}  # minimum rates
_OVER_S = 20.0  # window of the rate [s]


def rate_hz(history: History, kind: str) -> float:
    """Return the recent rate of one kind of row [Hz]; 0 without rows."""
    t, _ = history.look(kind, history.newest - _OVER_S)
    if not len(t):
        return 0.0
    gaps = np.diff(t)
    return float(1.0 / np.median(gaps)) if len(gaps) else 1.0 / _OVER_S


def lacking(history: History) -> str:
    """Describe which kinds of row are missing or too slow; empty if telemetry is sufficient."""
    none = [kind for kind in (*_NEEDS_HZ, "air") if not len(history.look(kind)[0])]
    slow = {kind: rate_hz(history, kind) for kind in _NEEDS_HZ if kind not in none}
    said = [f"no {', '.join(none)} rows yet"] if none else []
    said += [
        f"{kind} at {rate:.1f} Hz, identification needs {_NEEDS_HZ[kind]:.0f} Hz"
        for kind, rate in slow.items()
        if rate < 0.9 * _NEEDS_HZ[kind]
    ]
    return "; ".join(said)
