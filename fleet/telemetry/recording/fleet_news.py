"""Read a bus recording: messages of the gateway, optionally of the workers, in order of reception."""

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from fleet.bus.codec import Stamp, decode, encoding, timely
from fleet.contract import (
    COLUMNS,
    MAX_ITEMS,
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
from fleet.telemetry.recording.fleet_log import FleetLog, Record
from fleet.telemetry.recording.opening import Source

NEWS = (Sample, Status, Mission, Params)
RESULTS = (Model, Prediction, Mismatch, Alert, FleetState)
MOST_UAV = 999_999
_BREAK_S = 86_400.0  # a longer pause separates two recordings in one file [s]
_LATEST_S = 4e9  # latest plausible fleet time [s since 1970]
_KINDS = {encoding(kind): kind for kind in TOPICS.values()}


class FleetNews:
    """Reader of the messages of one `.parauav` file.

    Args:
        source: the file
        offset: added to every recorded UAV id
    """

    def __init__(self, source: Source, offset: int = 0) -> None:
        self._log = FleetLog(source)
        self._offset = offset
        self._refused: Counter[str] = Counter()
        self._places: dict[str, int] = {}  # position of the first message rejected, by reason
        self._claims: dict[int, Stamp] = {}  # highest stamp so far, by UAV id

    @property
    def skipped(self) -> list[str]:
        """Return messages on unreadable parts and their positions."""
        said = [f"{n} messages rejected, {why}, the first near byte {self._places[why]}"
                for why, n in self._refused.items()]  # fmt: skip
        if self._log.bad:
            where = f"the first near byte {self._log.first_bad}"
            said.insert(0, f"{self._log.bad} damaged bytes skipped, {where}, {self._log.read} messages read")
        if self._log.tangled:
            said.insert(0, "too many invalid record headers, the rest was not read; split it")
        return said

    def steps(self, results: bool = False) -> Iterator[tuple[float, list[Any]]]:
        """Return messages in steps of 0.1 s of reception time: (end of the step [s since 1970], messages).

        Args:
            results: include worker messages: models, predictions, mismatches, alerts, fleet tables
        """
        first, now, left_out, step = math.nan, 0.0, 0.0, 0
        held: list[Any] = []
        for place, record in self._log.records():
            message = self._message(place, record, results)
            if message is None:
                continue
            if math.isnan(first):
                first = now = record.heard
            passed = record.heard - left_out - now
            left_out += passed if passed > _BREAK_S else 0.0
            now = max(now, record.heard - left_out)
            number = int((now - first) / STEP_S)
            if number > step:
                yield first + (step + 1) * STEP_S, held
                held, step = [], number
            held.append(message)
        if held:
            yield first + (step + 1) * STEP_S, held

    def _message(self, place: int, record: Record, results: bool) -> Any | None:
        """Decode a record; None if it is not wanted or rejected."""
        kind = _KINDS.get(record.encoding)
        if kind is not None and kind not in NEWS and not (results and kind in RESULTS):
            return None
        try:
            message = self._read(kind, record)
        except ValueError as error:
            self._refuse(str(error), place)
            return None
        return message if kind in NEWS or self._in_force(message, record) else None

    def _read(self, kind: type | None, record: Record) -> Any:
        if kind is None:
            raise ValueError(f"of a class or version unknown here ({record.encoding[:80]!r})")
        if not 0 < record.heard < _LATEST_S:
            raise ValueError("with an invalid reception time")
        message: Any = decode(kind, record.payload, record.encoding)
        _check(message)
        if self._offset and (message := renumbered(message, lambda uav: uav + self._offset)) is None:
            raise ValueError(f"{kind.__name__} of an id out of range")
        return message

    def _refuse(self, why: str, place: int) -> None:
        why = why if why in self._refused or len(self._refused) < 20 else "for other reasons"
        self._refused[why] += 1
        self._places.setdefault(why, place)

    def _in_force(self, message: Any, record: Record) -> bool:
        """Return whether the writer owned the aircraft: only the highest fencing token is valid."""
        uav = getattr(message, "uav", None)
        if uav is None or record.stamp is None:
            return True
        if not timely(record.stamp.epoch, record.heard):
            return False
        highest = self._claims[uav] = max(self._claims.get(uav, record.stamp), record.stamp)
        return record.stamp == highest


def renumbered(message: Any, number: Any) -> Any | None:
    """Renumber a message, its sentences included; None if the new id is invalid.

    Args:
        message: contract message
        new_id: returns the new id of a recorded id
    """
    if isinstance(message, FleetState):
        rows = tuple(_row(row, number(row.uav)) for row in message.rows)
        return msgspec.structs.replace(message, rows=tuple(row for row in rows if row.uav >= 0))
    uav = number(message.uav)
    return named(message, uav) if 0 <= uav <= MOST_UAV else None


def named(message: Any, uav: int, **more: Any) -> Any:
    """Replace the UAV id of a message, its sentences included, and the given fields."""
    if getattr(message, "sentence", ""):
        more["sentence"] = message.sentence.replace(f"uav-{message.uav}:", f"uav-{uav}:")
    if isinstance(message, Model):
        more |= {name: _verdict(getattr(message, name), message.uav, uav) for name in ("verdict", "in_force")}
    return msgspec.structs.replace(message, uav=uav, **more)


def _verdict(verdict: Any, was: int, uav: int) -> Any:
    if verdict is None:
        return None
    return msgspec.structs.replace(verdict, sentence=verdict.sentence.replace(f"uav-{was}:", f"uav-{uav}:"))


def _row(row: Any, uav: int) -> Any:
    return msgspec.structs.replace(row, uav=uav, verdict=row.verdict.replace(f"uav-{row.uav}:", f"uav-{uav}:"))


def _check(message: Any) -> None:
    """Validate a message against the contract.

    Raises:
        ValueError: if it violates the contract; the message has the reason.
    """
    kind = type(message).__name__
    if not 0 <= message.t <= _LATEST_S:
        raise ValueError(f"{kind} at an invalid time")
    if not isinstance(message, Message):
        return
    if not 0 <= message.uav <= MOST_UAV:
        raise ValueError(f"{kind} of an id out of range")
    if isinstance(message, Sample):
        for field in COLUMNS:
            rows: Rows | None = getattr(message, field)
            if rows is not None and not _fits(rows, len(COLUMNS[field])):
                raise ValueError(f"Sample with invalid rows of {field}")
    if isinstance(message, Mission) and (
        len(message.items) > MAX_ITEMS
        or not all(map(math.isfinite, (x for i in message.items for x in (i.param1, i.param2, i.param3, i.alt_m))))
    ):
        raise ValueError("Mission with invalid items")
    if isinstance(message, Params) and not all(map(math.isfinite, message.values.values())):
        raise ValueError("Params with a non-finite value")


def _fits(rows: Rows, width: int) -> bool:
    t, x = rows.t.numpy(), rows.x.numpy()
    return bool(
        t.ndim == 1
        and x.shape == (len(t), width)
        and len(t)
        and np.isfinite(x).all()
        and (t > 0).all()
        and (t < _LATEST_S).all()
    )
