"""Calibration tables on disk, by group of flights: JSON with source flights, date and command."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np

from twin_worker.confidence.calibration_table import ATOMS, KNOTS, CalibrationTable, default_table
from twin_worker.numerics.prediction_errors import NOMINAL_COVERAGE

ANY = "*"
INCOMPLETE = "incomplete"
UNCONFIRMED = "unconfirmed"
_FAMILY = dict.fromkeys(("hybrid", "both", "dynamics"), "route")  # selected in flight; they share one ensemble
_FAST_SPEED = 40.0  # usual speed above which a fixed wing forms a class of its own: well above small ones [m/s]


def group_name(method: str, law: str, airframe: str, parameters: str) -> str:
    """Return the group name of a prediction, e.g. hybrid/arduplane/fixed_wing/known.

    Args:
        method: as in `Prediction`
        law: controller twin, e.g. arduplane: L1 + TECS; only the part before the colon is used
        airframe: class of aircraft, from `airframe_class`
        parameters: known, identified or absent; `INCOMPLETE` where mission items are missing; `UNCONFIRMED` where they
            are known and the past flight does not follow the law
    """
    parts = (method, law.partition(":")[0], airframe, parameters)
    return "/".join(part.strip().replace("/", " ") or "none" for part in parts)


def airframe_class(vehicle: str, speed: float) -> str:
    """Return the class of an aircraft by vehicle type and usual speed [m/s], e.g. fixed_wing_fast."""
    return f"{vehicle}_fast" if vehicle == "fixed_wing" and speed > _FAST_SPEED else vehicle


def group_chain(group: str) -> tuple[str, ...]:
    """Return a group and its parent groups, narrowest first: any method of its family, airframe, parameters, law.

    The airframe is dropped first and the law last: they affect errors least and most.
    """
    method, *rest = [*group.split("/"), *[ANY] * 4][:4]
    family = [_FAMILY.get(method, method), *rest]
    field_sets = ((0, 1, 2, 3), (0, 1, 3), (0, 1), (0,))
    chain = ["/".join(part if i in fields else ANY for i, part in enumerate(family)) for fields in field_sets]
    return tuple(dict.fromkeys(["/".join([method, *rest]), *chain]))


def group_setting(group: str) -> str:
    """Return the group name without the method: law / airframe / parameters."""
    return group.partition("/")[2]


FORMAT = 2
UNCALIBRATED = "not calibrated"  # begins the sentence of a prediction without a calibrated table
_FOLDER = Path(__file__).parent
_INNERMOST = re.compile(r"\[[^\[\]{}]*\]")  # innermost lists: one per line
_MAX_VALUE = 1e6  # larger numbers are invalid


class TableSource(msgspec.Struct, frozen=True):
    """One file of predictions that tables were fitted on."""

    file: str
    starts: int
    flights: tuple[str, ...]


class TableFile(msgspec.Struct, frozen=True):
    """A file of tables."""

    format: int
    made: str
    command: str
    sources: tuple[TableSource, ...]
    knots_s: list[float]
    tables: tuple[CalibrationTable, ...]


class TableSet:
    """All tables by group, and the errors of the files."""

    def __init__(self, by_group: dict[str, CalibrationTable], sentence: str = "") -> None:
        self.by_group, self.sentence = by_group, sentence

    def choose(self, group: str) -> tuple[CalibrationTable, str]:
        """Return the narrowest table for a group, and a description of it."""
        method = group.partition("/")[0]
        if group.endswith(f"/{INCOMPLETE}"):  # every table is fitted to flights whose route is known
            return default_table("greybox"), f"{UNCALIBRATED}: mission items are missing, the default is used"
        for name in group_chain(group):
            if (table := self.by_group.get(name)) is not None:
                fallback = "" if name == group else f", none for {group}"
                return table, f"calibrated on {table.starts} predictions of {table.flights} flights ({name}{fallback})"
        description = f"{UNCALIBRATED}: no table for {group}, the default for {method} is used"
        return default_table(method), " ".join(filter(None, (description, self.sentence)))


def read_tables(path: Path) -> TableSet:
    """Read a file of tables.

    Raises:
        ValueError: when it is invalid; the message names the remedy.
    """
    try:
        content = msgspec.json.decode(path.read_bytes(), type=TableFile, dec_hook=_array)
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"calibration {path.name}: found no tables ({error}); fit it again") from None
    if content.format != FORMAT or content.knots_s != KNOTS.tolist():
        raise ValueError(f"calibration {path.name}: found format {content.format}, expected {FORMAT}; fit it again")
    for table in content.tables:
        _check(path.name, table)
    return TableSet({table.group: table for table in content.tables})


def _array(_: type, values: list) -> np.ndarray:
    """Return an array of a table from its values by axis, then knot."""
    return np.array(values, float).T


def _check(file: str, table: CalibrationTable) -> None:
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("scale", "lag", "turn", "floor", "factor"), (len(KNOTS), 3))
    shapes |= dict.fromkeys(("scores", "risks"), (ATOMS,))
    for name, shape in shapes.items():
        array = getattr(table, name)
        if array.shape != shape or not ((array >= 0) & (array < _MAX_VALUE)).all():
            raise ValueError(
                f"calibration {file}: found {name} of {table.group} of shape {array.T.shape}, "
                f"expected {shape[::-1]}, finite, not negative; fit it again"
            )
    if not ((table.factor > 0).all() and (table.scores > 0).all() and (table.floor > 0).all()):
        raise ValueError(f"calibration {file}: found a zero width for {table.group}, expected more; fit it again")
    if not NOMINAL_COVERAGE <= table.alone < 1.0:
        raise ValueError(
            f"calibration {file}: found alone {table.alone} of {table.group}, expected {NOMINAL_COVERAGE} "
            "to 1; fit it again"
        )


@lru_cache(maxsize=8)
def load(folder: Path = _FOLDER) -> TableSet:
    """Read every file of tables in a folder; later names override, invalid files are skipped and reported."""
    tables: dict[str, CalibrationTable] = {}
    errors = []
    for path in sorted(folder.glob("*.json")):
        try:
            tables.update(read_tables(path).by_group)
        except ValueError as error:
            errors.append(str(error))
    return TableSet(tables, " ".join(errors))


def write(
    path: Path, tables: Sequence[CalibrationTable], sources: Sequence[TableSource], date: str, command: str
) -> None:
    """Write tables with their sources."""
    rounded = [
        replace(
            table,
            held_out={name: round(value, 4) for name, value in table.held_out.items() if np.isfinite(value)},
            alone=round(table.alone, 4),
            log_score=_rounded(table.log_score),
        )
        for table in tables
    ]
    content = TableFile(FORMAT, date, command, tuple(sources), KNOTS.tolist(), tuple(rounded))
    text = msgspec.json.format(msgspec.json.encode(content, enc_hook=_four_digits), indent=1).decode()
    path.write_text(_INNERMOST.sub(lambda match: " ".join(match[0].split()), text) + "\n")


def _rounded(scores: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    return None if scores is None else (round(scores[0], 4), round(scores[1], 4), round(scores[2], 4))


def _four_digits(values: np.ndarray) -> list:
    """Return the values of a table by axis, then knot, with four digits."""
    return np.vectorize(lambda x: float(f"{x:.4g}"))(values.T).tolist()
