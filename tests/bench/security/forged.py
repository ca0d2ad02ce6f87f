"""Claims of the far future: nobody adopts them, and whoever follows the documented rule hears the rightful writer."""

import time

from fleet.bus.bus_protocol import newest
from fleet.bus.codec import Stamp, timely
from fleet.bus.epoch_fence import Fence
from fleet.bus.memory_bus import MemoryBus
from fleet.contract import Claim, Handover, Status
from twin_worker.ownership.protocol import Claiming

FORGED = (2**62 - 1, 2**63 - 1, 2**64 - 1)
LATER_MS = 600_000  # 10 minutes


class _Keeper:
    """Keep nothing but the epochs."""

    quiet: frozenset[int] = frozenset()
    bare: tuple[int, ...] = ()

    def __init__(self) -> None:
        self.epochs: dict[int, int] = {}

    def expect(self, uavs: object) -> None:
        """Do nothing."""

    def recall(self, uavs: list[int]) -> None:
        """Do nothing."""

    def adopt(self, uav: int, epoch: int, twin: Handover | None) -> None:
        """Note the epoch."""
        self.epochs[uav] = epoch

    def renew(self, uav: int, epoch: int) -> None:
        """Note the epoch."""
        self.epochs[uav] = epoch

    def drop(self, uavs: object) -> None:
        """Do nothing."""

    def copied(self, uav: int, epoch: int) -> Handover | None:
        """Give none."""
        return None

    @property
    def kept(self) -> dict[int, bool]:
        """Tell that all are here."""
        return dict.fromkeys(self.epochs, True)


def _worker() -> tuple[MemoryBus, Claiming, _Keeper]:
    bus, keeper = MemoryBus(), _Keeper()
    worker = Claiming(bus, range(8), keeper)
    worker.join()
    worker.hear_of(1)
    assert set(worker.claims.held) == {1}, "it holds what nobody else does"
    return bus, worker, keeper


def _now_ms() -> int:
    return int(time.time() * 1e3)


def claims_of_the_future() -> str:
    """A claim, a result and a token of an epoch that will never be, towards an honest worker."""
    for epoch in (*FORGED[:2], _now_ms() + LATER_MS):
        bus, worker, keeper = _worker()
        bus.publish(Claim(t=1.0, worker="f" * 16, held=((1, epoch), (2, epoch)), seen=((3, epoch, "e" * 16),)))
        worker.overheard(1, Stamp(epoch, 2**63 - 1))
        bus.present(f"worker/{'f' * 16}/0-7/{epoch}")
        worker.turn()
        assert 1 in worker.claims.held, f"epoch {epoch} took the aircraft away"
        seen = max(rank.epoch for rank in worker.claims.seen.values())
        assert timely(seen) and timely(keeper.epochs[1]), f"epoch {epoch} was adopted: {seen}"
        assert not worker.claims.peers, f"a life that begins at {epoch} was believed"
        bus.publish(Claim(t=1.0, worker="f" * 16, held=((1, _now_ms() + 60_000),)))
        assert 1 not in worker.claims.held, "a rightful higher claim, of a clock a minute ahead, is heeded"
    return "refused; one of a clock a minute ahead is heeded"


def results_of_the_future() -> str:
    """Results stamped with epochs that will never be, towards a reader."""
    rightful = Stamp(_now_ms(), 1)
    for epoch in (*FORGED, _now_ms() + LATER_MS):
        fence = Fence()
        assert not fence.believes(1, Stamp(epoch, 2)), f"epoch {epoch} was believed"
        assert fence.believes(1, rightful), f"epoch {epoch} blinds the reader"
        ((found, stamp),) = newest([(Status(uav=1, t=9.0), Stamp(epoch, 2)), (Status(uav=1, t=1.0), rightful)])
        assert found.t == 1.0 and stamp == rightful, f"epoch {epoch} won the answer"
    return "refused; the rightful writer is heard"


BY_FORGING = (claims_of_the_future, results_of_the_future)
