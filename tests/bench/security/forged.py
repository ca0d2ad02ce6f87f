"""Claims of the far future: nobody adopts them, and whoever follows the documented rule hears the rightful writer."""

import time

from fleet.bus.bus_protocol import EpochFence, select_latest
from fleet.bus.codec import Stamp, is_plausible_epoch
from fleet.contract import Claim, Handover, Status
from tests.support.memory_bus import MemoryBus
from twin_worker.ownership.protocol import OwnershipProtocol

FORGED = (2**62 - 1, 2**63 - 1, 2**64 - 1)
LATER_MS = 600_000  # 10 minutes


class _Keeper:
    """Keep nothing but the epochs."""

    not_publishing: frozenset[int] = frozenset()
    without_history: tuple[int, ...] = ()

    def __init__(self) -> None:
        self.epochs: dict[int, int] = {}

    def expect(self, uavs: object) -> None:
        """Do nothing."""

    def rehydrate(self, uavs: list[int]) -> None:
        """Do nothing."""

    def acquire(self, uav: int, epoch: int, twin: Handover | None) -> None:
        """Note the epoch."""
        self.epochs[uav] = epoch

    def set_epochs(self, epochs: dict[int, int]) -> None:
        """Note the epochs."""
        self.epochs.update(epochs)

    def release(self, uavs: object) -> None:
        """Do nothing."""

    def snapshot(self, uav: int, epoch: int) -> Handover | None:
        """Give none."""
        return None

    @property
    def ready_by_uav(self) -> dict[int, bool]:
        """Tell that all are here."""
        return dict.fromkeys(self.epochs, True)


def _worker() -> tuple[MemoryBus, OwnershipProtocol, _Keeper]:
    bus, keeper = MemoryBus(), _Keeper()
    worker = OwnershipProtocol(bus, range(8), keeper)
    worker.join()
    worker.on_aircraft(1)
    assert set(worker.state.owned) == {1}, "it holds what nobody else does"
    return bus, worker, keeper


def _now_ms() -> int:
    return int(time.time() * 1e3)


def claims_of_the_future() -> str:
    """A claim, a result and a token of an epoch that will never be, towards an honest worker."""
    for epoch in (*FORGED[:2], _now_ms() + LATER_MS):
        bus, worker, keeper = _worker()
        bus.publish(
            Claim(t=1.0, worker="f" * 16, owned=((1, epoch), (2, epoch)), highest_claims=((3, epoch, "e" * 16),))
        )
        worker.observe_stamp(1, Stamp(epoch, 2**63 - 1))
        bus.declare_liveliness(f"worker/{'f' * 16}/0-7/{epoch}")
        worker.step()
        assert 1 in worker.state.owned, f"epoch {epoch} took the aircraft away"
        seen = max(rank.epoch for rank in worker.state.highest.values())
        assert is_plausible_epoch(seen) and is_plausible_epoch(keeper.epochs[1]), f"epoch {epoch} was adopted: {seen}"
        assert not worker.state.peers, f"a life that begins at {epoch} was believed"
        bus.publish(Claim(t=1.0, worker="f" * 16, owned=((1, _now_ms() + 60_000),)))
        assert 1 not in worker.state.owned, "a rightful higher claim, of a clock a minute ahead, is heeded"
    return "refused; one of a clock a minute ahead is heeded"


def results_of_the_future() -> str:
    """Results stamped with epochs that will never be, towards a reader."""
    rightful = Stamp(_now_ms(), 1)
    for epoch in (*FORGED, _now_ms() + LATER_MS):
        fence = EpochFence()
        assert not fence.accepts(1, Stamp(epoch, 2)), f"epoch {epoch} was believed"
        assert fence.accepts(1, rightful), f"epoch {epoch} blinds the reader"
        ((found, stamp),) = select_latest([(Status(uav=1, t=9.0), Stamp(epoch, 2)), (Status(uav=1, t=1.0), rightful)])
        assert found.t == 1.0 and stamp == rightful, f"epoch {epoch} won the answer"
    return "refused; the rightful writer is heard"


BY_FORGING = (claims_of_the_future, results_of_the_future)
