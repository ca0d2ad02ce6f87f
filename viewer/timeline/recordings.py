"""Recordings of all UAVs, shared by all pages; and the player that moves the time shown."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from viewer.store.place import SceneFrame
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.timeline.recording import GAP_S, PREDICTION_STEP_S, RETENTION_S, UavRecording


class TimelineRange(NamedTuple):
    """Available time range: oldest to newest recorded data time [s since 1970]."""

    begin: float
    end: float

    def clip(self, t: float) -> float:
        """Clip a time to the range."""
        return min(max(t, self.begin), self.end)

    def fraction(self, t: float) -> float:
        """Return the relative position of a time in the range, 0 to 1."""
        return (self.clip(t) - self.begin) / max(self.end - self.begin, 1e-9)


@dataclass
class Player:
    """Time shown and playback rate."""

    t: float | None = None  # data time shown [s since 1970]; None: live
    rate: float = 0.0  # data seconds per wall second; 0 paused

    @property
    def live(self) -> bool:
        """Return whether the page is live."""
        return self.t is None

    def go_live(self) -> None:
        """Return to live."""
        self.t, self.rate = None, 0.0

    def seek(self, t: float, span: TimelineRange) -> None:
        """Show another time; a live player pauses there."""
        self.t = span.clip(t)

    def pause(self, span: TimelineRange) -> None:
        """Pause at the time shown."""
        self.t, self.rate = span.end if self.t is None else self.t, 0.0

    def play(self, rate: float, span: TimelineRange) -> None:
        """Play at a rate from the time shown; from live, play from the beginning."""
        self.t, self.rate = span.begin if self.t is None else self.t, rate

    def advance(self, elapsed: float, span: TimelineRange) -> None:
        """Advance by elapsed wall time [s]; skip deleted data, return to live at the end."""
        if self.t is None:
            return
        self.t = max(self.t + self.rate * elapsed, span.begin)
        if self.rate and self.t >= span.end:
            self.go_live()


MAX_START_GAP_S = 3600.0  # recordings that start farther apart are shown as simultaneous [s]
SMALL_FLEET, LARGE_FLEET = 50, 300  # UAVs up to which rows are recorded at 5 Hz; at 1 Hz, with predictions every 5 s
SMALL_FLEET_STEP_S, STEP_S = 0.15, 0.9  # shortest time between two records [s]
NO_TRAIL = np.zeros((0, 5))


class RecordingStore:
    """Recording of every UAV."""

    def __init__(self) -> None:
        self.by_uav: dict[int, UavRecording] = {}
        self.scene_frame: SceneFrame | None = None
        self.prediction_step_s = PREDICTION_STEP_S  # between two recorded predictions of one UAV [s]
        self._due, self._second_half = -np.inf, False

    def record(self, store: FleetStore, copies: Callable[[], list[Vehicle]], now: float) -> None:
        """Record all UAVs at a rate that depends on their number; `copies` returns snapshots."""
        if store.scene_frame is not self.scene_frame:
            self.scene_frame = store.scene_frame
            self.by_uav.clear()
        if now < self._due:
            return
        fleet = copies()
        self._due = now + (SMALL_FLEET_STEP_S if len(fleet) <= SMALL_FLEET else STEP_S)
        self.prediction_step_s = PREDICTION_STEP_S * max(len(fleet) / LARGE_FLEET, 1.0)  # bounds the memory
        self._second_half, large_fleet = not self._second_half, len(fleet) > LARGE_FLEET
        for vehicle in fleet[self._second_half :: 2] if large_fleet else fleet:
            if (recording := self.by_uav.get(vehicle.uav)) is None:
                recording = self.by_uav[vehicle.uav] = UavRecording()
            is_behind = not large_fleet and (not len(recording) or vehicle.t - recording.t[-1] > GAP_S)
            recording.record(vehicle, store.trail(vehicle) if is_behind else NO_TRAIL, now, self.prediction_step_s)

    def nbytes(self) -> int:
        """Return the size of all recordings [bytes]."""
        return sum(recording.nbytes() for recording in list(self.by_uav.values()))

    def playback_range(self, clock_vehicle: Vehicle, fleet: list[Vehicle]) -> tuple[TimelineRange, dict[int, float]]:
        """Compute the available time range on the clock of one of the recorded UAVs `fleet`.

        Returns:
            the range, and the clock offsets of recordings of other days [s]
        """
        recordings = {vehicle.uav: self.by_uav[vehicle.uav] for vehicle in fleet}
        reference_t = recordings[clock_vehicle.uav].first_t
        ahead = {v.uav: recordings[v.uav].first_t - reference_t for v in fleet if v.recorded}
        shift = {uav: t for uav, t in ahead.items() if abs(t) > MAX_START_GAP_S}
        shifted = [(recordings.pop(uav), t) for uav, t in shift.items()]
        end = max([*(one.last_t for one in recordings.values()), *(one.last_t - t for one, t in shifted)])
        begin = min([*(one.first_t for one in recordings.values()), *(one.first_t - t for one, t in shifted)])
        begin = begin if clock_vehicle.recorded else max(begin, end - RETENTION_S)
        return TimelineRange(begin, end), shift
