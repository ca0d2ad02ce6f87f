"""Convert stamped `Records` to rows of `Sample` fields: select the best source, join parts, sort by time."""

from collections.abc import Iterator

import numpy as np

from fleet.frames import wrap
from fleet.telemetry.mavlink.onboard_log import Table
from fleet.telemetry.onboard_logs.dataflash.records import Records
from fleet.telemetry.tables.dataflash import ANGLES, PARTS, RATES, ROWS, TABLE, believable, field_of
from fleet.telemetry.tables.row import Row

NEAR_S = 0.5  # maximum time between the parts of one row [s]
WAIT_S = 1.0  # maximum wait of a row for its other parts [s]
USEFUL = 0.2  # minimum row count of a source, relative to the fastest source of its field

Series = tuple[np.ndarray, np.ndarray]  # times (n,), values (n, k)


def read(row: Row, records: Records) -> Series | None:
    """Return times and values of a table row applied to these messages; None if it does not apply."""
    with np.errstate(all="ignore"):  # invalid numbers are rejected below
        try:
            columns = np.stack(row.columns(records), axis=-1)
            which = np.ones(len(records), bool) if row.when is None else np.asarray(row.when(records), bool)
        except AttributeError:
            return None
        which &= believable(row.field, columns)
    return records.t[which], columns[which]


class Survey:
    """Count the rows of each source to select the best one."""

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}

    def look(self, block: list[Records]) -> None:
        """Count the rows of a block."""
        for records in block:
            for row in ROWS.get(records.form.name, ()):
                if (found := read(row, records)) is not None:
                    self._counts[id(row)] = self._counts.get(id(row), 0) + len(found[0])

    def chosen(self) -> dict[str, Row]:
        """Return the active source of highest rank for each part."""
        best: dict[str, Row] = {}
        most: dict[str, int] = {}
        for row in TABLE:
            most[row.field] = max(most.get(row.field, 0), self._counts.get(id(row), 0))
        for row in TABLE:
            n = self._counts.get(id(row), 0)
            if n and n >= USEFUL * most[row.field] and (row.field not in best or best[row.field].rank < row.rank):
                best[row.field] = row
        return best


class Rows:
    """Convert blocks to rows, for one pass over a log."""

    def __init__(self, sources: dict[str, Row]) -> None:
        self._sources = sources
        self._joints = {field: joint for field in PARTS if (joint := _joint(field, sources)) is not None}
        self._newest: dict[str, float] = {}  # newest time of each part [s]

    def take(self, block: list[Records], newest: float, last: bool = False) -> Table:
        """Return the rows completed by a block.

        Args:
            block: stamped messages
            newest: newest time in the log so far [s]
            last: whether this is the last block
        """
        table: Table = {}
        for part, row in self._sources.items():
            t, values = self._rising(part, _all(row, block))
            joint = self._joints.get(field_of(part))
            if joint is not None:
                joint.add(part, t, values)
            elif field_of(part) not in PARTS and len(t):
                table[part] = (t, values)
        for field, joint in self._joints.items():
            t, values = joint.settle(float("inf") if last else newest - WAIT_S)
            if len(t):
                table[field] = (t, values)
        return table

    def _rising(self, part: str, found: list[Series]) -> Series:
        if not found:
            return np.zeros(0), np.zeros((0, 1))
        t = np.concatenate([t for t, _ in found])
        values = np.concatenate([v for _, v in found])
        newest = self._newest.get(part, float("-inf"))
        before, after = np.append(newest, t[:-1]), np.append(t[1:], float("inf"))
        sound = (t == np.maximum(np.minimum(before, after), np.minimum(np.maximum(before, after), t))) | (
            after < before
        )
        t, values = t[sound], values[sound]
        rising = t > np.maximum.accumulate(np.append(newest, t))[:-1]
        t, values = t[rising], values[rising]
        if len(t):
            self._newest[part] = float(t[-1])
        return t, values


def _all(row: Row, block: list[Records]) -> list[Series]:
    found = (read(row, records) for records in block if records.form.name == row.message)
    return [series for series in found if series is not None and len(series[0])]


def _joint(field: str, sources: dict[str, Row]) -> "_Joint | None":
    missing = {part for part, _ in PARTS[field]} - set(sources)
    return _Joint(field, derive=RATES in missing) if missing <= {RATES} else None


class _Joint:
    """Join the parts of one field, interpolated to the times of the first part."""

    def __init__(self, field: str, derive: bool) -> None:
        self._parts = PARTS[field]
        self._derive = derive  # rates from angles, without gyroscope
        self._series: dict[str, Series] = {part: (np.zeros(0), np.zeros((0, n))) for part, n in self._parts}
        self._angles: Series = self._series[self._parts[0][0]]  # newest angles, for the next difference

    def add(self, part: str, t: np.ndarray, values: np.ndarray) -> None:
        if not len(t):
            return
        self._series[part] = _joined(self._series[part], (t, values))
        if self._derive and part == ANGLES:
            angles = _joined(self._angles, (t, values))
            self._series[RATES] = _joined(self._series[RATES], rates_between(*angles))
            self._angles = (angles[0][-1:], angles[1][-1:])

    def settle(self, until: float) -> Series:
        lead, others = self._parts[0][0], [part for part, _ in self._parts[1:]]
        t, values = self._series[lead]
        known = [self._series[part][0] for part in others]
        until = max(until, min((s[-1] for s in known if len(s)), default=until)) if all(map(len, known)) else until
        n = int(np.searchsorted(t, until, side="right"))
        columns, near = [values[:n]], np.ones(n, bool)
        for part in others:
            added, close = _interpolated(t[:n], *self._series[part])
            columns.append(added)
            near &= close
        self._series[lead] = (t[n:], values[n:])
        self._forget(others, t[n - 1] if n else until)
        return t[:n][near], np.concatenate(columns, axis=1)[near]

    def _forget(self, others: list[str], before: float) -> None:
        for part in others:
            t, values = self._series[part]
            start = max(int(np.searchsorted(t, before)) - 1, 0)
            self._series[part] = (t[start:], values[start:])


def _joined(a: Series, b: Series) -> Series:
    return np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])


def _interpolated(at: np.ndarray, t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not len(t):
        return np.zeros((len(at), values.shape[1])), np.zeros(len(at), bool)
    after = np.searchsorted(t, at)
    gap = np.minimum(np.abs(t[np.minimum(after, len(t) - 1)] - at), np.abs(at - t[np.maximum(after - 1, 0)]))
    return np.stack([np.interp(at, t, column) for column in values.T], axis=-1), gap <= NEAR_S


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
    near = dt <= NEAR_S
    phi_dot, theta_dot, psi_dot = (turn[near] / dt[near, None]).T
    phi, theta = (angles[:-1, :2] + 0.5 * turn[:, :2])[near].T
    p = phi_dot - psi_dot * np.sin(theta)
    q = theta_dot * np.cos(phi) + psi_dot * np.sin(phi) * np.cos(theta)
    r = -theta_dot * np.sin(phi) + psi_dot * np.cos(phi) * np.cos(theta)
    return (t[:-1] + 0.5 * dt)[near], np.stack([p, q, r], axis=-1)


def origins(sources: dict[str, Row]) -> Iterator[str]:
    """Describe the fields that are derived without a direct source."""
    if ANGLES in sources and RATES not in sources:
        yield "attitude: no gyroscope in this log; p, q, r are differences of the angles"
