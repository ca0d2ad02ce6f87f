"""Fencing by epoch on the reader's side: accept only the writer with the highest claim on an aircraft."""

import time
from collections.abc import Callable
from typing import NamedTuple

from fleet.bus.codec import Stamp, is_plausible_epoch

WRITER_TIMEOUT_S = (
    10.0  # a writer silent for this long loses its claim: a lower one (a restarted fleet) is accepted [s]
)


class _AcceptedWriter(NamedTuple):
    rank: Stamp
    received_t: float


class EpochFence:
    """Accepted writer by UAV id; hides the brief double writing during a handover.

    Args:
        clock: any monotonic clock [s]
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._by_uav: dict[int, _AcceptedWriter] = {}

    def accepts(self, uav: int, stamp: Stamp | None) -> bool:
        """Return whether a result is accepted: no writer with a higher plausible claim wrote recently."""
        rank, now = stamp or Stamp(0, 0), self._clock()
        if not is_plausible_epoch(rank.epoch):
            return False
        current = self._by_uav.get(uav)
        if current is not None and rank < current.rank and now - current.received_t < WRITER_TIMEOUT_S:
            return False
        self._by_uav[uav] = _AcceptedWriter(rank, now)
        return True
