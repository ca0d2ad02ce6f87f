"""Reader of tables as `OnboardLog`: CSV files, archives of them, MATLAB files; a column map tells what they mean."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fleet.contract import ROW_WIDTHS
from fleet.telemetry.mavlink.onboard_log import OnboardEvent
from fleet.telemetry.onboard_logs.columns.column_map import NORMALISED, ColumnMap, FieldSpec, read_map
from fleet.telemetry.onboard_logs.columns.conversion import pulses, to_sample
from fleet.telemetry.onboard_logs.columns.matlab_tables import read_matlab
from fleet.telemetry.onboard_logs.columns.text_tables import Table, TextTables
from fleet.telemetry.onboard_logs.dataflash.rows import rates_between
from fleet.telemetry.onboard_logs.topic import Topic, time_order
from fleet.telemetry.onboard_logs.topic_log import TopicLog
from fleet.telemetry.tables.row import is_plausible

_EPOCH_S = 1e9  # later times count from 1970 [s]
_MAX_TIME_S = 4e9
_EVENTS = ("mode", "armed")
_MAX_EVENTS = 10_000


class TableLog(TopicLog):
    """Opened tables of one aircraft; see `onboard_log.OnboardLog`."""

    def __init__(self, opener: Callable[[], Any], path: Path, columns: str) -> None:
        """Read the tables; problems are listed in `skipped`.

        Args:
            opener: opens the decompressed bytes at the start
            path: the file; the other files of a flight lie in the same folder
            columns: column map, see `column_map.read_map`

        Raises:
            ValueError: if the column map or the file is invalid; the message names the reason.
            OSError: if the column map cannot be read; check the path.
        """
        super().__init__(path.name)
        if not columns:
            raise ValueError(
                f"{path.name}: found no column map, expected one for tables; name it with --columns, e.g. alfa or px4"
            )
        column_map = read_map(columns)
        self.autopilot, self.vehicle = column_map.autopilot, column_map.vehicle
        tables = self._read_tables(opener, path, column_map)
        self._add_topics(tables, column_map)
        for name, spec in column_map.fields.items():
            if name in _EVENTS:
                self._add_events(name, spec, tables)
            else:
                self._add_rows(name, spec)
        if column_map.mode and self.topics:
            start = min(float(topic.t[0]) for topic in self.topics.values())
            self.events.append(OnboardEvent(start, "mode", column_map.mode))
        self.events.sort(key=lambda event: event.t)
        self.drop_long_topics()
        if not self.rows:
            self.skipped.append(f"found no rows by {column_map.name}, expected a flight; check map and file")

    def _read_tables(self, opener: Callable[[], Any], path: Path, column_map: ColumnMap) -> dict[str, Table]:
        with opener() as stream:
            if path.name.split(".", 1)[-1].lower().startswith("mat"):
                return read_matlab(stream, column_map, self.skipped)
            reader = TextTables(column_map, self.skipped)
            if ".tar" in path.suffixes or path.suffix == ".tgz":
                reader.read_archive(stream)
            else:
                reader.read_files(stream, path)
            return reader.tables

    def _add_topics(self, tables: dict[str, Table], column_map: ColumnMap) -> None:
        """Order the rows of every table by time; times above 1e9 s count from 1970."""
        from_epoch: set[bool] = set()
        for name, table in tables.items():
            spec = column_map.tables[name]
            t = table.numbers[spec.time] * spec.time_unit
            finite = np.isfinite(t) & (np.abs(t) < _MAX_TIME_S)
            order = np.flatnonzero(finite)[time_order(np.rint(t[finite] * 1e6).astype(np.int64))]
            if len(order) < len(t):
                self.skipped.append(f"table {name!r}: {len(t) - len(order)} rows with a bad time were skipped")
            if not len(order):
                continue
            texts = {key: [values[k] for k in order.tolist()] for key, values in table.texts.items()}
            tables[name] = table._replace(texts=texts)
            from_epoch.add(bool(np.median(t[order]) > _EPOCH_S))
            self.topics[name] = Topic(
                t[order], {key: value[order] for key, value in table.numbers.items()}, self.topics
            )
        if len(from_epoch) > 1:
            raise ValueError(
                f"{self.name}: found times since 1970 and others, expected one clock; correct {column_map.name}"
            )
        self.epoch_s = 0.0 if from_epoch == {True} else None

    def _values(self, spec: FieldSpec) -> list[np.ndarray] | None:
        """Return the components in SI units at the times of the field's table; None if a column is missing."""
        topic = self.topics.get(spec.table)
        if topic is None:
            return None
        columns = []
        for entry, unit, factor in zip(spec.columns, spec.units, spec.factors, strict=True):
            if isinstance(entry, float):
                columns.append(np.full(len(topic), entry * factor))
                continue
            table, column = entry
            try:
                source = topic if table == spec.table else topic.interpolated(table)
                values = source.field(column)
            except AttributeError:
                self.skipped.append(f"found no column {column!r} in table {table!r}, expected it by the column map")
                return None
            columns.append(pulses(values) if unit == NORMALISED else values * factor)
        return columns

    def _add_rows(self, name: str, spec: FieldSpec) -> None:
        columns = self._values(spec)
        if columns is None:
            return
        t = self.topics[spec.table].t
        with np.errstate(all="ignore"):
            values = to_sample(name, columns, spec.frame)
        if name == "attitude" and np.isnan(values[:, 3:]).all():
            valid = np.isfinite(values[:, :3]).all(axis=1)
            t, values = _with_rates(t[valid], values[valid])
            self.skipped.append("attitude: no rates in the column map; p, q, r are differences of the angles")
        plausible = is_plausible(name, values) if values.shape[1] in ROW_WIDTHS[name] else np.zeros(len(t), bool)
        if name in ("position", "target"):
            plausible &= (np.abs(values[:, :2]) > 1e5).any(axis=1)  # without a fix receivers report 0, 0
        if (rejected := int((~plausible).sum())) and rejected > 0.5 * len(t):
            self.skipped.append(
                f"{name}: {rejected} of {len(t)} rows not finite or out of range; check units and frame"
            )
        if plausible.any():
            self.rows[name] = (t[plausible], values[plausible])

    def _add_events(self, name: str, spec: FieldSpec, tables: dict[str, Table]) -> None:
        entry, topic = spec.columns[0], self.topics.get(spec.table)
        if (
            topic is None
            or not isinstance(entry, tuple)
            or entry[0] != spec.table
            or entry[1] not in tables[entry[0]].texts
        ):
            return
        texts, previous = tables[entry[0]].texts[entry[1]], None
        for t, text in zip(topic.t.tolist(), texts, strict=True):
            value = spec.names.get(text, text)
            if value != previous and len(self.events) < _MAX_EVENTS:
                previous = value
                self.events.append(OnboardEvent(t, name, _is_true(value) if name == "armed" else value.upper()))


def _is_true(text: str) -> bool:
    return text.strip().lower() in ("1", "1.0", "true", "armed", "yes")


def _with_rates(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill p, q, r from differences of the angles, interpolated to the times of the attitude."""
    if len(t) < 3:
        return t[:0], values[:0]
    rate_t, rates = rates_between(t, values[:, :3])
    if not len(rate_t):
        return t[:0], values[:0]
    filled = values.copy()
    filled[:, 3:] = np.column_stack([np.interp(t, rate_t, column) for column in rates.T])
    return t, filled
