"""All flights of a blind test: draw the hidden effects, simulate in several processes, check, return the labels."""

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fleet.simulator.conceal import roles
from fleet.simulator.conceal.acts import LEAST, acts
from fleet.simulator.conceal.cards import card
from fleet.simulator.conceal.plan import EXCITED, Job, Planned, draw
from fleet.simulator.conceal.record import fly, why_not_sane
from fleet.simulator.conceal.truth import effect

AIRFRAMES = ("c172p", "small")
_ATTEMPTS = 25
Label = dict[str, Any]
Labels = dict[str, Label]


def exam(
    seed: int, flights: int, out: Path, progress: Callable[[str, int, int], None] = lambda *_: None, jobs: int = 2
) -> Labels:
    """Simulate the flights of a blind test into a folder and return the labels.

    Args:
        seed: seed of all random draws
        flights: number of test recordings, without the nominal ones
        out: folder; one subfolder per airframe with recordings and `<airframe>.card.json`
        progress: called for every flight with its name, the number done and the total
        processes: number of processes
    Returns:
        {flight: {role, airframe, seed, effects, flown_s, acts, redrawn}}, times since its first ATTITUDE [s]
    Raises:
        ValueError: when there are too few flights for all roles.
        RuntimeError: when an effect stays too weak in all attempts.
    """
    wanted = jobs_of(seed, flights)
    for airframe in AIRFRAMES:
        (out / airframe).mkdir(parents=True, exist_ok=True)
        (out / airframe / f"{airframe}.card.json").write_text(json.dumps(card(airframe), indent=1) + "\n")
    labels: Labels = {}
    for name, label in _flown([(job, seed, out) for job in wanted], jobs):
        labels[name] = label
        progress(name, len(labels), len(wanted))
    return dict(sorted(labels.items()))


def jobs_of(seed: int, flights: int) -> list[Job]:
    """Draw the effects of all flights; order and names are independent of them."""
    rng = np.random.default_rng((seed, 22))
    wanted: list[tuple[str, str, tuple[str, ...]]] = []
    for k, (role, count) in enumerate(roles.counts(flights).items()):
        for i, airframe in enumerate(AIRFRAMES):
            share = (count + (i + k) % 2) // 2
            wanted += [(airframe, role, names) for names in _names(rng, role, airframe, share)]
    names = sorted(f"rec_{int(x):08x}" for x in rng.choice(2**32, len(wanted), replace=False))
    shuffled = [wanted[i] for i in rng.permutation(len(wanted))]
    named = [
        Job(name, airframe, role, hidden, number)
        for number, (name, (airframe, role, hidden)) in enumerate(zip(names, shuffled, strict=True))
    ]
    nominal = [
        Job(f"cal_{airframe}_{k}", airframe, "nominal", (), 1_000 + 10 * i + k, strength)
        for i, airframe in enumerate(AIRFRAMES)
        for k, strength in enumerate(EXCITED)
    ]
    return nominal + named


def _names(rng: np.random.Generator, role: str, airframe: str, count: int) -> list[tuple[str, ...]]:
    draws = {"single": roles.singles, "compound": roles.compounds, "unknown": roles.unknowns}
    return draws[role](rng, airframe, count) if role in draws else [()] * count


def _flown(tasks: list[tuple[Job, int, Path]], jobs: int) -> Iterator[tuple[str, Label]]:
    """Simulate in this process, or in several processes that end with this one."""
    if jobs == 1:
        yield from map(_fly, tasks)
        return
    with multiprocessing.get_context("spawn").Pool(jobs, _begin, (os.getpid(),)) as pool:
        yield from pool.imap(_fly, tasks)
        pool.close()
        pool.join()


def _begin(parent: int) -> None:
    """Ignore Ctrl-C, which the parent handles, and exit when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_outlive_nobody, args=(parent,), daemon=True).start()


def _outlive_nobody(parent: int) -> None:
    while os.getppid() == parent:
        threading.Event().wait(1.0)
    os._exit(1)


def _fly(task: tuple[Job, int, Path]) -> tuple[str, Label]:
    """Draw a flight until it stays in the envelope and all hidden effects are strong enough; record it."""
    job, seed, out = task
    refused: list[str] = []
    for attempt in range(_ATTEMPTS):
        planned = draw(job, seed, attempt)
        label = _tried(planned, out / job.airframe / f"{job.name}.tlog", refused)
        if label is not None:
            return job.name, label | {"redrawn": refused}
    raise RuntimeError(f"{job.name}: {job.wanted} on {job.airframe} rejected {_ATTEMPTS} times: {', '.join(refused)}")


def _tried(planned: Planned, path: Path, refused: list[str]) -> Label | None:
    """Record one flight and return its label, or append the reason for rejection and return None."""
    log, first = fly(planned, planned.hidden, path)
    why = why_not_sane(planned, log)
    shown: list[Label] = []
    for fault in planned.hidden if not why else ():
        shown.append(acts(planned, fault, log))
        if shown[-1]["over_noise"] < LEAST:
            why = f"{fault.name} {fault.of} has strength {shown[-1]['over_noise']} in {shown[-1]['channel']}"
    if why:
        refused.append(why)
        path.unlink()
        return None
    return {
        "role": planned.job.role,
        "airframe": planned.job.airframe,
        "seed": planned.flight,
        "effects": [effect(planned, fault, log, first) for fault in planned.hidden],
        "flown_s": planned.seconds,
        "acts": shown,
    }
