"""The last minutes of one aircraft, from a gateway, into a twin that was never handed over."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fleet.bus import Bus
from fleet.contract import COLUMNS, Array, History, Message, Mission, Params, Rows, Sample, Status
from twin_worker.memory import Twin, hear

PATIENCE_S = 0.5  # with a gateway that does not answer [s]
SELDOM: tuple[type[Message], ...] = (Status, Params, Mission)
"""What is said so seldom that the last of each is worth keeping."""


def recall(bus: Bus, twin: Twin, known: Mapping[type, Message]) -> None:
    """Let a fresh twin hear what was said of its aircraft before; what is `known` already is not asked for."""
    for kind in SELDOM:
        found = [known[kind]] if kind in known else [said for said, _ in bus.ask(kind, twin.uav, PATIENCE_S)]
        for message in found:
            hear(twin, message)
    for said in bus.gather(History, twin.uav, b"", PATIENCE_S):
        if said.uav == twin.uav and said.samples:
            hear(twin, joined(said))


def joined(said: History) -> Sample:
    """Give many messages as one; what does not fit the others is left out."""
    kinds: dict[str, Any] = {}
    for name, columns in COLUMNS.items():
        rows = [found for one in said.samples if (found := getattr(one, name)) is not None]
        if rows:
            kinds[name] = _rows(rows, len(columns))
    return Sample(uav=said.uav, t=said.t, **kinds)


def _rows(rows: list[Rows], width: int) -> Rows | None:
    dtype = rows[-1].x.dtype
    fit = [row for row in rows if row.t.dtype == "<f8" and row.x.dtype == dtype and _whole(row, width)]
    n = sum(row.t.shape[0] for row in fit)
    if not n:
        return None
    t = Array("<f8", (n,), b"".join(row.t.data for row in fit))
    return Rows(t=t, x=Array(dtype, (n, width), b"".join(row.x.data for row in fit)))


def _whole(row: Rows, width: int) -> bool:
    """Tell whether rows have the shape and the bytes that their kind has."""
    n = row.t.shape[0] if len(row.t.shape) == 1 else -1
    try:
        size = np.dtype(row.x.dtype).itemsize
    except TypeError:
        return False
    return row.x.shape == (n, width) and len(row.t.data) == 8 * n and len(row.x.data) == size * n * width
