"""Check of the telemetry that identification requires."""

import numpy as np

from twin_worker.telemetry.history import TelemetryHistory

_REQUIRED_HZ = {"attitude": 5.0, "velocity": 2.0, "position": 2.0, "servo": 5.0}  # minimum rates
_RATE_WINDOW_S = 20.0  # window of the rate [s]


def rate_hz(history: TelemetryHistory, kind: str) -> float:
    """Return the recent rate of one kind of row [Hz]; 0 without rows."""
    t, _ = history.rows_since(kind, history.newest - _RATE_WINDOW_S)
    if not len(t):
        return 0.0
    gaps = np.diff(t)
    return float(1.0 / np.median(gaps)) if len(gaps) else 1.0 / _RATE_WINDOW_S


def missing_telemetry(history: TelemetryHistory) -> str:
    """Describe which kinds of row are missing or too slow; empty if telemetry is sufficient."""
    absent = [kind for kind in (*_REQUIRED_HZ, "air") if not len(history.rows_since(kind)[0])]
    slow = {kind: rate_hz(history, kind) for kind in _REQUIRED_HZ if kind not in absent}
    problems = [f"no {', '.join(absent)} rows yet"] if absent else []
    problems += [
        f"{kind} at {rate:.1f} Hz, identification needs {_REQUIRED_HZ[kind]:.0f} Hz"
        for kind, rate in slow.items()
        if rate < 0.9 * _REQUIRED_HZ[kind]
    ]
    return "; ".join(problems)
