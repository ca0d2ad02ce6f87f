"""One flight heard by a twin that adapts to what is named, and from the first name on by a copy that does not."""

import copy
from contextlib import nullcontext
from dataclasses import dataclass, field

import numpy as np

from fleet.contract import DiagnosisOutcome, Message, Prediction, Sample
from fleet.frames import to_ned
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.mismatch.coordinator import ALL_UAVS, Coordinator
from twin_worker.mismatch.job import DiagnosisJob, DiagnosisResult, run_job
from twin_worker.twin.step import Twin, advance

ANSWER_S, REST_S = 3.0, 12.0  # after a diagnosis began: its answer, and the next one [s of data time]
AHEAD_S = (10, 30, 60)


@dataclass
class Inline:
    """Works a diagnosis out at once, and hands it over when a background process would."""

    now: float = 0.0
    cpu_s: float = 0.0
    began: float = -np.inf
    kept: DiagnosisResult | None = None

    @property
    def free(self) -> bool:
        """Tell whether a job may be given."""
        return self.kept is None and self.now >= self.began + REST_S

    @property
    def due(self) -> bool:
        """Tell whether an answer is to be given now."""
        return self.kept is not None and self.now >= self.began + ANSWER_S

    def submit(self, job: DiagnosisJob) -> None:
        """Work a job out."""
        self.kept, self.began = run_job(job), self.now
        self.cpu_s += self.kept.cpu_s

    def poll(self) -> DiagnosisResult | None:
        """Give its answer when it is due."""
        if self.kept is None or not self.due:
            return None
        found, self.kept = self.kept, None
        return found


@dataclass
class Flown:
    """What both said; `plain` is empty where nothing was named.

    Attributes:
        begin: first telemetry [s since 1970]
        truth: time, latitude, longitude, height as reported, (n, 4)
    """

    begin: float
    truth: np.ndarray
    adapting: list[Message] = field(default_factory=list)
    plain: list[Message] = field(default_factory=list)
    cpu_s: float = 0.0


def hear(heard: list[Message], base: Baseline | None) -> Flown:
    """Let both hear a flight."""
    positions = [m.position for m in heard if isinstance(m, Sample) and m.position is not None]
    truth = np.concatenate([np.column_stack([p.t.numpy(), p.x.numpy().astype(float)]) for p in positions])
    flown, hand = Flown(float(truth[0, 0]), truth), Inline()
    live = Coordinator(hand, {} if base is None else {ALL_UAVS: base})
    twin, plain = Twin.of(heard[0].uav), None
    for message in heard:
        flown.adapting += advance(twin, (message,))
        if plain is not None:
            flown.plain += advance(plain, (message,))
        if not isinstance(message, Sample):
            continue
        hand.now = message.t
        before = copy.deepcopy(twin) if plain is None and hand.due else None
        told = list(live.run_once([(twin, nullcontext())]))
        flown.adapting += told
        if any(one.outcome is DiagnosisOutcome.NAMED for one in told):
            plain = plain or before
    flown.cpu_s = hand.cpu_s
    return flown


def errors(said: list[Message], truth: np.ndarray, since: float, until: float) -> dict[int, float]:
    """Give the mean distance by look-ahead [s] of predictions made between two times from what came [m]."""
    miss: dict[int, list[float]] = {ahead: [] for ahead in AHEAD_S}
    for made in said:
        if isinstance(made, Prediction) and since < made.t <= until:
            flown = to_ned(made.ned_origin(), *truth[:, 1:].T)
            grid, path = made.ahead.numpy(), made.path.numpy()
            for ahead in AHEAD_S:
                if grid[-1] >= ahead and made.t + ahead <= truth[-1, 0]:
                    at = [np.interp(ahead, grid, path[:, i]) for i in range(3)]
                    was = [np.interp(made.t + ahead, truth[:, 0], flown[:, i]) for i in range(3)]
                    miss[ahead].append(float(np.linalg.norm(np.subtract(at, was))))
    return {ahead: float(np.mean(found)) for ahead, found in miss.items() if found}
