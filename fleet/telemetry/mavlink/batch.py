"""Convert a batch of MAVLink frames by the MAVLink table: all frames of one message, all aircraft at once."""

from collections.abc import Sequence

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.arrays.fleet_arrays import AircraftArrays
from fleet.telemetry.mavlink.arrays.row_arbiter import (
    ACCEPTED,
    FIELDS,
    NO_FIELD,
    REJECTED,
    SOURCE_TIMEOUT_S,
    arbitrate_rows,
)
from fleet.telemetry.mavlink.arrays.rows import MAX_COLUMNS, WITH_EXTRA, same_width
from fleet.telemetry.mavlink.parsing.decode import Fields, Frames, GroupedFrames
from fleet.telemetry.tables import clock
from fleet.telemetry.tables.mavlink import SECOND_PORT, TABLE, own_seconds
from fleet.telemetry.tables.row import FieldSource, is_plausible

_TICK = np.array([row.tick for row in TABLE])
_FIELD = np.array([FIELDS.index(row.field) for row in TABLE])
_RANK = np.array([row.rank for row in TABLE])
_SERVO = FIELDS.index("servo")
_REQUIRES = np.array([FIELDS.index(row.requires) if row.requires else NO_FIELD for row in TABLE])


def process_table_rows(
    frames: Frames, owner: np.ndarray, aircraft: Sequence[AircraftLink], arrays: AircraftArrays
) -> None:
    """Convert frames to telemetry rows and add them to the arrays.

    Args:
        frames: received frames
        owner: number in `aircraft` of each frame's aircraft, -1 without owner, (n,)
        aircraft: the aircraft on this link
        arrays: their state
    """
    read = _read(frames, owner, aircraft)
    if read is None:
        return
    row, frame_numbers, raw_s, values = _join_ports(read, frames.arrival, owner, arrays.second_ports)
    field, owner, arrival = _FIELD[row], owner[frame_numbers], frames.arrival[frame_numbers]
    n, count = len(row), len(aircraft)
    t, decision, advanced, jumped = np.empty(n), np.empty(n, np.int8), np.empty(n), np.full(count, np.nan)
    columns = (owner, _TICK[row], raw_s, arrival, field, _RANK[row], _REQUIRES[row])
    arbitrate_rows(arrays.clocks, arrays.arbiter_state, *columns, t, decision, jumped, advanced)
    accepted = np.flatnonzero(decision == ACCEPTED)
    key = owner[accepted] * len(FIELDS) + field[accepted]
    arrays.pending.add_rows(key, arrival[accepted], t[accepted], values[accepted])
    for k in np.flatnonzero(~np.isnan(jumped)).tolist():
        aircraft[k].queue(float(jumped[k]), aircraft[k].apply_clock_jump, clock.jumps(arrays.clocks[k]))
    for i in np.flatnonzero(advanced).tolist():
        link = aircraft[owner[i]]
        link.queue(float(arrival[i]), link.apply_reanchor, float(advanced[i]))
    rejected = np.bincount(owner[decision == REJECTED], minlength=count)
    for k in np.flatnonzero(rejected).tolist():
        newest = float(arrival[np.flatnonzero(owner == k)[-1]])
        aircraft[k].queue(newest, aircraft[k].count_rejected, int(rejected[k]))


def _read(frames: Frames, owner: np.ndarray, aircraft: Sequence[AircraftLink]) -> tuple[np.ndarray, ...] | None:
    """Apply all table rows to the frames of their messages; None without valid frames.

    Returns:
        number in `TABLE`, (n,); frame number, (n,), non-decreasing; time stamp of the message, (n,) [s]; values,
        (n, 8), or (n, 16) if an aircraft of the batch uses extra columns
    """
    grouped, autopilots = GroupedFrames(frames), np.array([link.autopilot for link in aircraft])
    names, parts = set(grouped.names()), []
    for number, row in enumerate(TABLE):
        if row.message not in names:
            continue
        frame_numbers, fields = grouped.fields(row.message)
        applicable = _applicable(row, fields, owner[frame_numbers], autopilots)
        frame_numbers, fields = frame_numbers[applicable], Fields(fields.rows[applicable])
        if not len(frame_numbers):
            continue
        values, valid = _values(row, fields)
        _reject(row.message, frames, frame_numbers[~valid], owner, aircraft)
        raw_s = np.broadcast_to(own_seconds(row, fields), len(frame_numbers))
        parts.append((np.full(valid.sum(), number), frame_numbers[valid], raw_s[valid], values[valid]))
    if not parts:
        return None
    *others, all_values = zip(*parts, strict=True)
    columns = [np.concatenate(column) for column in (*others, same_width(*all_values))]
    order = np.argsort(columns[1], kind="stable")
    return tuple(column[order] for column in columns)


def _applicable(row: FieldSource, fields: Fields, owner: np.ndarray, autopilots: np.ndarray) -> np.ndarray:
    """Return a mask of the frames to which a table row applies, (n,)."""
    applicable = owner >= 0
    if row.autopilots and applicable.any():
        applicable[applicable] = np.isin(autopilots, row.autopilots)[owner[applicable]]
    if row.when is not None:
        with np.errstate(all="ignore"):
            applicable &= row.when(fields)
    return applicable


def _values(row: FieldSource, fields: Fields) -> tuple[np.ndarray, np.ndarray]:
    """Apply a table row: values (n, 8), (n, 16) with extra columns in use, and a mask of the plausible ones (n,)."""
    with np.errstate(all="ignore"):  # NaN propagates and is rejected
        columns = row.columns(fields)
        values = np.zeros((len(fields.rows), MAX_COLUMNS if len(columns) <= MAX_COLUMNS else WITH_EXTRA))
        for k, column in enumerate(columns):
            values[:, k] = column
        if len(columns) > MAX_COLUMNS and not values[:, MAX_COLUMNS:].any():
            values = values[:, :MAX_COLUMNS]
        return values, is_plausible(row.field, values[:, : min(len(columns), values.shape[1])])


def _join_ports(
    read: tuple[np.ndarray, ...],
    arrival: np.ndarray,
    owner: np.ndarray,
    second_ports: dict[int, tuple[float, np.ndarray]],
) -> tuple[np.ndarray, ...]:
    """Complete the outputs of the first port by the newest of the second port; return the rows without its own.

    Args:
        read: result of `_read`
        arrival, owner: of all frames, (m,)
        second_ports: newest outputs of the second port by aircraft, changed in place
    """
    row, frame_numbers, _, values = read
    is_second = row == SECOND_PORT
    if not second_ports and not is_second.any():
        return read
    (values,) = same_width(values, np.empty((0, WITH_EXTRA)))[:1]
    for i in np.flatnonzero(_FIELD[row] == _SERVO).tolist():
        frame = frame_numbers[i]
        aircraft, t = int(owner[frame]), float(arrival[frame])
        if is_second[i]:
            second_ports[aircraft] = (t, values[i, MAX_COLUMNS:].copy())
        elif aircraft in second_ports and not values[i, MAX_COLUMNS:].any():
            since, outputs = second_ports[aircraft]
            values[i, MAX_COLUMNS:] = outputs if t - since <= SOURCE_TIMEOUT_S else 0.0
    return tuple(column[~is_second] for column in (*read[:3], values))


def _reject(
    message: str, frames: Frames, frame_numbers: np.ndarray, owner: np.ndarray, aircraft: Sequence[AircraftLink]
) -> None:
    """Report frames with implausible values to their aircraft."""
    for number in np.unique(owner[frame_numbers]).tolist():
        own_frames, link = frame_numbers[owner[frame_numbers] == number], aircraft[number]
        link.queue(float(frames.arrival[own_frames[-1]]), link.reject_values, message, len(own_frames))
