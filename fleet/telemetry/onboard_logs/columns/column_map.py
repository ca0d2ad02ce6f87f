"""Column map: which columns of which tables are which `Sample` field, in a TOML file.

    vehicle = "fixed_wing"            # as `Status.vehicle`
    autopilot = "ardupilot"           # ardupilot, px4 or generic
    initial_mode = "AUTO"             # where no table has the mode

    [tables.imu]
    file = "*-imu-data.csv"           # of a folder or archive, * is the name of the flight; `variable` in a .mat
    time = "%time"                    # its column of time
    time_unit = "ns"                  # s, ms, us or ns; values above 1e9 s count from 1970

    [attitude]
    table = "imu"
    columns = ["q.w", "q.x", "q.y", "q.z", "w.x", "w.y", "w.z"]      # "other:column" interpolates another table
    units = ["1", "1", "1", "1", "rad/s", "rad/s", "rad/s"]          # or one for all; "-m/s" reverses the sign
    frame = "enu"                     # ned (with body axes FRD) or enu (with FLU)

`columns/alfa.toml` and `columns/px4.toml` are complete examples.
"""

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fleet import vehicles
from fleet.telemetry.onboard_logs.columns.conversion import FRAMES, TIME_UNITS, UNITS, WIDTHS

_HERE = Path(__file__).parent
_MAX_BYTES = 1 << 20
_AUTOPILOTS = ("ardupilot", "px4", "generic")
_VEHICLES = (vehicles.FIXED_WING, vehicles.MULTIROTOR, vehicles.HELICOPTER, vehicles.QUADPLANE, vehicles.UNKNOWN)
NORMALISED = "normalised"  # unit of a servo output of -1..1
_TABLE_KEYS, _FIELD_KEYS = {"file", "variable", "time", "time_unit"}, {"table", "columns", "units", "frame", "names"}


@dataclass(frozen=True)
class TableSpec:
    """One table: its file or variable, and its time."""

    file: str
    variable: str
    time: str
    time_unit: float  # [s]


@dataclass(frozen=True)
class FieldSpec:
    """One field: a table and column for each component; a number is a constant."""

    table: str
    columns: tuple[tuple[str, str] | float, ...]
    units: tuple[str, ...]
    frame: str
    names: dict[str, str] = field(default_factory=dict)  # mode names by value

    @property
    def factors(self) -> tuple[float, ...]:
        """Return the factor of each component to SI."""
        return tuple(UNITS.get(unit, 1.0) for unit in self.units)


@dataclass(frozen=True)
class ColumnMap:
    """Parsed column map."""

    name: str
    tables: dict[str, TableSpec]
    fields: dict[str, FieldSpec]
    vehicle: str
    autopilot: str
    mode: str

    def needed(self, table: str) -> set[str]:
        """Return the columns that are read of a table."""
        needed = {self.tables[table].time} - {""}
        for spec in self.fields.values():
            needed |= {entry[1] for entry in spec.columns if isinstance(entry, tuple) and entry[0] == table}
        return needed


def read_map(name_or_path: str) -> ColumnMap:
    """Read a column map by path, or by the name of a shipped one.

    Raises:
        ValueError: if it is invalid; the message names the entry.
        OSError: if there is no such file; check the path.
    """
    shipped = sorted(path.stem for path in _HERE.glob("*.toml"))
    path = _HERE / f"{name_or_path}.toml" if name_or_path in shipped else Path(name_or_path)
    if not path.is_file():
        raise OSError(
            f"{name_or_path}: found no column map, expected a TOML file or one of {', '.join(shipped)}; check the path"
        )
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"{path.name}: found {path.stat().st_size:,} bytes, expected a column map; check the path")
    try:
        document = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path.name}: found invalid TOML ({error}), expected a column map; correct it") from None
    return _Parser(path.name).parse(document)


class _Parser:
    """Validate a document entry by entry."""

    def __init__(self, name: str) -> None:
        self._name = name

    def parse(self, document: dict[str, Any]) -> ColumnMap:
        unknown = set(document) - set(WIDTHS) - {"tables", "vehicle", "autopilot", "initial_mode"}
        if unknown:
            raise self._error(
                f"the entry {min(unknown)!r}", f"tables, vehicle, autopilot, initial_mode or {', '.join(WIDTHS)}"
            )
        tables = {name: self._table(name, entry) for name, entry in self._entries(document, "tables").items()}
        fields = {name: self._field(name, self._entries(document, name), tables) for name in WIDTHS if name in document}
        if not fields.keys() & {"attitude", "position", "velocity"}:
            raise self._error("no attitude, position or velocity", "at least one of them")
        vehicle = self._choice(document, "vehicle", _VEHICLES, vehicles.UNKNOWN)
        autopilot = self._choice(document, "autopilot", _AUTOPILOTS, "generic")
        return ColumnMap(self._name, tables, fields, vehicle, autopilot, self._text(document, "initial_mode", ""))

    def _error(self, problem: str, expected: str) -> ValueError:
        return ValueError(f"{self._name}: found {problem}, expected {expected}; correct the column map")

    def _entries(self, document: dict[str, Any], name: str) -> dict[str, Any]:
        entries = document.get(name)
        if not isinstance(entries, dict) or not entries:
            raise self._error(f"{name} = {entries!r:.60}", f"a table [{name}]")
        return entries

    def _choice(self, entries: dict[str, Any], key: str, choices: tuple[str, ...], default: str) -> str:
        value = self._text(entries, key, default)
        if value not in choices:
            raise self._error(f"{key} = {value!r:.60}", f"one of {', '.join(choices)}")
        return value

    def _text(self, entries: dict[str, Any], key: str, default: str) -> str:
        value = entries.get(key, default)
        if not isinstance(value, str) or len(value) > 200:
            raise self._error(f"{key} = {value!r:.60}", "a text")
        return value

    def _table(self, name: str, entry: Any) -> TableSpec:
        if not isinstance(entry, dict) or set(entry) - _TABLE_KEYS:
            raise self._error(f"tables.{name} = {entry!r:.60}", f"a table with {', '.join(sorted(_TABLE_KEYS))}")
        unit = self._choice(entry, "time_unit", tuple(TIME_UNITS), "s")
        time = self._text(entry, "time", "")
        if not time:
            raise self._error(f"tables.{name} without time", "the name of its column of time")
        file = self._text(entry, "file", "")
        if file.count("*") > 1:
            raise self._error(f"tables.{name}.file = {file!r:.60}", "at most one *")
        return TableSpec(file, self._text(entry, "variable", ""), time, TIME_UNITS[unit])

    def _field(self, name: str, entry: dict[str, Any], tables: dict[str, TableSpec]) -> FieldSpec:
        if set(entry) - _FIELD_KEYS:
            raise self._error(f"{name}.{min(set(entry) - _FIELD_KEYS)}", f"one of {', '.join(sorted(_FIELD_KEYS))}")
        table = self._choice(entry, "table", tuple(tables), next(iter(tables)))
        columns = entry.get("columns")
        if not isinstance(columns, list) or len(columns) not in WIDTHS[name]:
            expected = " or ".join(map(str, WIDTHS[name]))
            raise self._error(f"{name}.columns = {columns!r:.60}", f"a list of {expected} columns")
        parsed = tuple(self._column(name, column, table, tables) for column in columns)
        units = entry.get("units", "1")
        units = [units] * len(parsed) if isinstance(units, str) else units
        known = {*UNITS, NORMALISED} if name == "servo" else set(UNITS)
        if not isinstance(units, list) or len(units) != len(parsed) or not all(unit in known for unit in units):
            raise self._error(f"{name}.units = {units!r:.60}", f"one of {', '.join(sorted(known))} for each column")
        names = entry.get("names", {})
        if not isinstance(names, dict) or not all(isinstance(value, str) for value in names.values()):
            raise self._error(f"{name}.names = {names!r:.60}", "a table of texts")
        return FieldSpec(table, parsed, tuple(units), self._choice(entry, "frame", FRAMES, "ned"), names)

    def _column(self, name: str, column: Any, table: str, tables: dict[str, TableSpec]) -> tuple[str, str] | float:
        if isinstance(column, int | float) and not isinstance(column, bool):
            return float(column)
        if not isinstance(column, str) or not column or len(column) > 200:
            raise self._error(f"{name}.columns with {column!r:.60}", "names of columns, or numbers")
        other, colon, rest = column.partition(":")
        return (other, rest) if colon and other in tables else (table, column)
