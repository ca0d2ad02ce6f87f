"""A batch of MAVLink frames through THE TABLE: all frames of one message at once, then to each aircraft its rows."""

from collections.abc import Sequence

import numpy as np

from fleet.contract import COLUMNS
from fleet.telemetry.craft import Craft, Laid
from fleet.telemetry.decode import IDS, Fields, Frames
from fleet.telemetry.dialects.mavlink import TABLE, own_seconds
from fleet.telemetry.dialects.row import Row, believable
from fleet.telemetry.scan import ID

_WIDEST = max(map(len, COLUMNS.values()))


def lay(frames: Frames, owner: np.ndarray, crafts: Sequence[Craft]) -> None:
    """Give every aircraft its rows.

    Args:
        frames: what was heard
        owner: number in `crafts` of each frame's aircraft, -1 for nobody's, (n,)
        crafts: the aircraft on this link
    """
    heard = [(number, *found) for number, row in enumerate(TABLE) if (found := _rows(row, frames, owner, crafts))]
    which = np.concatenate([found[1] for found in heard]) if heard else np.empty(0, int)
    if not len(which):
        return
    number = np.concatenate([np.full(len(found[1]), found[0]) for found in heard])
    raw_s, values = (np.concatenate([found[k] for found in heard]) for k in (2, 3))
    order = np.lexsort((number, which, owner[which]))
    mine = owner[which[order]]
    for part in np.split(order, np.flatnonzero(np.diff(mine)) + 1):
        laid = Laid(frames.arrival[which[part]], number[part], raw_s[part], values[part], TABLE)
        crafts[owner[which[part[0]]]].lay(laid)


def _rows(
    row: Row, frames: Frames, owner: np.ndarray, crafts: Sequence[Craft]
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Read one row of the table off every frame it fits: frame numbers (n,), own times (n,) [s], values (n, 8)."""
    which = np.flatnonzero((frames.at[:, ID] == IDS[row.message]) & (owner >= 0))
    if row.autopilots and len(which):
        fits = np.array([craft.autopilot in row.autopilots for craft in crafts])
        which = which[fits[owner[which]]]
    if not len(which):
        return None
    fields = frames.fields(which, row.message)
    if row.when is not None:
        meant = row.when(fields)
        which, fields = which[meant], Fields(fields.rows[meant])
    values = np.zeros((len(which), _WIDEST))
    with np.errstate(all="ignore"):  # not a number in, not a number out: refused below
        for k, column in enumerate(row.columns(fields)):
            values[:, k] = column
        good = believable(row.field, values[:, : len(COLUMNS[row.field])])
    for number in np.unique(owner[which[~good]]).tolist():
        mine = which[~good][owner[which[~good]] == number]
        crafts[number].queue(float(frames.arrival[mine[-1]]), crafts[number].refuse, row.message, len(mine))
    return which[good], np.broadcast_to(own_seconds(row, fields), len(which))[good], values[good]
