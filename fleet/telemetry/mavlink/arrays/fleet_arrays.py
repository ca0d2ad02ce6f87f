"""Array state of the aircraft of one link or log: clocks, row arbitration, pending rows, counters."""

from collections.abc import Sequence

import numpy as np

from fleet.bus.codec import EncodedMessage
from fleet.contract import Sample
from fleet.telemetry.mavlink.arrays.counts import MessageCounters
from fleet.telemetry.mavlink.arrays.pack import FIELDS
from fleet.telemetry.mavlink.arrays.row_arbiter import new_arbiter_state
from fleet.telemetry.mavlink.arrays.rows import PendingRows
from fleet.telemetry.tables import clock


class AircraftArrays:
    """State of many aircraft, numbered in order of registration.

    Args:
        names: names of the counted messages
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.counts, self.pending = MessageCounters(names), PendingRows()
        self.clocks = np.empty((0, *clock.new_clocks().shape))
        self.next_due_t = np.empty(0)  # latest time of the next messages other than rows, (m,) [s since 1970]
        self.arbiter_state = np.empty((0, *new_arbiter_state().shape))
        self.second_ports: dict[int, tuple[float, np.ndarray]] = {}  # by aircraft: arrival [s since 1970], (8,) [us]

    def add_aircraft(self, uav: int) -> int:
        """Add one aircraft; return its number."""
        self.counts.add_aircraft()
        self.pending.add_aircraft(uav)
        self.next_due_t = np.append(self.next_due_t, -np.inf)
        self.clocks = np.concatenate([self.clocks, clock.new_clocks()[None]])
        self.arbiter_state = np.concatenate([self.arbiter_state, new_arbiter_state()[None]])
        return len(self.clocks) - 1

    def reset_aircraft(self, number: int) -> None:
        """Reset one aircraft; it has no messages until data arrive."""
        self.counts.reset(number)
        self.clocks[number], self.arbiter_state[number] = clock.new_clocks(), new_arbiter_state()
        self.pending.dropped[number] = 0
        self.second_ports.pop(number, None)
        self.next_due_t[number] = np.inf

    def add_rows(self, number: int, field: str, t: np.ndarray, x: np.ndarray) -> None:
        """Add rows of one field that already have fleet times.

        Args:
            number: number of the aircraft
            field: field of `Sample`
            t: fleet time, increasing and later than all earlier rows, (n,) [s since 1970]
            x: values, (n, k)
        """
        self.pending.add_rows(np.full(len(t), number * len(FIELDS) + FIELDS.index(field)), t, t, x)

    def take_samples(self, now: float) -> dict[int, EncodedMessage]:
        """Return the samples of rows received up to `now` [s since 1970], by aircraft number."""
        self.counts.count_until(now)
        samples = self.pending.take_samples(now)
        uavs = self.pending.uavs.tolist() if samples else []
        return {number: EncodedMessage(Sample, uavs[number], payload, t) for number, payload, t in samples}
