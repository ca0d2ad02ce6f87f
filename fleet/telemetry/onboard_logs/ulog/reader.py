"""Reader of PX4 logs (ULog, .ulg) as `OnboardLog`: pyulog reads filtered bytes, the table maps the topics."""

from collections.abc import Callable, Iterator
from math import isfinite
from typing import IO, Any

import numpy as np
from pyulog import ULog

from fleet.contract import COLUMNS
from fleet.telemetry.mavlink.onboard_log import Chunk, Said, Table
from fleet.telemetry.onboard_logs.ulog.messages import epoch, firmware, release, said_by_topics, system, vehicle
from fleet.telemetry.onboard_logs.ulog.sieve import JUMP_US, LATEST_US, Sieve
from fleet.telemetry.onboard_logs.ulog.topic import Topic, in_order
from fleet.telemetry.tables.row import Row, believable
from fleet.telemetry.tables.ulog import CALCULATED, FIELDS, FLOWS_HZ, HELD, ROWS, TOPICS

CHUNK_S = 30.0
_BLOCK = 1 << 17  # rows processed at once
EARLY_S = 1.0  # maximum age of a row before the log start [s]
_MOST_WORDS = 10_000  # maximum texts and parameter changes per log


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
        log, start_us = _read(opener, self.skipped)
        start_us = _believed_start(log, start_us, self.skipped)
        self.params = {k: float(v) for k, v in log.initial_parameters.items() if _is_number(v)}
        self._topics = self._sorted(log, start_us)
        self._t0 = max(start_us * 1e-6, 0.0) if start_us else min((t.t[0] for t in self._topics.values()), default=0.0)
        self._rows = self._fill()
        self.system = system(self.params, self._topics)
        self.vehicle = vehicle(self.params, self._topics)
        self.firmware = firmware(log.msg_info_dict)
        self.epoch_s = epoch(self._topics)
        self._said = self._collect(log)
        for topic in self._topics.values():
            if len(topic) > _BLOCK:
                topic.strip()
        if not self._topics:
            self.skipped.append("found no known topic, expected a PX4 log; check the file")

    def chunks(self) -> Iterator[Chunk]:
        """Return the log in chunks of 30 s from the start; may be called repeatedly."""
        times = [t.t for t in self._topics.values()]
        if not times and not self._said:
            return
        first = min([t[0] for t in times] + [self._said[0].t] if self._said else [t[0] for t in times])
        last = max([t[-1] for t in times] + [self._said[-1].t] if self._said else [t[-1] for t in times])
        told = [*times, np.array([s.t for s in self._said]), np.array([last])]
        for number in np.unique(np.concatenate([(t - first) // CHUNK_S for t in told])):  # no chunks without data
            chunk = self._cut(first + number * CHUNK_S, first + (number + 1) * CHUNK_S)
            if chunk.rows or chunk.said or chunk.counts:
                yield chunk

    def _cut(self, begin: float, end: float) -> Chunk:
        rows: Table = {}
        for field, (t, values) in self._rows.items():
            a, b = np.searchsorted(t, (begin, end))
            if b > a:
                rows[field] = (t[a:b], values[a:b])
        counts = {name: int(np.subtract(*np.searchsorted(x.t, (end, begin)))) for name, x in self._topics.items()}
        said = [s for s in self._said if begin <= s.t < end]
        return Chunk(rows, said, {name: n for name, n in counts.items() if n})

    def _sorted(self, log: ULog, start_us: int) -> dict[str, Topic]:
        """Return the topics by name, the second instance as `name.1`, rows in time order."""
        topics: dict[str, Topic] = {}
        early = 0
        while log.data_list:  # free the copied data
            data = log.data_list.pop(0)
            stamp = data.data["timestamp"].astype(np.int64)
            order = in_order(stamp)
            strays = len(stamp) - len(order)
            if strays:
                self.skipped.append(f"{strays} rows of {data.name} with a stamp out of order were skipped")
            stamp = stamp[order]
            before = int(np.searchsorted(stamp, start_us - EARLY_S * 1e6))
            if before and before == len(stamp) and data.name in HELD:
                before, stamp = before - 1, np.maximum(stamp, start_us)  # still valid at the log start
            early += before
            if before < len(stamp):
                kept = order[before:]
                fields = {field: values[kept] for field, values in data.data.items()}
                name = data.name if data.multi_id == 0 else f"{data.name}.{data.multi_id}"
                topics[name] = Topic(stamp[before:] * 1e-6, fields, topics)
        if early:
            self.skipped.append(f"{early} rows stamped more than {EARLY_S:.0f} s before the log's start were skipped")
        return topics

    # --- rows ---

    def _fill(self) -> Table:
        table: Table = {}
        for field in FIELDS:
            found = self._best(field)
            if found is None:
                continue
            row, t, values = found
            table[field] = (t, values)
            if row.message in CALCULATED:
                self.skipped.append(CALCULATED[row.message])
        return table

    def _best(self, field: str) -> tuple[Row, np.ndarray, np.ndarray] | None:
        """Return the active source of highest rank, else the one with the most rows."""
        most: tuple[Row, np.ndarray, np.ndarray] | None = None
        for row in ROWS[field]:
            if row.message not in self._topics:
                continue
            laid = _lay(row, self._topics[row.message])
            if laid is None:
                continue
            t, values, refused = laid
            if len(t) and refused > len(t):
                self.skipped.append(f"{refused} rows of {row.message} for {field} not finite or out of range")
            if len(t) and _flows(t, FLOWS_HZ.get(field, 0.0)):
                return row, t, values
            if len(t) and (most is None or len(t) > len(most[1])):
                most = row, t, values
        return most

    def _collect(self, log: ULog) -> list[Said]:
        last = max((t.t[-1] for t in self._topics.values()), default=self._t0)
        said = [Said(self._t0, "param", (name, value)) for name, value in self.params.items()]
        said += said_by_topics(self._topics, release(log.msg_info_dict))
        changed = [Said(us * 1e-6, "param", (k, float(v))) for us, k, v in log.changed_parameters if _is_number(v)]
        tagged = [m for messages in log.logged_messages_tagged.values() for m in messages]
        texts = [
            Said(m.timestamp * 1e-6, "text", (m.log_level - ord("0"), m.message.strip()))
            for m in (*log.logged_messages, *tagged)
        ]
        words = [s for s in (*changed, *texts) if self._t0 - 60 <= s.t <= last + 60]
        lost = len(changed) + len(texts) - len(words[:_MOST_WORDS])
        if lost:
            self.skipped.append(f"{lost} texts or parameter changes with a bad stamp or beyond the limit were skipped")
        lapses = [d.duration for d in log.dropouts]
        if lapses:
            self.skipped.append(f"the logger lost {sum(lapses) * 1e-3:.2f} s in {len(lapses)} dropouts")
        return sorted(said + words[:_MOST_WORDS], key=lambda s: s.t)


def _read(opener: Callable[[], IO[bytes]], skipped: list[str]) -> tuple[ULog, int]:
    try:
        sieve = Sieve(opener, TOPICS, skipped)
        log = ULog(sieve, sorted(TOPICS))
        if sieve.messages == 0:
            skipped.append("found no ULog message, expected a PX4 log; check the file")
        return log, sieve.start_us
    except Exception as error:  # filtered bytes should not raise; a reader must never raise
        skipped.append(f"could not be read ({type(error).__name__}: {error}); check the file")
        return ULog(None), 0


def _believed_start(log: ULog, start_us: int, skipped: list[str]) -> int:
    """Return the log start [us]: the header stamp, or the first row if the header is inconsistent."""
    stamps = np.concatenate([data.data["timestamp"].astype(np.int64) for data in log.data_list] or [np.zeros(0, int)])
    if len(stamps) == 0:
        return start_us if start_us < LATEST_US else 0
    early, first = float(np.mean(stamps < start_us - EARLY_S * 1e6)), int(np.quantile(stamps, 0.01))
    if early < 0.05 and first - start_us < JUMP_US:
        return start_us
    skipped.append(f"start {start_us * 1e-6:.1f} s in its header contradicts its rows; the first row is used")
    return int(stamps.min())


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and isfinite(value)


def _lay(row: Row, topic: Topic) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Return times, values and number of rejected rows; None if the log lacks a field of the row.

    Rows are independent, so a long topic is processed in blocks to limit memory.
    """
    blocks = []
    for begin in range(0, max(len(topic), 1), _BLOCK):
        laid = _lay_block(row, topic.part(begin, begin + _BLOCK))
        if laid is None:
            return None
        blocks.append(laid)
    t, values, refused = zip(*blocks, strict=True)
    return np.concatenate(t), np.concatenate(values), sum(refused)


def _lay_block(row: Row, topic: Topic) -> tuple[np.ndarray, np.ndarray, int] | None:
    with np.errstate(all="ignore"):
        try:
            meant = np.ones(len(topic), bool) if row.when is None else np.asarray(row.when(topic), bool)
            columns = row.columns(topic)
        except (AttributeError, IndexError):
            return None
        if len(columns) != len(COLUMNS[row.field]):
            return None
        values = np.stack(columns, axis=-1)
        good = meant & believable(row.field, values)
    return topic.t[good], values[good], int(np.sum(meant & ~good))


def _flows(t: np.ndarray, least_hz: float) -> bool:
    return least_hz == 0.0 or (len(t) > 1 and 1.0 / float(np.median(np.diff(t))) >= least_hz)
