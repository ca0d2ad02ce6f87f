"""Convert stamped `Records` to rows of `Sample` fields: select the best source, join parts, sort by time."""

from collections.abc import Iterator

import numpy as np

from fleet.frames import wrap
from fleet.telemetry.mavlink.onboard_log import FieldRows
from fleet.telemetry.onboard_logs.dataflash.records import Records
from fleet.telemetry.tables.dataflash import ANGLES, OPTIONAL_PARTS, PARTS, RATES, ROWS, TABLE, field_of, is_plausible
from fleet.telemetry.tables.row import FieldSource

MAX_PART_GAP_S = 0.5  # maximum time between the parts of one row [s]
PART_WAIT_S = 1.0  # maximum wait of a row for its other parts [s]
MIN_SHARE = 0.2  # minimum row count of a source, relative to the fastest source of its field

Series = tuple[np.ndarray, np.ndarray]  # times (n,), values (n, k)


def read_rows(row: FieldSource, records: Records) -> Series | None:
    """Return times and values of a table row applied to these messages; None if it does not apply."""
    with np.errstate(all="ignore"):  # invalid numbers are rejected below
        try:
            columns = np.stack(row.columns(records), axis=-1)
            valid = np.ones(len(records), bool) if row.when is None else np.asarray(row.when(records), bool)
        except AttributeError:
            return None
        valid &= is_plausible(row.field, columns)
    return records.t[valid], columns[valid]


class SourceSelector:
    """Count the rows of each source to select the best one."""

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}

    def count(self, block: list[Records]) -> None:
        """Count the rows of a block."""
        for records in block:
            for row in ROWS.get(records.format_.name, ()):
                if (rows := read_rows(row, records)) is not None:
                    self._counts[id(row)] = self._counts.get(id(row), 0) + len(rows[0])

    def select(self) -> dict[str, FieldSource]:
        """Return the active source of highest rank for each part."""
        best_source: dict[str, FieldSource] = {}
        max_rows: dict[str, int] = {}
        for row in TABLE:
            max_rows[row.field] = max(max_rows.get(row.field, 0), self._counts.get(id(row), 0))
        for row in TABLE:
            row_count = self._counts.get(id(row), 0)
            if (
                row_count
                and row_count >= MIN_SHARE * max_rows[row.field]
                and (row.field not in best_source or best_source[row.field].rank < row.rank)
            ):
                best_source[row.field] = row
        return best_source


class RowBuilder:
    """Convert blocks to rows, for one pass over a log."""

    def __init__(self, sources: dict[str, FieldSource]) -> None:
        self._sources = sources
        self._joiners = {field: joiner for field in PARTS if (joiner := _part_joiner(field, sources)) is not None}
        others = {parts[0][0]: {part for part, _ in parts[1:]} for parts in PARTS.values()}
        self._alone = {part for part, optional in others.items() if optional <= OPTIONAL_PARTS - set(sources)}
        self._newest: dict[str, float] = {}  # newest time of each part [s]

    def add_block(self, block: list[Records], newest: float, last: bool = False) -> FieldRows:
        """Return the rows completed by a block.

        Args:
            block: stamped messages
            newest: newest time in the log so far [s]
            last: whether this is the last block
        """
        table: FieldRows = {}
        for part, row in self._sources.items():
            t, values = self._monotonic(part, _read_all(row, block))
            joiner = self._joiners.get(field_of(part))
            if joiner is not None:
                joiner.add(part, t, values)
            elif (field_of(part) not in PARTS or part in self._alone) and len(t):
                table[part] = (t, values)
        for field, joiner in self._joiners.items():
            t, values = joiner.join_until(float("inf") if last else newest - PART_WAIT_S)
            if len(t):
                table[field] = (t, values)
        return table

    def _monotonic(self, part: str, series: list[Series]) -> Series:
        if not series:
            return np.zeros(0), np.zeros((0, 1))
        t = np.concatenate([t for t, _ in series])
        values = np.concatenate([part_values for _, part_values in series])
        newest = self._newest.get(part, float("-inf"))
        previous, following = np.append(newest, t[:-1]), np.append(t[1:], float("inf"))
        plausible = (
            t == np.maximum(np.minimum(previous, following), np.minimum(np.maximum(previous, following), t))
        ) | (following < previous)
        t, values = t[plausible], values[plausible]
        rising = t > np.maximum.accumulate(np.append(newest, t))[:-1]
        t, values = t[rising], values[rising]
        if len(t):
            self._newest[part] = float(t[-1])
        return t, values


def _read_all(row: FieldSource, block: list[Records]) -> list[Series]:
    results = (read_rows(row, records) for records in block if records.format_.name == row.message)
    return [series for series in results if series is not None and len(series[0])]


def _part_joiner(field: str, sources: dict[str, FieldSource]) -> "_PartJoiner | None":
    missing = {part for part, _ in PARTS[field]} - set(sources)
    return _PartJoiner(field, derive=RATES in missing) if missing <= {RATES} else None


class _PartJoiner:
    """Join the parts of one field, interpolated to the times of the first part."""

    def __init__(self, field: str, derive: bool) -> None:
        self._parts = PARTS[field]
        self._derive = derive  # rates from angles, without gyroscope
        self._series: dict[str, Series] = {part: (np.zeros(0), np.zeros((0, n))) for part, n in self._parts}
        self._angles: Series = self._series[self._parts[0][0]]  # newest angles, for the next difference

    def add(self, part: str, t: np.ndarray, values: np.ndarray) -> None:
        if not len(t):
            return
        self._series[part] = _concatenated(self._series[part], (t, values))
        if self._derive and part == ANGLES:
            angles = _concatenated(self._angles, (t, values))
            self._series[RATES] = _concatenated(self._series[RATES], rates_between(*angles))
            self._angles = (angles[0][-1:], angles[1][-1:])

    def join_until(self, until: float) -> Series:
        lead, others = self._parts[0][0], [part for part, _ in self._parts[1:]]
        t, values = self._series[lead]
        part_times = [self._series[part][0] for part in others]
        until = (
            max(until, min((times[-1] for times in part_times if len(times)), default=until))
            if all(map(len, part_times))
            else until
        )
        n = int(np.searchsorted(t, until, side="right"))
        columns, complete = [values[:n]], np.ones(n, bool)
        for part in others:
            interpolated, is_near = _interpolate(t[:n], *self._series[part])
            columns.append(interpolated)
            complete &= is_near
        self._series[lead] = (t[n:], values[n:])
        self._discard_before(others, t[n - 1] if n else until)
        return t[:n][complete], np.concatenate(columns, axis=1)[complete]

    def _discard_before(self, others: list[str], before: float) -> None:
        for part in others:
            t, values = self._series[part]
            start = max(int(np.searchsorted(t, before)) - 1, 0)
            self._series[part] = (t[start:], values[start:])


def _concatenated(a: Series, b: Series) -> Series:
    return np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])


def _interpolate(query_t: np.ndarray, t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not len(t):
        return np.zeros((len(query_t), values.shape[1])), np.zeros(len(query_t), bool)
    after = np.searchsorted(t, query_t)
    gap = np.minimum(np.abs(t[np.minimum(after, len(t) - 1)] - query_t), np.abs(query_t - t[np.maximum(after - 1, 0)]))
    return np.stack([np.interp(query_t, t, column) for column in values.T], axis=-1), gap <= MAX_PART_GAP_S


def rates_between(t: np.ndarray, angles: np.ndarray) -> Series:
    """Differentiate attitude: body rates halfway between neighbouring samples.

    p = phi_dot - psi_dot sin(theta); q = theta_dot cos(phi) + psi_dot sin(phi) cos(theta); r likewise.
    Source: Beard & McLain 2012, eq. 3.3.

    Args:
        t: (n,) [s]
        angles: phi, theta, psi, (n, 3) [rad]
    Returns:
        times (n - 1,) at most [s]; p, q, r [rad/s]
    """
    dt = np.diff(t)
    turn = wrap(np.diff(angles, axis=0))
    near = dt <= MAX_PART_GAP_S
    phi_dot, theta_dot, psi_dot = (turn[near] / dt[near, None]).T
    phi, theta = (angles[:-1, :2] + 0.5 * turn[:, :2])[near].T
    p = phi_dot - psi_dot * np.sin(theta)
    q = theta_dot * np.cos(phi) + psi_dot * np.sin(phi) * np.cos(theta)
    r = -theta_dot * np.sin(phi) + psi_dot * np.cos(phi) * np.cos(theta)
    return (t[:-1] + 0.5 * dt)[near], np.stack([p, q, r], axis=-1)


def derived_fields(sources: dict[str, FieldSource]) -> Iterator[str]:
    """Describe the fields that are derived without a direct source."""
    if ANGLES in sources and RATES not in sources:
        yield "attitude: no gyroscope in this log; p, q, r are differences of the angles"
