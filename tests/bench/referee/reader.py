"""What a reader sees: accepted predictions, gaps, claims that go back; and who says that it holds what."""

import threading
import time
from collections import defaultdict
from typing import NamedTuple

import numpy as np

from fleet.bus.bus_protocol import EpochFence
from fleet.bus.codec import Stamp
from fleet.bus.session import Bus
from fleet.contract import Claim, FleetState, Model, Prediction


class Came(NamedTuple):
    """One accepted prediction."""

    heard: float
    stamp: Stamp
    t: float


class Reader:
    """Listens to everything a viewer would, and remembers."""

    def __init__(self, bus: Bus) -> None:
        self.bus, self.lock, self.fence = bus, threading.Lock(), EpochFence()
        self.came: dict[int, list[Came]] = defaultdict(list)
        self.fits: dict[int, float] = {}  # mean fit of the model in force, as published last
        self.windows: dict[int, float] = {}
        self.whole: dict[str, dict[int, float]] = {}  # by worker: since when it holds which, not bare
        self.claimed: dict[str, list[float]] = defaultdict(list)  # when each worker announced
        self.ranks: dict[int, tuple[int, str]] = {}  # the highest claim on each aircraft
        self.moved = 0  # aircraft that another worker claimed
        self.regressions = self.fenced = self.back = self.changes = 0
        bus.subscribe(Prediction, self._prediction)
        bus.subscribe(Model, self._model)
        bus.subscribe(Claim, self._claim)

    def _prediction(self, made: Prediction, stamp: Stamp | None) -> None:
        assert stamp is not None
        with self.lock:
            came = self.came[made.uav]
            if not self.fence.accepts(made.uav, stamp):
                self.fenced += 1
                return
            self.regressions += bool(came) and stamp < came[-1].stamp
            self.back += bool(came) and made.t < came[-1].t - 0.5
            self.changes += bool(came) and stamp.writer != came[-1].stamp.writer
            came.append(Came(time.monotonic(), stamp, made.t))

    def _model(self, model: Model, stamp: Stamp | None) -> None:
        fit = (model.active_verdict or model.verdict).fit
        with self.lock:
            self.fits[model.uav] = float(np.mean(list(fit.values()))) if fit else float("nan")
            self.windows[model.uav] = model.window_s

    def _claim(self, claim: Claim, _: Stamp | None) -> None:
        now = time.monotonic()
        with self.lock:
            self.claimed[claim.worker].append(now)
            for uav, epoch in claim.owned:
                rank = self.ranks.get(uav, (0, ""))
                self.moved += bool(rank[1]) and claim.worker != rank[1] and (epoch, claim.worker) > rank
                self.ranks[uav] = max(rank, (epoch, claim.worker))
            before = self.whole.get(claim.worker, {})
            self.whole[claim.worker] = {
                uav: before.get(uav, now) for uav, _ in claim.owned if uav not in claim.without_history
            }

    def holders(self) -> dict[int, str]:
        """Ask who holds what."""
        found: dict[int, tuple[int, str]] = {}
        for claim, _ in self.bus.get(Claim):
            for uav, epoch in claim.owned:
                found[uav] = max(found.get(uav, (0, "")), (epoch, claim.worker))
        return {uav: worker for uav, (_, worker) in found.items()}

    def rows(self) -> dict[int, float]:
        """Ask for the mean fit of each model in force, by UAV id."""
        rows = [row for state, _ in self.bus.get(FleetState, timeout_s=3.0) for row in state.rows]
        return {row.uav: float(np.mean(list(row.fit.values()))) for row in rows if row.fit}

    def taken(self, uavs: set[int], since: float, was: str) -> float | None:
        """Give how long it took until all had another holder with a full window [s]; None: not yet."""
        with self.lock:
            others = [held for worker, held in self.whole.items() if worker != was]
        found = [max((held[uav] for held in others if uav in held), default=0.0) for uav in uavs]
        return max((at - since for at in found), default=0.0) if all(at >= since for at in found) else None

    def gap(self, uavs: set[int], since: float) -> float:
        """Give the longest time without an accepted prediction of any of these, up to now [s]."""
        return max((max(self._gaps(uav, since)) for uav in uavs), default=0.0)

    def usual(self, uavs: set[int], since: float) -> tuple[float, float]:
        """Give median and 99 % quantile of the times between accepted predictions [s]."""
        found = [gap for uav in uavs for gap in self._gaps(uav, since)]
        return float(np.median(found)), float(np.quantile(found, 0.99))

    def count(self, uavs: set[int], since: float) -> int:
        """Give how many predictions of these were accepted since."""
        with self.lock:
            return sum(one.heard >= since for uav in uavs for one in self.came[uav])

    def announced(self, since: float) -> float:
        """Give the longest time without an announcement of any worker [s]."""
        with self.lock:
            found = [[at for at in times if at >= since] for times in self.claimed.values()]
        return max((float(np.diff([since, *times, time.monotonic()]).max()) for times in found if times), default=0.0)

    def late(self, since: float) -> tuple[float, float]:
        """Give median and most of how much later predictions came than the newest of any was for [s]."""
        with self.lock:
            found = sorted((one.heard, one.t) for came in self.came.values() for one in came if one.heard >= since)
        if not found:
            return float("inf"), float("inf")
        heard, t = np.array(found).T
        behind = np.maximum.accumulate(t - heard) - (t - heard)
        return float(np.median(behind)), float(behind.max())

    def _gaps(self, uav: int, since: float) -> list[float]:
        with self.lock:
            heard = [one.heard for one in self.came[uav]]
        k = int(np.searchsorted(heard, since))
        at = [*heard[max(k - 1, 0) :], time.monotonic()]
        return np.diff(at).tolist() or [float("inf")]

    def silent(self, uavs: set[int], longer_s: float) -> set[int]:
        """Name those of which nothing was accepted for longer [s]."""
        now = time.monotonic()
        with self.lock:
            return {uav for uav in uavs if not self.came[uav] or now - self.came[uav][-1].heard > longer_s}

    def forget(self) -> None:
        """Forget all but the newest of each, so that a long run stays small."""
        with self.lock:
            for came in self.came.values():
                del came[:-1]
            self.claimed.clear()
