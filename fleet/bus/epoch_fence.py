"""Of all who write for one aircraft the highest claim is believed: a reader's side of the claims."""

import time
from collections.abc import Callable
from typing import NamedTuple

from fleet.bus.codec import Stamp, timely

GIVE_UP_S = 10.0  # a writer silent for so long has lost its claim: a lower one (a restarted fleet) may speak [s]


class _Believed(NamedTuple):
    rank: Stamp
    heard: float


class Fence:
    """Who is believed, by UAV id; brief double writing during a handover is normal, seeing it is not.

    Args:
        clock: any clock that only goes forward [s]
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._by_uav: dict[int, _Believed] = {}

    def believes(self, uav: int, stamp: Stamp | None) -> bool:
        """Return whether a worker may speak for an aircraft: nobody with a higher timely claim has spoken lately."""
        rank, now = stamp or Stamp(0, 0), self._clock()
        if not timely(rank.epoch):
            return False
        held = self._by_uav.get(uav)
        if held is not None and rank < held.rank and now - held.heard < GIVE_UP_S:
            return False
        self._by_uav[uav] = _Believed(rank, now)
        return True
