"""The last minutes of one aircraft, from a gateway, into a twin that was never handed over."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fleet.contract import COLUMNS, DTYPES, Array, History, Message, Mission, Params, Rows, Sample, Status
from fleet.talk import Bus

PATIENCE_S = 0.5  # with a gateway that does not answer [s]
SELDOM: tuple[type[Message], ...] = (Status, Params, Mission)
"""What is said so seldom that the last of each is worth keeping."""


def recall(bus: Bus, uav: int, known: Mapping[type, Message]) -> list[Message]:
    """Ask what was said of an aircraft before, for a fresh twin to hear; what is `known` already is not asked for.

    Raises:
        ConnectionError: when the session is closed.
    """
    found: list[Message] = []
    for kind in SELDOM:
        found += [known[kind]] if kind in known else [said for said, _ in bus.ask(kind, uav, PATIENCE_S)]
    samples = [said for said in bus.gather(History, uav, b"", PATIENCE_S) if said.uav == uav and said.samples]
    return [*found, *map(joined, samples)]


def joined(said: History) -> Sample:
    """Give many messages as one; what does not fit the others is left out."""
    kinds: dict[str, Any] = {}
    for name, columns in COLUMNS.items():
        rows = [found for one in said.samples if (found := getattr(one, name)) is not None]
        if rows:
            kinds[name] = _rows(rows, len(columns))
    return Sample(uav=said.uav, t=said.t, **kinds)


def _rows(rows: list[Rows], width: int) -> Rows | None:
    """Put those together that are of the newest one's kind of number, and have the shape and bytes they say."""
    dtype = rows[-1].x.dtype
    if dtype not in DTYPES:
        return None
    size = width * np.dtype(dtype).itemsize
    times, values, n = [], [], 0
    for row in rows:
        t, x = row.t, row.x
        k = len(t.data) >> 3
        whole = t.shape == (k,) and x.shape == (k, width) and len(x.data) == k * size and len(t.data) == 8 * k
        if whole and t.dtype == "<f8" and x.dtype == dtype:
            times.append(t.data)
            values.append(x.data)
            n += k
    if not n:
        return None
    return Rows(t=Array("<f8", (n,), b"".join(times)), x=Array(dtype, (n, width), b"".join(values)))
