"""Small DataFlash logs, written for tests, and their reading with everything that any reading must hold."""

import io
import struct
from collections import Counter
from functools import partial
from typing import Any

import numpy as np
from pymavlink import DFReader

from fleet.contract import ROW_WIDTHS
from fleet.telemetry.mavlink.onboard_log import FieldRows, OnboardEvent
from fleet.telemetry.onboard_logs.dataflash.reader import DataflashLog

LETTERS = DFReader.FORMAT_TO_STRUCT


class Writer:
    """A small log, the same messages in either form."""

    def __init__(self, text: bool = False) -> None:
        self.text = text
        self.data = b""
        self.types: dict[str, tuple[int, str]] = {}

    def fmt(self, name: str, codes: str, columns: str) -> "Writer":
        kind = len(self.types) + 1
        self.types[name] = (kind, codes)
        length = 3 + struct.calcsize("<" + "".join(LETTERS[c][0] for c in codes))
        if self.text:
            self.data += f"FMT, {kind}, {length}, {name}, {codes}, {columns}\n".encode()
        else:
            cells = struct.pack("<BB4s16s64s", kind, length, name.encode(), codes.encode(), columns.encode())
            self.data += b"\xa3\x95\x80" + cells
        return self

    def say(self, name: str, *values: Any) -> "Writer":
        """Values as an engineer would write them: degrees for L, metres for e."""
        kind, codes = self.types[name]
        if self.text:
            cells = [f"{v:.7f}" if isinstance(v, float) else str(v) for v in values]
            self.data += (", ".join([name, *cells]) + "\n").encode()
            return self
        raw = [
            v.encode() if isinstance(v, str) else round(v / LETTERS[c][1]) if LETTERS[c][1] else v
            for c, v in zip(codes, values, strict=True)
        ]
        form = "<" + "".join(LETTERS[c][0] for c in codes)
        self.data += bytes((0xA3, 0x95, kind)) + struct.pack(form, *raw)
        return self

    def log(self) -> DataflashLog:
        return log_of(self.data, "a.log" if self.text else "a.bin")


def log_of(data: bytes, name: str = "a.bin") -> DataflashLog:
    return DataflashLog(partial(io.BytesIO, data), name)


def read(log: DataflashLog) -> tuple[FieldRows, list[OnboardEvent], Counter]:
    """Read it all, and hold what any reading must hold."""
    parts: dict[str, list] = {}
    said, counts = [], Counter()
    for chunk in log.chunks():
        assert [s.t for s in chunk.events] == sorted(s.t for s in chunk.events)
        said += chunk.events
        counts.update(chunk.counts)
        for field, (t, values) in chunk.rows.items():
            assert len(t) == len(values) > 0 and (values.shape[1] in ROW_WIDTHS[field] or field == "servo")
            assert np.isfinite(values).all()
            parts.setdefault(field, []).append((t, values))
    rows = {f: (np.concatenate([t for t, _ in p]), np.concatenate([v for _, v in p])) for f, p in parts.items()}
    assert all((np.diff(t) > 0).all() for t, _ in rows.values())
    return rows, said, counts


def values(said: list[OnboardEvent], what: str) -> list[Any]:
    return [s.value for s in said if s.kind == what]


def rate(rows: FieldRows, field: str) -> float:
    t = rows[field][0]
    return (len(t) - 1) / (t[-1] - t[0])
