"""Clock and link timing of one aircraft: drift, delay, round trip, offset to GPS time."""

from collections import deque
from collections.abc import Callable, Sequence
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from fleet.telemetry.mavlink.parsing.decode import IDS, Frames
from fleet.telemetry.mavlink.parsing.scan import ID
from fleet.telemetry.tables import clock as c

if TYPE_CHECKING:
    from fleet.telemetry.mavlink.aircraft_link import AircraftLink

UPDATE_PERIOD_S = 10.0  # update period of the drift filter [s]
OFFSET_SIGMA_S = 3e-3  # standard deviation of the offset after the minimum-delay filter [s]
DRIFT_SIGMA = 1e-4  # prior standard deviation of a clock drift [s/s]
DRIFT_NOISE = 1e-7  # process noise of the drift [1/s]
MAX_DRIFT_SIGMA = 3e-5  # maximum standard deviation of a published drift [s/s]
_MIN_UNIX_S = 1e9  # earlier GPS times are invalid [s since 1970]
_MAX_TRIP_S = 10.0
_SMOOTHING = 0.1
_TRIP_COUNT = 10  # the published round trip is the minimum of these


class LinkTiming:
    """Clock and link timing of one aircraft.

    Args:
        clocks: returns its clocks, (3, STATE_SIZE); read only, except the worst delay, which is reset
    """

    def __init__(self, clocks: Callable[[], np.ndarray]) -> None:
        self._clocks = clocks
        self._filter: OffsetFilter | None = None
        self._updated_t = float("-inf")
        self._steps = 0.0  # clock jumps plus total re-anchoring
        self._gps_offset_s: float | None = None
        self._round_trips: deque[float] = deque(maxlen=_TRIP_COUNT)

    def add_gps_time(self, unix_s: float, boot_s: float) -> None:
        """Add GPS time `unix_s` [s since 1970] at boot time `boot_s` [s]."""
        boot = self._clocks()[c.BOOT]
        if unix_s > _MIN_UNIX_S and not np.isnan(boot[c.NEWEST_OWN]):
            offset = float(c.unwrap(boot, boot_s) + boot[c.OFFSET]) - unix_s
            previous = offset if self._gps_offset_s is None else self._gps_offset_s
            self._gps_offset_s = previous + _SMOOTHING * (offset - previous)

    def add_round_trip(self, sent: float, returned: float) -> None:
        """Add a round trip: fleet times of request and reply [s since 1970]."""
        if 0.0 <= returned - sent < _MAX_TRIP_S:
            self._round_trips.append(returned - sent)

    def status_fields(self, now: float) -> dict[str, Any]:
        """Return the timing fields of `Status`; `now` is fleet time [s since 1970]."""
        boot = self._clocks()[c.BOOT]
        self._update_drift(boot, now)
        state, boot[c.WORST_DELAY] = boot.tolist(), 0.0
        return {
            "clock_offset_s": state[c.OFFSET],
            "clock_drift": self.drift,
            "latency_s": state[c.DELAY],
            "latency_worst_s": state[c.WORST_DELAY],
            "round_trip_s": min(self._round_trips) if self._round_trips else None,
            "gps_offset_s": self._gps_offset_s,
        }

    @property
    def drift(self) -> float | None:
        """Return the drift against fleet time [s/s]; None while its uncertainty is too large."""
        if self._filter is None or sqrt(self._filter.P[1, 1]) > MAX_DRIFT_SIGMA:
            return None
        return float(self._filter.x[1, 0])

    def _update_drift(self, boot: np.ndarray, now: float) -> None:
        """Update the filter of offset and drift; start it anew after a step of the clock."""
        elapsed = now - self._updated_t
        if 0 <= elapsed < UPDATE_PERIOD_S or np.isnan(boot[c.NEWEST_OWN]):
            return
        self._updated_t = now
        steps = float(boot[c.JUMPS] + boot[c.ADVANCE])
        if self._filter is None or steps != self._steps or not elapsed < 10 * UPDATE_PERIOD_S:
            self._steps, self._gps_offset_s = steps, None
            self._filter = OffsetFilter(float(boot[c.OFFSET]))
            return
        self._filter.update(elapsed, float(boot[c.OFFSET]))


class OffsetFilter:
    """Kalman filter of offset and drift: x = (offset, drift), x' = F x, z = offset.

    The same operations as `filterpy.kalman.KalmanFilter`, whose import takes a second (scipy.stats).

    Args:
        offset_s: first offset [s]
    """

    def __init__(self, offset_s: float) -> None:
        self.x = np.array([[offset_s], [0.0]])
        self.P = np.diag([OFFSET_SIGMA_S**2, DRIFT_SIGMA**2])

    def update(self, elapsed: float, offset_s: float) -> None:
        """Predict over `elapsed` [s] and update with a measured offset [s]."""
        F, H, R = np.array([[1.0, elapsed], [0.0, 1.0]]), np.array([[1.0, 0.0]]), np.array([[OFFSET_SIGMA_S**2]])
        Q = np.array([[elapsed**3 / 3, elapsed**2 / 2], [elapsed**2 / 2, elapsed]]) * DRIFT_NOISE**2
        x, P = F @ self.x, F @ self.P @ F.T + Q
        K = P @ H.T @ np.linalg.inv(H @ (P @ H.T) + R)
        self.x = x + K @ (offset_s - H @ x)
        I_KH = np.eye(2) - K @ H
        self.P = I_KH @ P @ I_KH.T + K @ R @ K.T


def update_timings(frames: Frames, owner: np.ndarray, links: Sequence["AircraftLink"]) -> None:
    """Update the timing of all aircraft from SYSTEM_TIME and TIMESYNC replies.

    Args:
        frames: received frames
        owner: number in `links` of each frame's aircraft, -1 without owner, (n,)
        links: the aircraft on this link
    """
    frame_numbers = np.flatnonzero((frames.headers[:, ID] == IDS["SYSTEM_TIME"]) & (owner >= 0))
    if len(frame_numbers):
        # last frame of each aircraft
        last = frame_numbers[len(frame_numbers) - 1 - np.unique(owner[frame_numbers][::-1], return_index=True)[1]]
        fields = frames.fields(last, "SYSTEM_TIME")
        unix_s, boot_s = fields.time_unix_usec * 1e-6, fields.time_boot_ms * 1e-3
        for number, unix, boot in zip(owner[last].tolist(), unix_s.tolist(), boot_s.tolist(), strict=True):
            links[number].timing.add_gps_time(unix, boot)
    frame_numbers = np.flatnonzero((frames.headers[:, ID] == IDS["TIMESYNC"]) & (owner >= 0))
    if len(frame_numbers):
        fields = frames.fields(frame_numbers, "TIMESYNC")
        for i in np.flatnonzero(fields.tc1 != 0).tolist():
            links[owner[frame_numbers[i]]].timing.add_round_trip(
                float(fields.ts1[i]) * 1e-9, float(frames.arrival[frame_numbers[i]])
            )
