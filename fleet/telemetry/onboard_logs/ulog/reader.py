"""Reader of PX4 logs (ULog, .ulg) as `OnboardLog`: pyulog reads filtered bytes, the table maps the topics."""

from collections.abc import Callable
from math import isfinite
from typing import IO, Any

import numpy as np
from pyulog import ULog

from fleet.telemetry.mavlink.onboard_log import OnboardEvent
from fleet.telemetry.onboard_logs.px4_missions import read_missions
from fleet.telemetry.onboard_logs.topic import Topic, time_order
from fleet.telemetry.onboard_logs.topic_log import TopicLog
from fleet.telemetry.onboard_logs.ulog.messages import (
    firmware_text,
    gps_epoch,
    release,
    system_id,
    topic_events,
    vehicle_kind,
)
from fleet.telemetry.onboard_logs.ulog.sieve import MAX_JUMP_US, MAX_STAMP_US, UlogFilter
from fleet.telemetry.tables.ulog import CALCULATED, LATCHED_TOPICS, ROWS, TOPICS

MAX_EARLY_S = 1.0  # maximum age of a row before the log start [s]
_MAX_EVENTS = 10_000  # maximum texts and parameter changes per log


class UlogLog(TopicLog):
    """Opened PX4 log of one aircraft; see `onboard_log.OnboardLog`."""

    def __init__(self, opener: Callable[[], IO[bytes]], name: str) -> None:
        """Read the log; problems are listed in `skipped`.

        Args:
            opener: opens the decompressed bytes at the start
            name: file name for messages
        """
        super().__init__(name)
        self.autopilot = "px4"
        log, start_us = _open_ulog(opener, self.skipped)
        start_us = _plausible_start(log, start_us, self.skipped)
        self.params = {k: float(v) for k, v in log.initial_parameters.items() if _is_number(v)}
        self.topics = self._sorted_topics(log, start_us)
        self._start_t = (
            max(start_us * 1e-6, 0.0) if start_us else min((t.t[0] for t in self.topics.values()), default=0.0)
        )
        self.build_rows(ROWS, CALCULATED)
        self.system = system_id(self.params, self.topics)
        self.vehicle = vehicle_kind(self.params, self.topics)
        self.firmware = firmware_text(log.msg_info_dict)
        self.epoch_s = gps_epoch(self.topics)
        self.events = self._collect_events(log)
        self._add_missions()
        self.drop_long_topics()
        if not self.topics:
            self.skipped.append("found no known topic, expected a PX4 log; check the file")

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

    def _add_missions(self) -> None:
        record = read_missions(self.topics, self.rows.get("leg"))
        self.events = sorted([*self.events, *record.events], key=lambda event: event.t)
        self.skipped += record.notes
        if record.leg is not None:
            self.rows["leg"] = record.leg

    def _collect_events(self, log: ULog) -> list[OnboardEvent]:
        last_t = max((t.t[-1] for t in self.topics.values()), default=self._start_t)
        events = [OnboardEvent(self._start_t, "param", (name, value)) for name, value in self.params.items()]
        events += topic_events(self.topics, release(log.msg_info_dict))
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
