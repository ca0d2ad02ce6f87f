"""Reader of ROS 2 bags as `OnboardLog`: topics of MAVROS and of PX4's px4_msgs by their tables.

mcap-ros2-support decodes the messages by the definitions in the bag. px4_msgs are PX4's own topics, so the ULog table
applies to them.
"""

import re
from array import array
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from fleet import vehicles
from fleet.telemetry.onboard_logs.px4_missions import read_missions
from fleet.telemetry.onboard_logs.ros2.bag_messages import BagMessage, Opener, mcap_messages, sqlite_messages
from fleet.telemetry.onboard_logs.ros2.mavros_events import MavrosEvents
from fleet.telemetry.onboard_logs.topic import Topic, time_order
from fleet.telemetry.onboard_logs.topic_log import TopicLog
from fleet.telemetry.onboard_logs.ulog.messages import gps_epoch, system_id, topic_events, vehicle_kind
from fleet.telemetry.tables import mavros
from fleet.telemetry.tables import ulog as px4

MAX_VALUES = 12_000_000  # maximum numbers of a bag: 96 MB
_MAX_FIELDS = 200  # maximum numbers of a message
_MAX_ELEMENTS = 32  # elements of an array that are read
_MAX_DEPTH = 4
_MIN_DATE_S = 1e9  # earlier log times are not dates [s since 1970]
_MAX_STAMP_ERROR_S = 60.0  # a header stamp further from the log time is of another clock [s]
_MIN_FLYING_AIRSPEED = 8.0  # [m/s]
_SYSTEM = re.compile(r"/uas(\d{1,3})/")
_PX4_TOPIC = re.compile(r".*/fmu/out/(\w+?)(?:_v\d+)?$")
_MAVROS_TOPIC = re.compile(r".*?/?(?:mavros|uas\d{1,3})/(?:mavros/)?(.+)$")


class _Columns:
    """Numbers of one topic by field, and its times."""

    def __init__(self) -> None:
        self.log_t, self.stamp = array("d"), array("d")
        self.fields: dict[str, array] = {}

    def add(self, log_s: float, stamp: float, values: dict[str, float]) -> None:
        n = len(self.log_t)
        for name, value in values.items():
            column = self.fields.get(name)
            if column is None:
                column = self.fields[name] = array("d", [np.nan]) * n
            column.append(value)
        self.log_t.append(log_s)
        self.stamp.append(stamp)
        for column in self.fields.values():
            if len(column) == n:
                column.append(np.nan)


class _BagLog(TopicLog):
    """Opened bag of one aircraft; see `onboard_log.OnboardLog`."""

    messages: Callable[[Opener, list[str]], Iterator[BagMessage]]

    def __init__(self, opener: Opener, name: str) -> None:
        """Read the bag; problems are listed in `skipped`.

        Args:
            opener: opens the decompressed bytes at the start
            name: file name for messages
        """
        super().__init__(name)
        self._decoders: dict[tuple[str, str], Callable[[bytes], Any] | None] = {}
        self._mavros = MavrosEvents()
        self._values = self._failed = 0
        columns: dict[tuple[str, str], _Columns] = {}
        topics_seen: set[str] = set()
        for message in type(self).messages(opener, self.skipped):
            topics_seen.add(message.topic)
            key = _known_topic(message.topic)
            if key is None or (decoded := self._decode(message)) is None:
                continue
            if self._values > MAX_VALUES:
                self.skipped.append(f"over {MAX_VALUES:,} numbers, the rest was not read; split it")
                break
            self._add(columns, key, message, decoded)
        self._finish(columns, topics_seen)

    def _decode(self, message: BagMessage) -> Any | None:
        kind = message.type, message.definition
        if kind not in self._decoders:
            self._decoders[kind] = _decoder(message.type, message.definition)
            if self._decoders[kind] is None:
                self.skipped.append(f"the definition of {message.type[:60]} is invalid; its messages were skipped")
        decode = self._decoders[kind]
        try:
            return decode(message.data) if decode is not None else None
        except Exception:  # a definition that contradicts the data may raise anything; the message is skipped
            self._failed += 1
            return None

    def _add(self, columns: dict[Any, _Columns], key: tuple[str, str], message: BagMessage, decoded: Any) -> None:
        source, name = key
        if source == "mavros" and name in mavros.EVENT_TOPICS:
            self._mavros.add(name, message.log_s, decoded)
        if name not in (px4.TOPICS if source == "px4" else mavros.TOPICS):
            return
        values = dict[str, float]()
        _flatten(decoded, "", values, 0)
        stamp = values.get("timestamp", np.nan) * 1e-6 if source == "px4" else _header_stamp(values)
        columns.setdefault(key, _Columns()).add(message.log_s, stamp, values)
        self._values += len(values)

    def _finish(self, columns: dict[tuple[str, str], _Columns], seen: set[str]) -> None:
        source = "px4" if any(source == "px4" for source, _ in columns) else "mavros"
        if self._failed:
            self.skipped.append(f"{self._failed} messages that contradict their definition were skipped")
        if not columns:
            listed = ", ".join(sorted(seen)[:4])[:160] or "none"
            self.skipped.append(f"found topics {listed}, expected those of MAVROS or /fmu/out/ of PX4; check the bag")
        offset_s = _clock_offset(columns) if source == "px4" else 0.0
        for (origin, name), topic in columns.items():
            if origin == source:
                self._add_topic(name, topic, offset_s, source)
        dated = any(topic.t[0] > _MIN_DATE_S for topic in self.topics.values() if len(topic))
        self.epoch_s = 0.0 if dated else None
        if source == "px4":
            self._finish_px4()
        else:
            self._finish_mavros(seen)
        self.events.sort(key=lambda event: event.t)
        self.drop_long_topics()

    def _add_topic(self, name: str, columns: _Columns, offset_s: float, source: str) -> None:
        log_t, stamp = np.frombuffer(columns.log_t), np.frombuffer(columns.stamp) + offset_s
        near = np.abs(stamp - log_t) < _MAX_STAMP_ERROR_S
        t = np.where(near, stamp, log_t)
        order = time_order(np.rint(t * 1e6).astype(np.int64))
        if len(order):
            fields = {field: np.frombuffer(values)[order] for field, values in columns.fields.items()}
            self.topics[name] = Topic(t[order], fields, self.topics)

    def _finish_px4(self) -> None:
        self.autopilot = "px4"
        self.build_rows(px4.ROWS, px4.CALCULATED)
        self.system, self.vehicle = system_id({}, self.topics), vehicle_kind({}, self.topics)
        self.epoch_s = self.epoch_s if self.epoch_s is not None else gps_epoch(self.topics)
        record = read_missions(self.topics, self.rows.get("leg"))
        self.events = [*topic_events(self.topics, (99, 0)), *record.events]
        self.skipped += record.notes
        if record.leg is not None:
            self.rows["leg"] = record.leg

    def _finish_mavros(self, seen: set[str]) -> None:
        self.events = self._mavros.events
        self.autopilot = self._mavros.autopilot
        self.build_rows(mavros.rows_of(self.autopilot))
        systems = sorted({match[1] for topic in seen if (match := _SYSTEM.search(topic))})
        self.system = int(systems[0]) if systems and 1 <= int(systems[0]) <= 255 else 1
        if len(systems) > 1:
            self.skipped.append(f"topics of {len(systems)} aircraft in one bag, expected one; record one bag for each")
        if "air" in self.rows and np.quantile(self.rows["air"][1][:, 0], 0.9) > _MIN_FLYING_AIRSPEED:
            self.vehicle = vehicles.FIXED_WING
            self.skipped.append("the vehicle type is not in a MAVROS bag; fixed wing assumed, because of its airspeed")
        if "position" in self.rows and not self.topics.keys() & {"altitude", "vfr_hud"}:
            self.skipped.append("altitude above the ellipsoid: the bag has no topic with one above sea level")


class McapLog(_BagLog):
    """Opened MCAP file."""

    messages = staticmethod(mcap_messages)


class SqliteBagLog(_BagLog):
    """Opened SQLite bag (.db3)."""

    messages = staticmethod(sqlite_messages)


def _known_topic(topic: str) -> tuple[str, str] | None:
    """Return the table of a topic and its name there; None for any other topic."""
    if match := _PX4_TOPIC.fullmatch(topic):
        return "px4", match[1]
    match = _MAVROS_TOPIC.fullmatch(topic)
    if match and (match[1] in mavros.TOPICS or match[1] in mavros.EVENT_TOPICS):
        return "mavros", match[1]
    return None


def _decoder(kind: str, definition: str) -> Callable[[bytes], Any] | None:
    try:
        schema = Schema(id=1, data=definition.encode(), encoding="ros2msg", name=kind)
        return DecoderFactory().decoder_for("cdr", schema)
    except Exception:  # the parser of definitions raises various errors on invalid ones
        return None


def _flatten(message: Any, prefix: str, values: dict[str, float], depth: int) -> None:
    """Collect the numbers of a message: `a.b` for nested fields, `a[0]` for elements of arrays."""
    for name in getattr(message, "__slots__", ()):
        value = getattr(message, name, None)
        if len(values) >= _MAX_FIELDS:
            return
        if isinstance(value, bool | int | float):
            values[prefix + name] = float(value)
        elif isinstance(value, list | tuple | array | np.ndarray):
            for k, element in enumerate(value[:_MAX_ELEMENTS]):
                if isinstance(element, bool | int | float) and "covariance" not in name:
                    values[f"{prefix}{name}[{k}]"] = float(element)
        elif hasattr(value, "__slots__") and depth < _MAX_DEPTH:
            _flatten(value, f"{prefix}{name}.", values, depth + 1)


def _header_stamp(values: dict[str, float]) -> float:
    sec, nanosec = values.get("header.stamp.sec", np.nan), values.get("header.stamp.nanosec", 0.0)
    return sec + 1e-9 * nanosec


def _clock_offset(columns: dict[tuple[str, str], _Columns]) -> float:
    """Return log time minus PX4's time stamps [s], the median over all topics."""
    differences = [
        np.median(np.frombuffer(topic.log_t) - np.frombuffer(topic.stamp)) for topic in columns.values() if topic.log_t
    ]
    finite = np.array(differences)[np.isfinite(differences)]
    return float(np.median(finite)) if len(finite) else 0.0
