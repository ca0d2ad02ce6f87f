"""Convert a batch of MAVLink frames by the MAVLink table: all frames of one message, all aircraft at once."""

from collections.abc import Sequence

import numpy as np

from fleet.contract import COLUMNS
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.arrays.fleet_arrays import AircraftArrays, RowBatch
from fleet.telemetry.mavlink.arrays.row_arbiter import FIELDS, NO_FIELD
from fleet.telemetry.mavlink.arrays.rows import MAX_COLUMNS
from fleet.telemetry.mavlink.parsing.decode import Fields, Frames, GroupedFrames
from fleet.telemetry.tables.mavlink import TABLE, own_seconds
from fleet.telemetry.tables.row import FieldSource, is_plausible

_TICK = np.array([row.tick for row in TABLE])
_FIELD = np.array([FIELDS.index(row.field) for row in TABLE])
_RANK = np.array([row.rank for row in TABLE])
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
    grouped, reader = GroupedFrames(frames), BatchReader(frames, owner, aircraft)
    names = set(grouped.names())
    rows = ((row_number, row) for row_number, row in enumerate(TABLE) if row.message in names)
    results = [(number, *result) for number, row in rows if (result := reader.rows(row, *grouped.fields(row.message)))]
    if not results:
        return
    frame_numbers, raw_s, values = (np.concatenate([result[k] for result in results]) for k in (1, 2, 3))
    order = np.argsort(frame_numbers, kind="stable")
    number, frame_numbers = (
        np.repeat([result[0] for result in results], [len(result[1]) for result in results])[order],
        frame_numbers[order],
    )
    codes = (_TICK[number], _FIELD[number], _RANK[number], _REQUIRES[number])
    outcome = arrays.arbitrate(
        RowBatch(owner[frame_numbers], frames.arrival[frame_numbers], raw_s[order], values[order], *codes)
    )
    for k in np.flatnonzero(~np.isnan(outcome.jumped)).tolist():
        aircraft[k].queue_clock_jump(float(outcome.jumped[k]))
    for i in np.flatnonzero(outcome.advanced).tolist():
        aircraft[owner[frame_numbers[i]]].queue_reanchor(
            float(frames.arrival[frame_numbers[i]]), float(outcome.advanced[i])
        )
    for k in np.flatnonzero(outcome.rejected).tolist():
        aircraft[k].queue_rejected(float(outcome.newest[k]), int(outcome.rejected[k]))


class BatchReader:
    """Read a batch of frames by the rows of the table."""

    def __init__(self, frames: Frames, owner: np.ndarray, aircraft: Sequence[AircraftLink]) -> None:
        self._frames, self._owner, self._aircraft = frames, owner, aircraft
        self._autopilot = np.array([link.autopilot for link in aircraft])

    def rows(
        self, row: FieldSource, frame_numbers: np.ndarray, fields: Fields
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Apply one table row: frame numbers (n,), time stamps (n,) [s], values (n, 8); None without valid frames.

        Args:
            row: table row
            frame_numbers: frames of its message, (m,)
            fields: fields of these frames
        """
        applicable = self._owner[frame_numbers] >= 0
        if row.autopilots and applicable.any():
            applicable[applicable] = np.isin(self._autopilot, row.autopilots)[self._owner[frame_numbers[applicable]]]
        if row.when is not None:
            with np.errstate(all="ignore"):
                applicable &= row.when(fields)
        if not applicable.all():
            frame_numbers, fields = frame_numbers[applicable], Fields(fields.rows[applicable])
        if not len(frame_numbers):
            return None
        values = np.zeros((len(frame_numbers), MAX_COLUMNS))
        with np.errstate(all="ignore"):  # NaN propagates and is rejected below
            for k, column in enumerate(row.columns(fields)):
                values[:, k] = column
            valid = is_plausible(row.field, values[:, : len(COLUMNS[row.field])])
        raw_s = np.broadcast_to(own_seconds(row, fields), len(frame_numbers))
        if valid.all():
            return frame_numbers, raw_s, values
        self._reject(row.message, frame_numbers[~valid])
        return frame_numbers[valid], raw_s[valid], values[valid]

    def _reject(self, message: str, frame_numbers: np.ndarray) -> None:
        """Report frames with implausible values to their aircraft."""
        owner = self._owner[frame_numbers]
        for number in np.unique(owner).tolist():
            own_frames, link = frame_numbers[owner == number], self._aircraft[number]
            link.queue(float(self._frames.arrival[own_frames[-1]]), link.reject_values, message, len(own_frames))
