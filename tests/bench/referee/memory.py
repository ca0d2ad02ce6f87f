"""The memory of the site's processes over a soak, and whether it grows."""

import time
from typing import Any

from tests.bench.growth import Row, grown, own_mb

from .site import Site

_FULL_MIN = 6.0  # after which windows, records and the gateway's history are full [min]


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
        return {name: grown(rows, _FULL_MIN) for name, rows in alone.items()} | {
            "generations": grown(later, _FULL_MIN, by_age=True)
        }
