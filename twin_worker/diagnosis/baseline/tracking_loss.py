"""Detect signals that the autopilot tracked in the past and permanently lost later, without isolating the cause.

Without surface and throttle commands no simulation is possible. But an autopilot controls energy, and the turn rate
follows the bank angle. If such a signal permanently leaves its past range, something has changed.
"""

from dataclasses import dataclass

import numpy as np

from fleet.frames import G
from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.data.smooth import DT

ENERGY, TURN, PITCH = "energy held", "turn by bank", "pitch attitude"
_MEAN_S = 2.0  # running mean
_MIN_DURATION_S = 2.0  # a shorter deviation is a gust
_MIN_OUT_SHARE = 0.7  # least share of the remaining flight outside the range
_MARGIN_SHARE = 0.5  # margin above and below the past range, as a share of it
_RANGE_PERCENTILES = 5.0, 95.0  # percentiles of the past range
_MIN_MARGIN = {ENERGY: 4.0, TURN: np.radians(4.0), PITCH: np.radians(6.0)}  # least excess [m, rad/s, rad]


@dataclass(frozen=True)
class TrackingLoss:
    """Loss of tracking: signal, onset [s], largest excess in units of the margin."""

    signal: str
    since: float
    range_ratio: float


def find_tracking_loss(flight: FlightData, until: float) -> TrackingLoss | None:
    """Return the first signal that permanently left its range before `until` [s, on the flight's clock]."""
    t = flight.t
    losses = [
        loss for name, x in _signals(flight).items() if (loss := _detect_loss(name, t, x, flight.ok, until)) is not None
    ]
    return min(losses, key=lambda loss: loss.since, default=None)


def _signals(flight: FlightData) -> dict[str, np.ndarray]:
    """Return the tracked signals, (n,) each: energy error as height [m], turn rate less that of the bank [rad/s]."""
    r = flight.readings
    speed = np.maximum(r.get("Va", np.hypot(r["v_n"], r["v_e"])), 5.0)
    turning = np.gradient(np.unwrap(r["psi"]), DT)
    out = {TURN: turning - G / speed * np.tan(np.clip(r["phi"], -1.2, 1.2)), PITCH: r["theta"]}
    if "low" in r:
        out[ENERGY] = r["low"] + speed / G * r["slow"]
    width = round(_MEAN_S / DT)
    return {
        name: np.convolve(np.pad(x, width // 2, mode="edge"), np.ones(width) / width, "same")[width // 2 :][: len(x)]
        for name, x in out.items()
    }


def _detect_loss(name: str, t: np.ndarray, x: np.ndarray, ok: np.ndarray, until: float) -> TrackingLoss | None:
    past, later = ok & (t < until), t >= until
    low, middle, high = np.percentile(x[past], [_RANGE_PERCENTILES[0], 50.0, _RANGE_PERCENTILES[1]])
    margin = max(_MARGIN_SHARE * (high - low), _MIN_MARGIN[name])
    excess = np.where(x > high, (x - high) / margin, np.where(x < low, (low - x) / margin, 0.0))
    excess[~later | ~ok] = 0.0
    min_rows = round(_MIN_DURATION_S / DT)
    beyond = np.convolve(excess > 1.0, np.ones(min_rows), "full")[: len(t)] >= min_rows
    if not beyond.any():
        return None
    first = int(np.argmax(beyond)) - min_rows + 1
    if (excess[first:][ok[first:]] > 1.0).mean() < _MIN_OUT_SHARE:
        return None
    side = np.sign(x[first] - middle)
    before = np.flatnonzero(side * (x[:first] - middle) <= 0.0)
    since = float(t[before[-1]]) if len(before) else float(t[first])
    return TrackingLoss(name, since, float(excess.max()))
