"""Reader of PX4 logs (ULog, .ulg) as `OnboardLog`: pyulog reads filtered bytes, the table maps the topics."""

from collections.abc import Callable, Iterator
from math import isfinite
from typing import IO, Any

import numpy as np
from pyulog import ULog

from fleet.contract import COLUMNS
from fleet.telemetry.mavlink.onboard_log import Chunk, FieldRows, OnboardEvent
from fleet.telemetry.onboard_logs.ulog.messages import (
    firmware_text,
    gps_epoch,
    release,
    system_id,
    topic_events,
    vehicle_kind,
)
from fleet.telemetry.onboard_logs.ulog.sieve import MAX_JUMP_US, MAX_STAMP_US, UlogFilter
from fleet.telemetry.onboard_logs.ulog.topic import Topic, time_order
from fleet.telemetry.tables.row import FieldSource, is_plausible
from fleet.telemetry.tables.ulog import CALCULATED, FIELDS, LATCHED_TOPICS, MIN_RATE_HZ, ROWS, TOPICS

CHUNK_S = 30.0
_BLOCK_ROWS = 1 << 17  # rows processed at once
MAX_EARLY_S = 1.0  # maximum age of a row before the log start [s]
_MAX_EVENTS = 10_000  # maximum texts and parameter changes per log


class UlogLog:
    """Opened PX4 log of one aircraft; see `onboard_log.OnboardLog`."""

    def __init__(self, opener: Callable[[], IO[bytes]], name: str) -> None:
        """Read the log; problems are listed in `skipped`.

        Args:
            opener: opens the decompressed bytes at the start
            name: file name for messages
        """
        self.name, self.autopilot = name, "px4"
        self.skipped: list[str] = []
        log, start_us = _open_ulog(opener, self.skipped)
        start_us = _plausible_start(log, start_us, self.skipped)
        self.params = {k: float(v) for k, v in log.initial_parameters.items() if _is_number(v)}
        self._topics = self._sorted_topics(log, start_us)
        self._start_t = (
            max(start_us * 1e-6, 0.0) if start_us else min((t.t[0] for t in self._topics.values()), default=0.0)
        )
        self._rows = self._build_rows()
        self.system = system_id(self.params, self._topics)
        self.vehicle = vehicle_kind(self.params, self._topics)
        self.firmware = firmware_text(log.msg_info_dict)
        self.epoch_s = gps_epoch(self._topics)
        self._events = self._collect_events(log)
        for topic in self._topics.values():
            if len(topic) > _BLOCK_ROWS:
                topic.drop_fields()
        if not self._topics:
            self.skipped.append("found no known topic, expected a PX4 log; check the file")

    def chunks(self) -> Iterator[Chunk]:
        """Return the log in chunks of 30 s from the start; may be called repeatedly."""
        times = [t.t for t in self._topics.values()]
        if not times and not self._events:
            return
        first = min([t[0] for t in times] + [self._events[0].t] if self._events else [t[0] for t in times])
        last = max([t[-1] for t in times] + [self._events[-1].t] if self._events else [t[-1] for t in times])
        all_times = [*times, np.array([event.t for event in self._events]), np.array([last])]
        for number in np.unique(np.concatenate([(t - first) // CHUNK_S for t in all_times])):  # no chunks without data
            chunk = self._cut(first + number * CHUNK_S, first + (number + 1) * CHUNK_S)
            if chunk.rows or chunk.events or chunk.counts:
                yield chunk

    def _cut(self, begin: float, end: float) -> Chunk:
        rows: FieldRows = {}
        for field, (t, values) in self._rows.items():
            first, stop = np.searchsorted(t, (begin, end))
            if stop > first:
                rows[field] = (t[first:stop], values[first:stop])
        counts = {
            name: int(np.subtract(*np.searchsorted(topic.t, (end, begin)))) for name, topic in self._topics.items()
        }
        events = [event for event in self._events if begin <= event.t < end]
        return Chunk(rows, events, {name: n for name, n in counts.items() if n})

    def _sorted_topics(self, log: ULog, start_us: int) -> dict[str, Topic]:
        """Return the topics by name, the second instance as `name.1`, rows in time order."""
        topics: dict[str, Topic] = {}
        early = 0
        while log.data_list:  # free the copied data
            data = log.data_list.pop(0)
            stamp = data.data["timestamp"].astype(np.int64)
            order = time_order(stamp)
            disordered = len(stamp) - len(order)
            if disordered:
                self.skipped.append(f"{disordered} rows of {data.name} with a stamp out of order were skipped")
            stamp = stamp[order]
            too_early = int(np.searchsorted(stamp, start_us - MAX_EARLY_S * 1e6))
            if too_early and too_early == len(stamp) and data.name in LATCHED_TOPICS:
                too_early, stamp = too_early - 1, np.maximum(stamp, start_us)  # still valid at the log start
            early += too_early
            if too_early < len(stamp):
                selected = order[too_early:]
                fields = {field: values[selected] for field, values in data.data.items()}
                name = data.name if data.multi_id == 0 else f"{data.name}.{data.multi_id}"
                topics[name] = Topic(stamp[too_early:] * 1e-6, fields, topics)
        if early:
            self.skipped.append(
                f"{early} rows stamped more than {MAX_EARLY_S:.0f} s before the log's start were skipped"
            )
        return topics

    # --- rows ---

    def _build_rows(self) -> FieldRows:
        table: FieldRows = {}
        for field in FIELDS:
            best = self._best_source(field)
            if best is None:
                continue
            row, t, values = best
            table[field] = (t, values)
            if row.message in CALCULATED:
                self.skipped.append(CALCULATED[row.message])
        return table

    def _best_source(self, field: str) -> tuple[FieldSource, np.ndarray, np.ndarray] | None:
        """Return the active source of highest rank, else the one with the most rows."""
        longest: tuple[FieldSource, np.ndarray, np.ndarray] | None = None
        for row in ROWS[field]:
            if row.message not in self._topics:
                continue
            extracted = _extract_rows(row, self._topics[row.message])
            if extracted is None:
                continue
            t, values, rejected = extracted
            if len(t) and rejected > len(t):
                self.skipped.append(f"{rejected} rows of {row.message} for {field} not finite or out of range")
            if len(t) and _is_frequent(t, MIN_RATE_HZ.get(field, 0.0)):
                return row, t, values
            if len(t) and (longest is None or len(t) > len(longest[1])):
                longest = row, t, values
        return longest

    def _collect_events(self, log: ULog) -> list[OnboardEvent]:
        last_t = max((t.t[-1] for t in self._topics.values()), default=self._start_t)
        events = [OnboardEvent(self._start_t, "param", (name, value)) for name, value in self.params.items()]
        events += topic_events(self._topics, release(log.msg_info_dict))
        changed = [
            OnboardEvent(time_us * 1e-6, "param", (k, float(v)))
            for time_us, k, v in log.changed_parameters
            if _is_number(v)
        ]
        tagged = [message for messages in log.logged_messages_tagged.values() for message in messages]
        texts = [
            OnboardEvent(m.timestamp * 1e-6, "text", (m.log_level - ord("0"), m.message.strip()))
            for m in (*log.logged_messages, *tagged)
        ]
        in_range = [event for event in (*changed, *texts) if self._start_t - 60 <= event.t <= last_t + 60]
        omitted = len(changed) + len(texts) - len(in_range[:_MAX_EVENTS])
        if omitted:
            self.skipped.append(
                f"{omitted} texts or parameter changes with a bad stamp or beyond the limit were skipped"
            )
        dropouts = [dropout.duration for dropout in log.dropouts]
        if dropouts:
            self.skipped.append(f"the logger lost {sum(dropouts) * 1e-3:.2f} s in {len(dropouts)} dropouts")
        return sorted(events + in_range[:_MAX_EVENTS], key=lambda s: s.t)


def _open_ulog(opener: Callable[[], IO[bytes]], skipped: list[str]) -> tuple[ULog, int]:
    try:
        filtered = UlogFilter(opener, TOPICS, skipped)
        log = ULog(filtered, sorted(TOPICS))
        if filtered.messages == 0:
            skipped.append("found no ULog message, expected a PX4 log; check the file")
        return log, filtered.start_us
    except Exception as error:  # filtered bytes should not raise; a reader must never raise
        skipped.append(f"could not be read ({type(error).__name__}: {error}); check the file")
        return ULog(None), 0


def _plausible_start(log: ULog, start_us: int, skipped: list[str]) -> int:
    """Return the log start [us]: the header stamp, or the first row if the header is inconsistent."""
    stamps = np.concatenate([data.data["timestamp"].astype(np.int64) for data in log.data_list] or [np.zeros(0, int)])
    if len(stamps) == 0:
        return start_us if start_us < MAX_STAMP_US else 0
    early, first = float(np.mean(stamps < start_us - MAX_EARLY_S * 1e6)), int(np.quantile(stamps, 0.01))
    if early < 0.05 and first - start_us < MAX_JUMP_US:
        return start_us
    skipped.append(f"start {start_us * 1e-6:.1f} s in its header contradicts its rows; the first row is used")
    return int(stamps.min())


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and isfinite(value)


def _extract_rows(row: FieldSource, topic: Topic) -> tuple[np.ndarray, np.ndarray, int] | None:
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
            columns = row.columns(topic)
        except (AttributeError, IndexError):
            return None
        if len(columns) != len(COLUMNS[row.field]):
            return None
        values = np.stack(columns, axis=-1)
        valid = applicable & is_plausible(row.field, values)
    return topic.t[valid], values[valid], int(np.sum(applicable & ~valid))


def _is_frequent(t: np.ndarray, min_hz: float) -> bool:
    return min_hz == 0.0 or (len(t) > 1 and 1.0 / float(np.median(np.diff(t))) >= min_hz)
