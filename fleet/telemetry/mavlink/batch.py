"""Convert a batch of MAVLink frames by the MAVLink table: all frames of one message, all aircraft at once."""

from collections.abc import Sequence

import numpy as np

from fleet.contract import COLUMNS
from fleet.telemetry.mavlink.aircraft_link import Craft
from fleet.telemetry.mavlink.arrays.fleet_arrays import Flock, Laid
from fleet.telemetry.mavlink.arrays.row_arbiter import FIELDS, NO_FIELD
from fleet.telemetry.mavlink.arrays.rows import WIDEST
from fleet.telemetry.mavlink.parsing.decode import Dealt, Fields, Frames
from fleet.telemetry.tables.mavlink import TABLE, own_seconds
from fleet.telemetry.tables.row import Row, believable

_TICK = np.array([row.tick for row in TABLE])
_FIELD = np.array([FIELDS.index(row.field) for row in TABLE])
_RANK = np.array([row.rank for row in TABLE])
_GIVEN = np.array([FIELDS.index(row.given) if row.given else NO_FIELD for row in TABLE])


def lay(frames: Frames, owner: np.ndarray, crafts: Sequence[Craft], flock: Flock) -> None:
    """Convert frames to telemetry rows and add them to the arrays.

    Args:
        frames: received frames
        owner: number in `aircraft` of each frame's aircraft, -1 without owner, (n,)
        aircraft: the aircraft on this link
        arrays: their state
    """
    dealt, said = Dealt(frames), Said(frames, owner, crafts)
    names = set(dealt.names())
    rows = ((number, row) for number, row in enumerate(TABLE) if row.message in names)
    heard = [(number, *found) for number, row in rows if (found := said.rows(row, *dealt.fields(row.message)))]
    if not heard:
        return
    which, raw_s, values = (np.concatenate([found[k] for found in heard]) for k in (1, 2, 3))
    order = np.argsort(which, kind="stable")
    number, which = np.repeat([found[0] for found in heard], [len(found[1]) for found in heard])[order], which[order]
    codes = (_TICK[number], _FIELD[number], _RANK[number], _GIVEN[number])
    judged = flock.judge(Laid(owner[which], frames.arrival[which], raw_s[order], values[order], *codes))
    for k in np.flatnonzero(~np.isnan(judged.jumped)).tolist():
        crafts[k].jumped(float(judged.jumped[k]))
    for i in np.flatnonzero(judged.advanced).tolist():
        crafts[owner[which[i]]].reanchored(float(frames.arrival[which[i]]), float(judged.advanced[i]))
    for k in np.flatnonzero(judged.refused).tolist():
        crafts[k].doubted(float(judged.newest[k]), int(judged.refused[k]))


class Said:
    """Read a batch of frames by the rows of the table."""

    def __init__(self, frames: Frames, owner: np.ndarray, crafts: Sequence[Craft]) -> None:
        self._frames, self._owner, self._crafts = frames, owner, crafts
        self._autopilot = np.array([craft.autopilot for craft in crafts])

    def rows(self, row: Row, which: np.ndarray, fields: Fields) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Apply one table row: frame numbers (n,), time stamps (n,) [s], values (n, 8); None without valid frames.

        Args:
            row: table row
            frame_numbers: frames of its message, (m,)
            fields: fields of these frames
        """
        meant = self._owner[which] >= 0
        if row.autopilots and meant.any():
            meant[meant] = np.isin(self._autopilot, row.autopilots)[self._owner[which[meant]]]
        if row.when is not None:
            with np.errstate(all="ignore"):
                meant &= row.when(fields)
        if not meant.all():
            which, fields = which[meant], Fields(fields.rows[meant])
        if not len(which):
            return None
        values = np.zeros((len(which), WIDEST))
        with np.errstate(all="ignore"):  # NaN propagates and is rejected below
            for k, column in enumerate(row.columns(fields)):
                values[:, k] = column
            good = believable(row.field, values[:, : len(COLUMNS[row.field])])
        raw_s = np.broadcast_to(own_seconds(row, fields), len(which))
        if good.all():
            return which, raw_s, values
        self._refuse(row.message, which[~good])
        return which[good], raw_s[good], values[good]

    def _refuse(self, message: str, which: np.ndarray) -> None:
        """Report frames with implausible values to their aircraft."""
        owner = self._owner[which]
        for number in np.unique(owner).tolist():
            mine, craft = which[owner == number], self._crafts[number]
            craft.queue(float(self._frames.arrival[mine[-1]]), craft.refuse, message, len(mine))
