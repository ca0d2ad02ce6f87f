"""One site of a given size, watched for a while: what was done, what it cost, what was left undone."""

import os
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fleet.contract import FleetState, Prediction, Sample
from tests.bench.referee.site import Site, cpu_s, until
from twin_worker.twin.state.budget import parse_schedule

_MODELS = 0.95  # share of the aircraft that must have a model before anything is counted [-]
_PATIENCE_S = 240.0  # with models [s]
_RIPE_S = 60.0  # of flight before anything is counted: until then there is no hybrid, and without one no ensemble [s]
_KINDS = ("predict", "identify", "ensemble")


@dataclass(frozen=True)
class Size:
    """What is tried.

    Attributes:
        uavs, workers: how many
        pace: as `twin_worker --pace` takes it
        seconds: watched
    """

    uavs: int
    workers: int
    pace: str
    seconds: float


class _Ear:
    """Counts what the bus brings, unpacked by nobody."""

    def __init__(self, site: Site) -> None:
        self.heard: Counter[type] = Counter()
        for kind in (Sample, Prediction):
            site.reader.bus.subscribe_raw(kind, lambda *_, kind=kind: self.heard.update((kind,)))


def _state(site: Site) -> dict[str, int]:
    """Ask every worker what it did and shed so far."""
    found: Counter[str] = Counter()
    for state, _ in site.reader.bus.get(FleetState, timeout_s=5.0):
        found.update(state.tasks)
        found["shed"] += state.dropped_messages
        found["answered"] += 1
    return dict(found)


def _count(site: Site, ear: _Ear) -> dict[str, float]:
    cpu = {"worker_cpu": sum(worker.cpu_s for worker in site.workers), "gateway_cpu": cpu_s(site.gateway.pid)}
    heard = {"samples": ear.heard[Sample], "predictions": ear.heard[Prediction]}
    return {"t": time.monotonic(), **cpu, **heard, **_state(site)}


def watch(size: Size, recording: Path, router: str) -> dict[str, Any]:
    """Begin a site, wait for its models, and count."""
    with Site(size.uavs, router, pace=size.pace) as site:
        site.open(recording, size.workers)
        begun = time.monotonic()
        ready = int(_MODELS * size.uavs)
        until(lambda: len(site.reader.fits) >= ready or time.monotonic() - begun > _PATIENCE_S, 1e6, "models")
        until(lambda: time.monotonic() - begun > _RIPE_S, 1e6, "hybrids")
        ear, never = _Ear(site), threading.Event()
        before = _count(site, ear)
        gaps = _watch_gaps(site, size.seconds, never)
        after = _count(site, ear)
        rows = [row for state, _ in site.reader.bus.get(FleetState, timeout_s=5.0) for row in state.rows]
        said = [state.sentence for state, _ in site.reader.bus.get(FleetState, timeout_s=5.0) if state.sentence]
        rss = [worker.rss_mb for worker in site.workers]
        models = len(site.reader.fits)
    took = after["t"] - before["t"]
    rate = {name: (after.get(name, 0) - before.get(name, 0)) / took for name in after if name != "t"}
    ages = [row.prediction_age_s for row in rows if row.prediction_age_s is not None]
    wanted = parse_schedule(size.pace)
    periods = {kind: round(size.uavs / rate[kind], 2) if rate.get(kind) else None for kind in _KINDS}
    late = [kind for kind in _KINDS if periods[kind] is None or periods[kind] > 1.1 * getattr(wanted, kind)]  # type: ignore[operator]
    return {
        "uavs": size.uavs, "workers": size.workers, "pace": size.pace, "seconds": round(took, 1),
        "models": models, "waited_for_models_s": round(before["t"] - begun, 1),
        "period_s": periods, "late": late,
        "samples_a_second": round(rate["samples"], 1), "predictions_a_second": round(rate["predictions"], 1),
        "samples_shed": after.get("shed", 0) - before.get("shed", 0),
        "prediction_age_s": [round(float(np.quantile(ages, q)), 2) for q in (0.5, 0.99)] if ages else None,
        "longest_gap_s": round(gaps, 2),
        "worker_cores": round(rate["worker_cpu"], 3), "gateway_cores": round(rate["gateway_cpu"], 3),
        "worker_ms_a_uav_s": round(1e3 * rate["worker_cpu"] / size.uavs, 2),
        "worker_mb": [round(mb) for mb in rss], "said": said, "load": os.getloadavg()[0],
    }  # fmt: skip


def _watch_gaps(site: Site, seconds: float, never: threading.Event) -> float:
    """Let time pass; give the longest gap between predictions of one aircraft [s]."""
    begun = time.monotonic()
    site.reader.forget()
    while time.monotonic() - begun < seconds:
        never.wait(0.5)
    return site.reader.gap(set(range(site.uavs)), begun)
