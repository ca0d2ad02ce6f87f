"""Clock and link timing of one aircraft: drift, delay, round trip, offset to GPS time."""

from collections import deque
from collections.abc import Callable, Sequence
from math import sqrt
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

from fleet.telemetry.mavlink.parsing.decode import IDS, Frames
from fleet.telemetry.mavlink.parsing.scan import ID
from fleet.telemetry.tables import clock as c

EVERY_S = 10.0  # update period of the drift filter [s]
OFFSET_SIGMA_S = 3e-3  # standard deviation of the offset after the minimum-delay filter [s]
DRIFT_SIGMA = 1e-4  # prior standard deviation of a clock drift [s/s]
WANDER = 1e-7  # process noise of the drift [1/s]
KNOWN = 3e-5  # maximum standard deviation of a published drift [s/s]
_EARLIEST_S = 1e9  # earlier GPS times are invalid [s since 1970]
_LONGEST_TRIP_S = 10.0
_SMOOTH = 0.1
_TRIPS = 10  # the published round trip is the minimum of these


class Timing:
    """Clock and link timing of one aircraft.

    Args:
        clocks: returns its clocks, (3, STATE_SIZE); read only, except the worst delay, which is reset
    """

    def __init__(self, clocks: Callable[[], np.ndarray]) -> None:
        self._clocks = clocks
        self._filter: KalmanFilter | None = None
        self._looked = float("-inf")
        self._steps = 0.0  # clock jumps plus total re-anchoring
        self._satellites: float | None = None
        self._trips: deque[float] = deque(maxlen=_TRIPS)

    def satellites(self, unix_s: float, boot_s: float) -> None:
        """Add GPS time `unix_s` [s since 1970] at boot time `boot_s` [s]."""
        boot = self._clocks()[c.BOOT]
        if unix_s > _EARLIEST_S and not np.isnan(boot[c.NEWEST]):
            offset = float(c.unwrap(boot, boot_s) + boot[c.OFFSET]) - unix_s
            before = offset if self._satellites is None else self._satellites
            self._satellites = before + _SMOOTH * (offset - before)

    def trip(self, sent: float, back: float) -> None:
        """Add a round trip: fleet times of request and reply [s since 1970]."""
        if 0.0 <= back - sent < _LONGEST_TRIP_S:
            self._trips.append(back - sent)

    def told(self, now: float) -> dict[str, Any]:
        """Return the timing fields of `Status`; `now` is fleet time [s since 1970]."""
        boot = self._clocks()[c.BOOT]
        self._look(boot, now)
        worst, boot[c.WORST] = float(boot[c.WORST]), 0.0
        return {
            "clock_offset_s": float(boot[c.OFFSET]),
            "clock_drift": self.drift,
            "latency_s": float(boot[c.DELAY]),
            "latency_worst_s": worst,
            "round_trip_s": min(self._trips) if self._trips else None,
            "gps_offset_s": self._satellites,
        }

    @property
    def drift(self) -> float | None:
        """Return the drift against fleet time [s/s]; None while its uncertainty is too large."""
        if self._filter is None or sqrt(self._filter.P[1, 1]) > KNOWN:
            return None
        return float(self._filter.x[1, 0])

    def _look(self, boot: np.ndarray, now: float) -> None:
        """Update the Kalman filter of offset and drift: x = (offset, drift), x' = F x, z = offset."""
        passed = now - self._looked
        if 0 <= passed < EVERY_S or np.isnan(boot[c.NEWEST]):
            return
        self._looked = now
        steps = float(boot[c.JUMPS] + boot[c.ADVANCE])
        if self._filter is None or steps != self._steps or not passed < 10 * EVERY_S:
            self._steps, self._satellites = steps, None
            self._filter = _anchored(float(boot[c.OFFSET]))
            return
        step = np.array([[1.0, passed], [0.0, 1.0]])
        noise = np.array([[passed**3 / 3, passed**2 / 2], [passed**2 / 2, passed]]) * WANDER**2
        self._filter.predict(F=step, Q=noise)
        self._filter.update(float(boot[c.OFFSET]))


def _anchored(offset_s: float) -> KalmanFilter:
    found = KalmanFilter(dim_x=2, dim_z=1)
    found.x = np.array([[offset_s], [0.0]])
    found.P = np.diag([OFFSET_SIGMA_S**2, DRIFT_SIGMA**2])
    found.H, found.R = np.array([[1.0, 0.0]]), np.array([[OFFSET_SIGMA_S**2]])
    return found


def time(frames: Frames, owner: np.ndarray, timings: Sequence[Timing]) -> None:
    """Update the timing of all aircraft from SYSTEM_TIME and TIMESYNC replies.

    Args:
        frames: received frames
        owner: number in `timings` of each frame's aircraft, -1 without owner, (n,)
        timings: timing of the aircraft on this link
    """
    which = np.flatnonzero((frames.at[:, ID] == IDS["SYSTEM_TIME"]) & (owner >= 0))
    if len(which):
        # last frame of each aircraft
        last = which[len(which) - 1 - np.unique(owner[which][::-1], return_index=True)[1]]
        fields = frames.fields(last, "SYSTEM_TIME")
        unix_s, boot_s = fields.time_unix_usec * 1e-6, fields.time_boot_ms * 1e-3
        for number, unix, boot in zip(owner[last].tolist(), unix_s.tolist(), boot_s.tolist(), strict=True):
            timings[number].satellites(unix, boot)
    which = np.flatnonzero((frames.at[:, ID] == IDS["TIMESYNC"]) & (owner >= 0))
    if len(which):
        fields = frames.fields(which, "TIMESYNC")
        for i in np.flatnonzero(fields.tc1 != 0).tolist():
            timings[owner[which[i]]].trip(float(fields.ts1[i]) * 1e-9, float(frames.arrival[which[i]]))
