"""Does memory grow, or fill? Windows and records fill in the first half of a run; what grows goes on growing."""

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .site import Site

_SHARE, _LEAST_MB = 0.05, 5.0  # growth over the second half that may be chance [-, MB]
_SURE = 3.0  # standard errors from which a slope is one
_LEAST = 8  # rows from which anything is said
_FULL_MIN = 6.0  # after which windows, records and the gateway's history are full [min]


class Row(NamedTuple):
    """One process at one time: minutes since the beginning, its age [s], aircraft it holds, memory [MB]."""

    minutes: float
    who: str
    age_s: float
    aircraft: int
    mb: float


def own_mb(pid: int) -> float:
    """Give the memory that is a process's own or shared by processes; not files, as libraries are, that come page by
    page the first time they are used [MB]."""
    found = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if "Rss" in line)
    return sum(int(found[name].split()[0]) for name in ("RssAnon", "RssShmem")) / 1e3


class Memory:
    """Who had how much, and when: workers by name, and others that live from beginning to end.

    Args:
        site: whose workers are followed
        others: process ids by name
    """

    def __init__(self, site: Site, others: dict[str, int]) -> None:
        self._site, self._others, self._begun = site, others, time.monotonic()
        self._born: dict[str, float] = {}
        self.rows: list[Row] = []

    def note(self) -> None:
        """Take one row of each."""
        now = time.monotonic()
        holders = list(self._site.reader.holders().values())
        pids = {worker.name: worker.process.pid for worker in self._site.workers if worker.process.poll() is None}
        for who, pid in (self._others | pids).items():
            age = now - self._born.setdefault(who, now)
            self.rows.append(Row((now - self._begun) / 60.0, who, age, holders.count(who), own_mb(pid)))

    def found(self, spared: str) -> dict[str, Any]:
        """Give what became of each over the second half, at an equal number of aircraft.

        Args:
            spared: the worker that lives all the way; the others are generations, compared at equal age, too
        """
        alone = {"worker": [row for row in self.rows if row.who == spared]}
        alone |= {name: [row for row in self.rows if row.who == name] for name in self._others}
        later = [row for row in self.rows if row.who not in {spared, *self._others}]
        return {name: _over(rows) for name, rows in alone.items()} | {"generations": _over(later, by_age=True)}


def _over(rows: list[Row], *, by_age: bool = False) -> dict[str, Any]:
    """Fit  mb = a + b minutes + c aircraft (+ d age)  to the second half, and say whether b is growth;
    `grows` is None where the run is too short to tell."""
    since = max(0.5 * max((row.minutes for row in rows), default=0.0), _FULL_MIN)
    half = [row for row in rows if row.minutes >= since]
    if len(half) < _LEAST:
        return {"rows": len(rows), "grows": None}
    minutes, mb = np.array([row.minutes for row in half]), np.array([row.mb for row in half])
    columns = [np.ones(len(half)), minutes - minutes.mean(), [row.aircraft for row in half]]
    if by_age:
        columns.append([min(row.age_s, 60.0 * _FULL_MIN) for row in half])
    A = np.column_stack(columns).astype(float)
    fit = np.linalg.lstsq(A, mb, rcond=None)[0]
    variance = float(np.sum((mb - A @ fit) ** 2)) / (len(half) - A.shape[1])
    sigma = float(np.sqrt(variance * np.linalg.pinv(A.T @ A)[1, 1]))
    grown = float(fit[1]) * float(np.ptp(minutes))
    return {
        "rows": len(rows), "first_mb": round(rows[0].mb, 1), "half_mb": round(half[0].mb, 1),
        "last_mb": round(rows[-1].mb, 1), "mb_a_minute": round(float(fit[1]), 3), "sigma": round(sigma, 3),
        "grown_mb": round(grown, 1), "mb_an_aircraft": round(float(fit[2]), 2),
        "grows": bool(fit[1] > _SURE * sigma and grown > max(_SHARE * float(mb.mean()), _LEAST_MB)),
    }  # fmt: skip
