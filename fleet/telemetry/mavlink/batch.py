"""Convert a batch of MAVLink frames by the MAVLink table: all frames of one message, all aircraft at once."""

from collections.abc import Sequence

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.arrays.fleet_arrays import AircraftArrays
from fleet.telemetry.mavlink.arrays.pack import WIDEST, WIDTHS
from fleet.telemetry.mavlink.arrays.row_arbiter import (
    ACCEPTED,
    FIELDS,
    NO_FIELD,
    REJECTED,
    SOURCE_TIMEOUT_S,
    arbitrate_rows,
)
from fleet.telemetry.mavlink.arrays.rows import sort_numbers
from fleet.telemetry.mavlink.heartbeat import AUTOPILOTS
from fleet.telemetry.mavlink.parsing.decode import Fields, Frames, GroupedFrames
from fleet.telemetry.tables import clock
from fleet.telemetry.tables.mavlink import SECOND_PORT, TABLE, own_seconds
from fleet.telemetry.tables.row import FieldSource, is_plausible

_TICK = np.array([row.tick for row in TABLE])
_FIELD = np.array([FIELDS.index(row.field) for row in TABLE])
_RANK = np.array([row.rank for row in TABLE])
_SERVO = FIELDS.index("servo")
_EXTRA = slice(int(WIDTHS[_SERVO]), int(WIDEST[_SERVO]))
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
    read = _read(frames, owner, aircraft, arrays.autopilots)
    if read is None:
        return
    row, frame_numbers, raw_s, at, values = _join_ports(read, frames.arrival, owner, arrays.second_ports)
    field, owner, arrival = _FIELD[row], owner[frame_numbers], frames.arrival[frame_numbers]
    n, count = len(row), len(aircraft)
    t, decision, advanced, jumped = np.empty(n), np.empty(n, np.int8), np.empty(n), np.full(count, np.nan)
    columns = (owner, _TICK[row], raw_s, arrival, field, _RANK[row], _REQUIRES[row])
    arbitrate_rows(arrays.clocks, arrays.arbiter_state, *columns, t, decision, jumped, advanced)
    accepted = np.flatnonzero(decision == ACCEPTED)
    key = owner[accepted] * len(FIELDS) + field[accepted]
    arrays.pending.add_values(key, arrival[accepted], t[accepted], values, at[accepted])
    for k in np.flatnonzero(~np.isnan(jumped)).tolist():
        aircraft[k].queue(float(jumped[k]), aircraft[k].apply_clock_jump, clock.jumps(arrays.clocks[k]))
    for i in np.flatnonzero(advanced).tolist():
        link = aircraft[owner[i]]
        link.queue(float(arrival[i]), link.apply_reanchor, float(advanced[i]))
    rejected = np.bincount(owner[decision == REJECTED], minlength=count)
    for k in np.flatnonzero(rejected).tolist():
        newest = float(arrival[np.flatnonzero(owner == k)[-1]])
        aircraft[k].queue(newest, aircraft[k].count_rejected, int(rejected[k]))


def _read(
    frames: Frames, owner: np.ndarray, aircraft: Sequence[AircraftLink], autopilots: np.ndarray
) -> tuple[np.ndarray, ...] | None:
    """Apply all table rows to the frames of their messages; None without valid frames.

    Returns:
        number in `TABLE`, (n,); frame number, (n,), non-decreasing; time stamp of the message, (n,) [s]; position of
        the first value in the last array, (n,); values of all rows, (m,)
    """
    grouped = GroupedFrames(frames)
    messages = {name: _owned(*grouped.fields(name), owner) for name in grouped.names() if name in _MESSAGES}
    numbers, parts = [], []
    for number, row in enumerate(TABLE):
        if row.message not in messages:
            continue
        frame_numbers, fields = _applicable(row, *messages[row.message], owner, autopilots)
        values, valid = _values(row, fields) if len(frame_numbers) else (np.empty((0, 0)), np.ones(0, bool))
        raw_s = own_seconds(row, fields) + np.zeros(len(frame_numbers))
        if not valid.all():
            _reject(row.message, frames, frame_numbers[~valid], owner, aircraft)
            frame_numbers, raw_s, values = frame_numbers[valid], raw_s[valid], values[valid]
        if len(frame_numbers):
            numbers.append(number)
            parts.append((frame_numbers, raw_s, values))
    if not parts:
        return None
    counts, widths = [len(part[0]) for part in parts], [part[2].shape[1] for part in parts]
    row_number, width = np.repeat(numbers, counts), np.repeat(widths, counts)
    frame_numbers, raw_s = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    order, _ = sort_numbers(frame_numbers, len(frames.headers))
    at = np.cumsum(width) - width
    all_values = np.concatenate([values.ravel() for *_, values in parts])
    return row_number[order], frame_numbers[order], raw_s[order], at[order], all_values


_MESSAGES = {row.message for row in TABLE}
_IS_APPLICABLE = {row.autopilots: np.array([name in row.autopilots for name in AUTOPILOTS]) for row in TABLE}


def _owned(frame_numbers: np.ndarray, fields: Fields, owner: np.ndarray) -> tuple[np.ndarray, Fields]:
    """Return the frames that have an owner."""
    return _selected(frame_numbers, fields, owner[frame_numbers] >= 0)


def _selected(frame_numbers: np.ndarray, fields: Fields, mask: np.ndarray) -> tuple[np.ndarray, Fields]:
    return (frame_numbers, fields) if mask.all() else (frame_numbers[mask], Fields(fields.rows[mask]))


def _applicable(
    row: FieldSource, frame_numbers: np.ndarray, fields: Fields, owner: np.ndarray, autopilots: np.ndarray
) -> tuple[np.ndarray, Fields]:
    """Return the frames to which a table row applies."""
    if row.autopilots:
        is_applicable = _IS_APPLICABLE[row.autopilots][autopilots]
        frame_numbers, fields = _selected(frame_numbers, fields, is_applicable[owner[frame_numbers]])
    if row.when is not None:
        with np.errstate(all="ignore"):
            frame_numbers, fields = _selected(frame_numbers, fields, row.when(fields))
    return frame_numbers, fields


def _values(row: FieldSource, fields: Fields) -> tuple[np.ndarray, np.ndarray]:
    """Apply a table row: values (n, k), k as in `WIDEST`, and a mask of the plausible ones (n,)."""
    with np.errstate(all="ignore"):  # NaN propagates and is rejected
        columns = row.columns(fields)
        values = np.empty((len(fields.rows), WIDEST[FIELDS.index(row.field)]))
        values[:, len(columns) :] = 0.0
        for k, column in enumerate(columns):
            values[:, k] = column
        return values, is_plausible(row.field, values)


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
    row, frame_numbers, _, at, values = read
    is_second = row == SECOND_PORT
    if not second_ports and not is_second.any():
        return read
    for i in np.flatnonzero(_FIELD[row] == _SERVO).tolist():
        frame, extra = frame_numbers[i], values[at[i] : at[i] + WIDEST[_SERVO]][_EXTRA]
        aircraft, t = int(owner[frame]), float(arrival[frame])
        if is_second[i]:
            second_ports[aircraft] = (t, extra.copy())
        elif aircraft in second_ports and not extra.any():
            since, outputs = second_ports[aircraft]
            extra[:] = outputs if t - since <= SOURCE_TIMEOUT_S else 0.0
    return *(column[~is_second] for column in read[:4]), values


def _reject(
    message: str, frames: Frames, frame_numbers: np.ndarray, owner: np.ndarray, aircraft: Sequence[AircraftLink]
) -> None:
    """Report frames with implausible values to their aircraft."""
    for number in np.unique(owner[frame_numbers]).tolist():
        own_frames, link = frame_numbers[owner[frame_numbers] == number], aircraft[number]
        link.queue(float(frames.arrival[own_frames[-1]]), link.reject_values, message, len(own_frames))
