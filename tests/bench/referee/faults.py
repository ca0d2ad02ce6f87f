"""The faults, one a function: done to one worker or to the router, measured at the reader."""

import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np

from fleet.contract import FleetState
from twin_worker.ownership.protocol_state import owners

from .site import Site, Worker, until
from .starve import limited, throttled_s

_PATIENCE_S = 30.0
_AFTER_S = 2.0  # looked at after it is over [s]
_CALM_S = 4.0
_SHOWN, _LONG_S = 5, 3.0  # aircraft of which is told what was wrong, and from which gap on [s]
_STARVED = 0.1  # share of a core [-]


def _held(site: Site, worker: Worker) -> set[int]:
    return {uav for uav, name in site.reader.holders().items() if name == worker.name}


def _own(site: Site, worker: Worker) -> set[int]:
    """Give what a worker should hold."""
    everyone = {one.name: range(site.uavs) for one in site.workers}
    return {uav for uav, name in owners(range(site.uavs), everyone).items() if name == worker.name}


def wait(seconds: float) -> None:
    """Let time pass."""
    end = time.monotonic() + seconds
    until(lambda: time.monotonic() >= end, seconds + 1.0, "time")


def _taken_over(site: Site, uavs: set[int], was: str, begun: float) -> dict[str, Any]:
    """Wait until others hold these; give how long that took and the longest gap."""
    until(lambda: site.reader.taken(uavs, begun, was) is not None, _PATIENCE_S, f"new owners of {len(uavs)} aircraft")
    taken = site.reader.taken(uavs, begun, was)
    wait(_AFTER_S)
    return {"aircraft": len(uavs), "taken_s": taken, "gap_s": site.reader.gap(uavs, begun)}


def calm(site: Site, worker: Worker) -> dict[str, Any]:
    """Do nothing, for as long as a handover takes: what is no worse than this is no fault's."""
    uavs, begun = _held(site, worker), time.monotonic()
    wait(_CALM_S)
    return {"aircraft": len(uavs), "gap_s": site.reader.gap(uavs, begun)}


def kill(site: Site, worker: Worker) -> dict[str, Any]:
    """Kill a worker with -9."""
    uavs, was = _held(site, worker), worker.name
    windows = [site.reader.windows.get(uav, 0.0) for uav in uavs]
    begun = time.monotonic()
    worker.signal(signal.SIGKILL)
    found = _taken_over(site, uavs, was, begun)
    site.lose(worker)
    return found | {"window_before_s": float(np.median(windows)) if windows else None}


def freeze(site: Site, worker: Worker, seconds: float = 5.0) -> dict[str, Any]:
    """Stop a worker as a suspended machine does, and let it go on."""
    uavs, was = _held(site, worker), worker.name
    begun = time.monotonic()
    worker.signal(signal.SIGSTOP)
    try:
        found = _taken_over(site, uavs, was, begun)
        wait(max(begun + seconds - time.monotonic(), 0.0))
    finally:
        worker.signal(signal.SIGCONT)
    return found | {"back": _back(site, worker)}


def _back(site: Site, worker: Worker) -> dict[str, Any]:
    """Wait until a worker that is back holds what it owns again; give the longest gap meanwhile."""
    begun = time.monotonic()
    until(lambda: _held(site, worker) == _own(site, worker), _PATIENCE_S, "a worker that is back")
    took = time.monotonic() - begun
    wait(1.0)
    uavs = set(range(site.uavs))
    return {"s": took, "gap_s": site.reader.gap(uavs, begun)}


def leave(site: Site, worker: Worker) -> dict[str, Any]:
    """End a worker politely."""
    uavs, was, fits = _held(site, worker), worker.name, site.reader.rows()
    begun = time.monotonic()
    worker.signal(signal.SIGTERM)
    found = _taken_over(site, uavs, was, begun)
    until(lambda: worker.process.poll() is not None, _PATIENCE_S, "the end of a worker")
    found["ended_s"] = time.monotonic() - begun
    site.lose(worker)
    return found | _fits(uavs, fits, site.reader.rows())


def join(site: Site, _: Worker) -> dict[str, Any]:
    """Add a worker."""
    fits = site.reader.rows()
    begun_all = time.monotonic()
    worker = site.add()
    begun = time.monotonic()
    until(lambda: _held(site, worker) == _own(site, worker), _PATIENCE_S, "aircraft for it")
    wait(_AFTER_S)
    uavs = _held(site, worker)
    found = {"aircraft": len(uavs), "gap_s": site.reader.gap(uavs, min(begun, begun_all + 1.0))}
    return found | _fits(uavs, fits, site.reader.rows())


def _fits(uavs: set[int], before: dict[int, float], after: dict[int, float]) -> dict[str, Any]:
    both = [(before[uav], after[uav]) for uav in uavs if uav in before and uav in after]
    if not both:
        return {"fit_before": None, "fit_after": None}
    return {"fit_before": float(np.mean([a for a, _ in both])), "fit_after": float(np.mean([b for _, b in both])),
            "fits_lost": len(uavs & before.keys()) - len(both)}  # fmt: skip


def restart_router(site: Site, _: Worker, seconds: float = 1.0) -> dict[str, Any]:
    """Kill the router and start another."""
    before = site.reader.holders()
    begun = time.monotonic()
    site.router_process.kill()
    site.router_process.wait()
    wait(seconds)
    site.open_router()
    away = time.monotonic() - begun
    until(lambda: len(site.reader.holders()) == len(before), _PATIENCE_S, "everyone's return")
    wait(3.0)
    after = site.reader.holders()
    moved = sum(after.get(uav) != name for uav, name in before.items())
    return {"away_s": away, "gap_s": site.reader.gap(set(before), begun), "owners_changed": moved}


def cut(site: Site, worker: Worker, seconds: float = 3.0) -> dict[str, Any]:
    """Cut a worker off from the router, and mend the way."""
    return _barred(site, worker, "cut", seconds)


def stall(site: Site, worker: Worker, seconds: float = 3.0) -> dict[str, Any]:
    """Let nothing through between a worker and the router, without a word to either."""
    return _barred(site, worker, "stalled", seconds)


def _barred(site: Site, worker: Worker, how: str, seconds: float) -> dict[str, Any]:
    """Bar a worker's way to the router for some time [s]."""
    uavs, was = _held(site, worker), worker.name
    begun = time.monotonic()
    setattr(worker.way, how, True)
    try:
        found = _taken_over(site, uavs, was, begun)
        wait(max(begun + seconds - time.monotonic(), 0.0))
    finally:  # also when nobody took over in time
        setattr(worker.way, how, False)
    return found | {"back": _back(site, worker)}


def delay(site: Site, worker: Worker, seconds: float = 3.0) -> dict[str, Any]:
    """Let everything come 150 ms late for a while: nobody is dead."""
    assert worker.way is not None
    before, begun = site.reader.holders(), time.monotonic()
    worker.way.delay_s = 0.15
    wait(seconds)
    worker.way.delay_s = 0.0
    wait(1.0)
    moved = sum(site.reader.holders().get(uav) != name for uav, name in before.items())
    return {"owners_changed": moved, "gap_s": site.reader.gap(set(before), begun)}


def blink(site: Site, worker: Worker) -> dict[str, Any]:
    """Stop a worker for less than its lease."""
    before, begun = site.reader.holders(), time.monotonic()
    worker.signal(signal.SIGSTOP)
    wait(0.5)
    worker.signal(signal.SIGCONT)
    wait(2.0)
    moved = sum(site.reader.holders().get(uav) != name for uav, name in before.items())
    return {"owners_changed": moved, "gap_s": site.reader.gap(set(before), begun)}


def starve(site: Site, _: Worker, seconds: float = 25.0) -> dict[str, Any]:
    """Limit every worker to a tenth of a core for a while: all are late, nobody is dead."""
    return _starved(site, [worker.process.pid for worker in site.workers], seconds)


def starve_all(site: Site, _: Worker, seconds: float = 25.0) -> dict[str, Any]:
    """Limit every worker, the gateway and the router to a tenth of a core each."""
    pids = [site.gateway.pid, site.router_process.pid, *(worker.process.pid for worker in site.workers)]
    return _starved(site, pids, seconds)


def busy(site: Site, _: Worker, seconds: float = 20.0) -> dict[str, Any]:
    """Let two other processes use all the processor time they can get for a while."""
    uavs, changes, begun = set(range(site.uavs)), site.reader.moved, time.monotonic()
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        wait(seconds)
    finally:
        for other in others:
            other.kill()
            other.wait()
    return {"owners_changed": site.reader.moved - changes, "gap_s": site.reader.gap(uavs, begun)}


def _silent(site: Site, uavs: set[int], since: float) -> list[str]:
    """Tell of the aircraft with the longest gaps what their workers say of them."""
    gaps = sorted(((site.reader.gap({uav}, since), uav) for uav in uavs), reverse=True)[:_SHOWN]
    rows = {row.uav: row for state, _ in site.reader.bus.get(FleetState, timeout_s=5.0) for row in state.rows}
    found = [(gap, uav, rows.get(uav)) for gap, uav in gaps if gap > _LONG_S]
    return [
        f"uav-{uav} {gap:.1f} s: {row and (row.state.value, row.sample_age_s, row.prediction_age_s)}"
        for gap, uav, row in found
    ]


def _starved(site: Site, pids: list[int], seconds: float) -> dict[str, Any]:
    """Limit processes for some time [s]; give how many owners changed, and how many predictions there are left."""
    uavs = set(range(site.uavs))
    usual_since, changes = time.monotonic(), site.reader.moved
    wait(_CALM_S)
    usual = site.reader.count(uavs, usual_since) / _CALM_S
    used = sum(worker.cpu_s for worker in site.workers)
    with limited(pids, _STARVED):
        begun = time.monotonic()
        wait(seconds)
        took = time.monotonic() - begun
        per_s, gap, late = site.reader.count(uavs, begun) / took, site.reader.gap(uavs, begun), site.reader.late(begun)
        claims, silent = site.reader.announced(begun), _silent(site, uavs, begun)
        used = (sum(worker.cpu_s for worker in site.workers) - used) / took
        names = {site.gateway.pid: "gateway", site.router_process.pid: "router"}
        throttled = [(names.get(pid, "worker"), round(throttled_s(pid) / took, 2)) for pid in pids]
    back = time.monotonic()
    wait(_CALM_S)
    return {
        "owners_changed": site.reader.moved - changes,
        "claims_gap_s": claims,
        "longest": silent,
        "gap_s": gap,
        "predictions_per_s": [round(usual, 1), round(per_s, 1)],
        "behind_s": late,
        "workers_cpu": round(used, 2),
        "throttled": throttled,  # time each process waited for its next period, by all its threads [s/s]
        "back": {"gap_s": site.reader.gap(uavs, back)},
    }


ALL = {
    one.__name__: one
    for one in (calm, kill, freeze, leave, join, restart_router, cut, stall, delay, blink, busy, starve, starve_all)
}
ON_THE_WAY = (cut, stall, delay)  # for a worker that has a way of its own
ENDS = (kill, leave)  # for a worker that is not spared
