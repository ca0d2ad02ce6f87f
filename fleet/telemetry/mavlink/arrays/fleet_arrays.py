"""Array state of the aircraft of one link or log: clocks, row arbitration, pending rows, counters."""

from collections.abc import Hashable, Sequence

import numba as nb
import numpy as np

from fleet.bus.codec import EncodedMessage
from fleet.contract import Sample
from fleet.telemetry.mavlink.arrays.counts import MessageCounters
from fleet.telemetry.mavlink.arrays.pack import FIELDS
from fleet.telemetry.mavlink.arrays.row_arbiter import new_arbiter_state
from fleet.telemetry.mavlink.arrays.rows import PendingRows
from fleet.telemetry.tables import clock

NOT_REPEATED = -1
_REPEATED_KINDS = 2
_MAX_REPEATED = 32  # longest payload that is compared [bytes]
_NOTHING = 255  # in place of a size


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
        self.autopilots = np.empty(0, np.int8)  # index in `heartbeat.AUTOPILOTS`, (m,)
        self.observed = np.empty(0, bool)  # every message is processed, also a repeated one, (m,)
        self._last_payloads = np.empty((0, _REPEATED_KINDS, 1 + _MAX_REPEATED), np.uint8)  # size and bytes
        # index of each sender and, by aircraft, that of its own; None: senders have changed since
        self.sources: tuple[dict[Hashable, int], np.ndarray] | None = None
        self.second_ports: dict[int, tuple[float, np.ndarray]] = {}  # by aircraft: arrival [s since 1970], (8,) [us]

    def add_aircraft(self, uav: int) -> int:
        """Add one aircraft; return its number."""
        self.counts.add_aircraft()
        self.pending.add_aircraft(uav)
        self.next_due_t = np.append(self.next_due_t, -np.inf)
        self.autopilots, self.observed = np.append(self.autopilots, np.int8(0)), np.append(self.observed, False)
        nothing = np.full((1, *self._last_payloads.shape[1:]), _NOTHING, np.uint8)
        self._last_payloads = np.concatenate([self._last_payloads, nothing])
        self.clocks = np.concatenate([self.clocks, clock.new_clocks()[None]])
        self.arbiter_state = np.concatenate([self.arbiter_state, new_arbiter_state()[None]])
        return len(self.clocks) - 1

    def reset_aircraft(self, number: int) -> None:
        """Reset one aircraft; it has no messages until data arrive."""
        self.counts.reset(number)
        self.clocks[number], self.arbiter_state[number] = clock.new_clocks(), new_arbiter_state()
        self.pending.dropped[number], self.autopilots[number], self.observed[number] = 0, 0, False
        self.forget_payloads(number)
        self.second_ports.pop(number, None)
        self.next_due_t[number] = np.inf

    def find_repeated(self, buf: np.ndarray, payloads: np.ndarray, owner: np.ndarray, kind: np.ndarray) -> np.ndarray:
        """Return whether each message repeats the last payload of its kind and aircraft, (n,) bool; store the others.

        Args:
            buf: bytes that contain the messages
            payloads: start and size of their payloads, in order of reception, (n, 2)
            owner: number of the aircraft, -1 without, (n,)
            kind: a number, 0 or 1, of a message whose repetition changes nothing, else NOT_REPEATED, (n,)
        """
        return _find_repeated(buf, payloads, owner, kind, self.observed, self._last_payloads)

    def forget_payloads(self, number: int | slice) -> None:
        """Forget the last payloads of an aircraft: the next messages count as new."""
        self._last_payloads[number, :, 0] = _NOTHING

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


@nb.njit(cache=True, nogil=True)
def _find_repeated(buf, payloads, owner, kind, observed, last):
    repeated = np.zeros(len(payloads), np.bool_)
    for i in range(len(payloads)):
        start, size = payloads[i, 0], payloads[i, 1]
        if owner[i] < 0 or kind[i] == NOT_REPEATED or size >= last.shape[2]:
            continue
        known = last[owner[i], kind[i]]
        is_same = known[0] == size
        for k in range(size):
            is_same = is_same and known[1 + k] == buf[start + k]
        if is_same:
            repeated[i] = not observed[owner[i]]
            continue
        known[0] = size
        for k in range(size):
            known[1 + k] = buf[start + k]
    return repeated
