"""Calibration tables on disk: JSON with source flights, date and command."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np

from twin_worker.confidence.calibration_table import ATOMS, KNOTS, Table, untaught
from twin_worker.confidence.groups import wider
from twin_worker.numerics.prediction_errors import QUANTILE

FORMAT = 1
GUESSED = "not calibrated"  # begins the sentence of a prediction without a calibrated table
_HERE = Path(__file__).parent
_INNERMOST = re.compile(r"\[[^\[\]{}]*\]")  # innermost lists: one per line
_ALONE = 0.94  # default of `CalibrationTable.alone`; measured: 0.96 to 30 s, 0.94 to 60 s, 0.91 to 120 s
_MOST = 1e6  # larger numbers are invalid


class Source(msgspec.Struct, frozen=True):
    """One file of predictions that tables were fitted on."""

    file: str
    starts: int
    flights: tuple[str, ...]


class Row(msgspec.Struct, frozen=True):
    """One table as stored; scale, lag, floor and factor by axis, then knot."""

    group: str
    starts: int
    flights: int
    scale: list[list[float]]
    lag: list[list[float]]
    floor: list[list[float]]
    factor: list[list[float]]
    scores: list[float]
    risks: list[float]
    held_out: dict[str, float] = {}
    alone: float = _ALONE


class Sheet(msgspec.Struct, frozen=True):
    """A file of tables."""

    format: int
    made: str
    command: str
    sources: tuple[Source, ...]
    knots_s: list[float]
    tables: tuple[Row, ...]


@dataclass(frozen=True)
class Tables:
    """All tables by group, and the errors of the files."""

    by_group: dict[str, Table]
    sentence: str = ""

    def choose(self, group: str) -> tuple[Table, str]:
        """Return the narrowest table for a group, and a description of it."""
        method = group.partition("/")[0]
        for name in wider(group):
            if (table := self.by_group.get(name)) is not None:
                own = "" if name == group else f", none for {group}"
                return table, f"calibrated on {table.starts} predictions of {table.flights} flights ({name}{own})"
        said = f"{GUESSED}: no table for {group}, the default for {method} is used"
        return untaught(method), " ".join(filter(None, (said, self.sentence)))


def read_tables(path: Path) -> Tables:
    """Read a file of tables.

    Raises:
        ValueError: when it is invalid; the message names the remedy.
    """
    try:
        sheet = msgspec.json.decode(path.read_bytes(), type=Sheet)
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"calibration {path.name}: found no tables ({error}); fit it again") from None
    if sheet.format != FORMAT or sheet.knots_s != KNOTS.tolist():
        raise ValueError(f"calibration {path.name}: found format {sheet.format}, expected {FORMAT}; fit it again")
    return Tables({row.group: _table(path.name, row) for row in sheet.tables})


def _table(file: str, row: Row) -> Table:
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("scale", "lag", "floor", "factor"), (3, 13))
    shapes |= dict.fromkeys(("scores", "risks"), (ATOMS,))
    arrays = {}
    for name, shape in shapes.items():
        try:
            arrays[name] = np.array(getattr(row, name), float)
        except ValueError:
            arrays[name] = np.empty(0)
        found = arrays[name]
        if found.shape != shape or not ((found >= 0) & (found < _MOST)).all():
            raise ValueError(
                f"calibration {file}: found {name} of {row.group} of shape {found.shape}, "
                f"expected {shape}, finite, not negative; fit it again"
            )
    if not ((arrays["factor"] > 0).all() and (arrays["scores"] > 0).all() and (arrays["floor"] > 0).all()):
        raise ValueError(f"calibration {file}: found a zero width for {row.group}, expected more; fit it again")
    if not QUANTILE <= row.alone < 1.0:
        raise ValueError(
            f"calibration {file}: found alone {row.alone} of {row.group}, expected {QUANTILE} to 1; fit it again"
        )
    by_knot = {name: arrays.pop(name).T for name in ("scale", "lag", "floor", "factor")}
    return Table(row.group, row.starts, row.flights, **by_knot, **arrays, held_out=row.held_out, alone=row.alone)


@lru_cache(maxsize=8)
def load(folder: Path = _HERE) -> Tables:
    """Read every file of tables in a folder; later names override, invalid files are skipped and reported."""
    found: dict[str, Table] = {}
    said = []
    for path in sorted(folder.glob("*.json")):
        try:
            found.update(read_tables(path).by_group)
        except ValueError as error:
            said.append(str(error))
    return Tables(found, " ".join(said))


def write(path: Path, tables: Sequence[Table], sources: Sequence[Source], made: str, command: str) -> None:
    """Write tables with their sources."""
    sheet = Sheet(FORMAT, made, command, tuple(sources), KNOTS.tolist(), tuple(map(_row, tables)))
    text = msgspec.json.format(msgspec.json.encode(sheet), indent=1).decode()
    path.write_text(_INNERMOST.sub(lambda found: " ".join(found[0].split()), text) + "\n")


def _row(table: Table) -> Row:
    parts = table.scale.T, table.lag.T, table.floor.T, table.factor.T, table.scores, table.risks
    scale, lag, floor, factor, scores, risks = map(_short, parts)
    measured = {name: round(value, 4) for name, value in table.held_out.items() if np.isfinite(value)}
    return Row(
        table.group,
        table.starts,
        table.flights,
        scale,
        lag,
        floor,
        factor,
        scores,
        risks,
        measured,
        round(table.alone, 4),
    )


def _short(values: np.ndarray) -> list:
    return np.vectorize(lambda x: float(f"{x:.4g}"))(values).tolist()
