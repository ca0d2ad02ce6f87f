"""Onboard log of one aircraft whose content is a set of topics: rows by a table, in chunks of 30 s."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fleet.contract import ROW_WIDTHS
from fleet.telemetry.mavlink.onboard_log import Chunk, FieldRows, OnboardEvent
from fleet.telemetry.onboard_logs.topic import Topic
from fleet.telemetry.tables.row import FieldSource, is_plausible

CHUNK_S = 30.0
MIN_RATE_HZ = {"attitude": 4.0, "imu": 4.0, "position": 1.0, "velocity": 1.0, "air": 2.0, "servo": 2.0, "command": 1.0}
"""Minimum rate of an active source; without one, the source with the most rows wins [Hz]."""
_BLOCK_ROWS = 1 << 17  # rows processed at once

Rows = Mapping[str, tuple[FieldSource, ...]]
"""`Sample` field -> its sources, highest rank first."""


class TopicLog:
    """Content of a log as topics, see `onboard_log.OnboardLog`; a reader fills the attributes.

    Attributes:
        name: file name for messages
        skipped: unreadable parts
        topics: by name
        events: in time order
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.system, self.autopilot, self.vehicle, self.firmware = 1, "generic", "unknown", ""
        self.epoch_s: float | None = None
        self.skipped: list[str] = []
        self.topics: dict[str, Topic] = {}
        self.events: list[OnboardEvent] = []
        self.rows: FieldRows = {}

    def chunks(self) -> Iterator[Chunk]:
        """Return the log in chunks of 30 s from the start; may be called repeatedly."""
        all_times = [topic.t for topic in self.topics.values() if len(topic)]
        all_times += [np.array([event.t for event in self.events])] if self.events else []
        if not all_times:
            return
        first = min(float(t.min()) for t in all_times)
        for number in np.unique(np.concatenate([(t - first) // CHUNK_S for t in all_times])):  # no chunks without data
            chunk = self._cut(first + number * CHUNK_S, first + (number + 1) * CHUNK_S)
            if chunk.rows or chunk.events or chunk.counts:
                yield chunk

    def build_rows(self, rows: Rows, calculated: Mapping[str, str] = {}) -> None:
        """Extract the rows of every field from its best source, and drop the fields of long topics.

        Args:
            rows: sources of each field
            calculated: notes on sources that are calculated, by topic
        """
        for field in rows:
            best = self._best_source(rows[field])
            if best is None:
                continue
            row, t, values = best
            self.rows[field] = (t, values)
            if row.message in calculated:
                self.skipped.append(calculated[row.message])

    def drop_long_topics(self) -> None:
        """Free the fields of long topics; their times remain for the counts."""
        for topic in self.topics.values():
            if len(topic) > _BLOCK_ROWS:
                topic.drop_fields()

    def _cut(self, begin: float, end: float) -> Chunk:
        rows: FieldRows = {}
        for field, (t, values) in self.rows.items():
            first, stop = np.searchsorted(t, (begin, end))
            if stop > first:
                rows[field] = (t[first:stop], values[first:stop])
        counts = {
            name: int(np.subtract(*np.searchsorted(topic.t, (end, begin)))) for name, topic in self.topics.items()
        }
        events = [event for event in self.events if begin <= event.t < end]
        return Chunk(rows, events, {name: n for name, n in counts.items() if n})

    def _best_source(self, sources: tuple[FieldSource, ...]) -> tuple[FieldSource, np.ndarray, np.ndarray] | None:
        """Return the active source of highest rank, else the one with the most rows."""
        longest: tuple[FieldSource, np.ndarray, np.ndarray] | None = None
        for row in sources:
            if row.message not in self.topics:
                continue
            extracted = extract_rows(row, self.topics[row.message])
            if extracted is None:
                continue
            t, values, rejected = extracted
            if len(t) and rejected > len(t):
                self.skipped.append(f"{rejected} rows of {row.message} for {row.field} not finite or out of range")
            if len(t) and _is_frequent(t, MIN_RATE_HZ.get(row.field, 0.0)):
                return row, t, values
            if len(t) and (longest is None or len(t) > len(longest[1])):
                longest = row, t, values
        return longest


def extract_rows(row: FieldSource, topic: Topic) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Return times, values and number of rejected rows; None if the log lacks a field of the row.

    Rows are independent, so a long topic is processed in blocks to limit memory.
    """
    blocks = []
    for begin in range(0, max(len(topic), 1), _BLOCK_ROWS):
        extracted = _extract_block(row, topic.rows_between(begin, begin + _BLOCK_ROWS))
        if extracted is None:
            return None
        blocks.append(extracted)
    t, values, rejected = zip(*blocks, strict=True)
    return np.concatenate(t), np.concatenate(values), sum(rejected)


def _extract_block(row: FieldSource, topic: Topic) -> tuple[np.ndarray, np.ndarray, int] | None:
    with np.errstate(all="ignore"):
        try:
            applicable = np.ones(len(topic), bool) if row.when is None else np.asarray(row.when(topic), bool)
            columns: tuple[Any, ...] = row.columns(topic)
        except (AttributeError, IndexError):
            return None
        if len(columns) not in ROW_WIDTHS[row.field]:
            return None
        values = np.stack(columns, axis=-1)
        valid = applicable & is_plausible(row.field, values)
    return topic.t[valid], values[valid], int(np.sum(applicable & ~valid))


def _is_frequent(t: np.ndarray, min_hz: float) -> bool:
    return min_hz == 0.0 or (len(t) > 1 and 1.0 / float(np.median(np.diff(t))) >= min_hz)
