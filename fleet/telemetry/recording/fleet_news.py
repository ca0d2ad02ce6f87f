"""Read a bus recording: messages of the gateway, optionally of the workers, in order of reception."""

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from msgspec.structs import replace

from fleet.bus.codec import Stamp, decode, encoding, is_plausible_epoch
from fleet.contract import (
    COLUMNS,
    FIRST_OPTIONAL_COLUMN,
    MAX_ITEMS,
    ROW_WIDTHS,
    TOPICS,
    Alert,
    FleetState,
    Message,
    Mismatch,
    Mission,
    Model,
    Params,
    Prediction,
    Rows,
    Sample,
    Status,
)
from fleet.telemetry.mavlink.steps import STEP_S
from fleet.telemetry.recording.fleet_log import MAX_UNRECOGNISED, BusRecord, SearchBudget, find_records
from fleet.telemetry.recording.opening import RecordingFile

TELEMETRY_TYPES = (Sample, Status, Mission, Params)
RESULT_TYPES = (Model, Prediction, Mismatch, Alert, FleetState)
CHUNK = 1 << 20
SEARCH_FACTOR = 8  # search budget [bytes summed]: this times the bytes read, plus `MAX_UNRECOGNISED`
MAX_UAV = 999_999
_MAX_PAUSE_S = 86_400.0  # a longer pause separates two recordings in one file [s]
_MAX_TIME_S = 4e9  # latest plausible fleet time [s since 1970]
_TYPE_BY_ENCODING = {encoding(kind): kind for kind in TOPICS.values()}


class BusMessageReader:
    """Reader of the messages of one `.parauav` file.

    Args:
        source: the file
        offset: added to every recorded UAV id
    """

    def __init__(self, source: RecordingFile, offset: int = 0) -> None:
        self._source, self._offset = source, offset
        self._record_count = 0  # records read
        self._damaged_bytes = 0  # bytes outside valid records
        self._first_damage: int | None = None  # position of the first of them
        self._search_aborted = False  # reading ended: too many invalid record headers
        self._rejected: Counter[str] = Counter()
        self._places: dict[str, int] = {}  # position of the first message rejected, by reason
        self._highest_stamps: dict[int, Stamp] = {}  # highest stamp so far, by UAV id

    @property
    def skipped(self) -> list[str]:
        """Return messages on unreadable parts and their positions."""
        problems = []
        if self._search_aborted:
            problems.append("too many invalid record headers, the rest was not read; split it")
        if self._damaged_bytes:
            details = f"the first near byte {self._first_damage}, {self._record_count} messages read"
            problems.append(f"{self._damaged_bytes} damaged bytes skipped, {details}")
        for reason, count in self._rejected.items():
            problems.append(f"{count} messages rejected, {reason}, the first near byte {self._places[reason]}")
        return problems

    def steps(self, results: bool = False) -> Iterator[tuple[float, list[Any]]]:
        """Return messages in steps of 0.1 s of reception time: (end of the step [s since 1970], messages).

        Args:
            results: include worker messages: models, predictions, mismatches, alerts, fleet tables
        """
        first, stream_t, left_out, step = math.nan, 0.0, 0.0, 0
        messages: list[Any] = []
        for place, record in self._records():
            message = self._message(place, record, results)
            if message is None:
                continue
            if math.isnan(first):
                first = stream_t = record.received_t
            elapsed = record.received_t - left_out - stream_t
            left_out += elapsed if elapsed > _MAX_PAUSE_S else 0.0
            stream_t = max(stream_t, record.received_t - left_out)
            number = int((stream_t - first) / STEP_S)
            if number > step:
                yield first + (step + 1) * STEP_S, messages
                messages, step = [], number
            messages.append(message)
        if messages:
            yield first + (step + 1) * STEP_S, messages

    def _records(self) -> Iterator[tuple[int, BusRecord]]:
        """Return the valid records: (file offset [bytes], record)."""
        rest, place, budget = b"", 0, SearchBudget(MAX_UNRECOGNISED)
        with self._source.open() as stream:
            while True:
                chunk = stream.read(CHUNK) or b""
                data, position = rest + chunk, 0
                budget.remaining += SEARCH_FACTOR * len(chunk)
                for start, stop in find_records(data, not chunk, budget):
                    if start > position and self._first_damage is None:
                        self._first_damage = place + position
                    self._damaged_bytes += start - position
                    position = stop
                    if start < stop:
                        self._record_count += 1
                        yield place + start, BusRecord.unpack(data[start:stop])
                rest, place = data[position:], place + position
                self._search_aborted = budget.remaining < 0
                if not chunk or self._search_aborted or (not self._record_count and place > MAX_UNRECOGNISED):
                    return

    def _message(self, place: int, record: BusRecord, results: bool) -> Any | None:
        """Decode a record; None if it is not wanted or rejected."""
        kind = _TYPE_BY_ENCODING.get(record.encoding)
        if kind is not None and kind not in TELEMETRY_TYPES and not (results and kind in RESULT_TYPES):
            return None
        try:
            message = self._read(kind, record)
        except ValueError as error:
            reason = str(error) if str(error) in self._rejected or len(self._rejected) < 20 else "for other reasons"
            self._rejected[reason] += 1
            self._places.setdefault(reason, place)
            return None
        return message if kind in TELEMETRY_TYPES or self._is_owner(message, record) else None

    def _read(self, kind: type | None, record: BusRecord) -> Any:
        if kind is None:
            raise ValueError(f"of a class or version unknown here ({record.encoding[:80]!r})")
        if not 0 < record.received_t < _MAX_TIME_S:
            raise ValueError("with an invalid reception time")
        message: Any = decode(kind, record.payload, record.encoding)
        _validate(message)
        if self._offset and (message := renumbered(message, lambda uav: uav + self._offset)) is None:
            raise ValueError(f"{kind.__name__} of an id out of range")
        return message

    def _is_owner(self, message: Any, record: BusRecord) -> bool:
        """Return whether the writer owned the aircraft: only the highest fencing token is valid."""
        uav = getattr(message, "uav", None)
        if uav is None or record.stamp is None:
            return True
        if not is_plausible_epoch(record.stamp.epoch, record.received_t):
            return False
        highest = self._highest_stamps[uav] = max(self._highest_stamps.get(uav, record.stamp), record.stamp)
        return record.stamp == highest


def renumbered(message: Any, new_id: Any) -> Any | None:
    """Renumber a message, its sentences included; None if the new id is invalid.

    Args:
        message: contract message
        new_id: returns the new id of a recorded id
    """
    if isinstance(message, FleetState):
        ids = [(row, new_id(row.uav)) for row in message.rows]
        renumbered_rows = [(row, uav, _renumber_text(row.verdict, row.uav, uav)) for row, uav in ids if uav >= 0]
        rows = [replace(row, uav=uav, verdict=verdict) for row, uav, verdict in renumbered_rows]
        return replace(message, rows=tuple(rows))
    uav = new_id(message.uav)
    return with_uav(message, uav) if 0 <= uav <= MAX_UAV else None


def with_uav(message: Any, uav: int, **changes: Any) -> Any:
    """Replace the UAV id of a message, its sentences included, and the given fields."""
    if getattr(message, "sentence", ""):
        changes["sentence"] = _renumber_text(message.sentence, message.uav, uav)
    for name in ("verdict", "active_verdict") if isinstance(message, Model) else ():
        if (verdict := getattr(message, name)) is not None:
            changes[name] = replace(verdict, sentence=_renumber_text(verdict.sentence, message.uav, uav))
    return replace(message, uav=uav, **changes)


def _renumber_text(text: str, old_uav: int, uav: int) -> str:
    return text.replace(f"uav-{old_uav}:", f"uav-{uav}:")


def _validate(message: Any) -> None:
    """Validate a message against the contract.

    Raises:
        ValueError: if it violates the contract; the message has the reason.
    """
    kind = type(message).__name__
    if not 0 <= message.t <= _MAX_TIME_S:
        raise ValueError(f"{kind} at an invalid time")
    if not isinstance(message, Message):
        return
    if not 0 <= message.uav <= MAX_UAV:
        raise ValueError(f"{kind} of an id out of range")
    if isinstance(message, Sample):
        for field in COLUMNS:
            rows: Rows | None = getattr(message, field)
            if rows is not None and not _rows_valid(rows, ROW_WIDTHS[field], FIRST_OPTIONAL_COLUMN.get(field)):
                raise ValueError(f"Sample with invalid rows of {field}")
    if isinstance(message, Mission):
        numbers = [n for item in message.items for n in (item.param1, item.param2, item.param3, item.alt_m)]
        if len(message.items) > MAX_ITEMS or not all(map(math.isfinite, numbers)):
            raise ValueError("Mission with invalid items")
    if isinstance(message, Params) and not all(map(math.isfinite, message.values.values())):
        raise ValueError("Params with a non-finite value")


def _rows_valid(rows: Rows, widths: tuple[int, ...], optional: int | None) -> bool:
    """Return whether shapes, times and values are valid; columns from `optional` on may be nan: not reported."""
    t, x = rows.t.numpy(), rows.x.numpy()
    if t.ndim != 1 or x.ndim != 2 or len(x) != len(t) or x.shape[1] not in widths or not len(t):
        return False
    finite = np.isfinite(x)
    if optional is not None:
        finite[:, optional:] |= np.isnan(x[:, optional:])
    return bool(finite.all() and (t > 0).all() and (t < _MAX_TIME_S).all())
