"""Read the needed variables of a MATLAB file (version 5 to 7) in bounded memory.

scipy reads the values; before that the element tags are walked, because a small file may declare or decompress to
arrays of any size. Source: MathWorks, "MAT-File Format", version 5.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from typing import IO, Any

import numpy as np

from fleet.telemetry.onboard_logs.columns.column_map import ColumnMap
from fleet.telemetry.onboard_logs.columns.text_tables import MAX_VALUES, Table

_MAX_FILE = 1 << 26  # maximum size of a file [bytes]
_MAX_UNPACKED = 1 << 27  # maximum size with all elements decompressed [bytes]
_MAX_RATIO, _MIN_UNPACKED = 12, 1 << 24  # maximum compression ratio, and what is allowed to any file [bytes]
_HEADER = 128
_COMPRESSED, _MATRIX = 15, 14  # miCOMPRESSED, miMATRIX
_CELL, _STRUCT, _OBJECT = 1, 2, 3  # array classes whose elements are matrices
_MAX_ELEMENTS = 10_000  # maximum elements of a cell or structure array
_MAX_DEPTH = 8
_HDF5 = b"\x89HDF"


def read_matlab(stream: IO[bytes], column_map: ColumnMap, skipped: list[str]) -> dict[str, Table]:
    """Read the variables that the map names, as tables.

    A column is a variable, or a field of a structure: `variable` of the table, then the name, joined by dots.

    Raises:
        ValueError: if it is no MATLAB file, or larger than allowed; the message has the reason.
    """
    data = stream.read(_MAX_FILE + 1) or b""
    if len(data) > _MAX_FILE:
        raise ValueError(f"found over {_MAX_FILE >> 20} MiB, expected a flight in a MATLAB file; split it")
    if data.startswith(_HDF5) or b"MATLAB 7.3" in data[:_HEADER]:
        raise ValueError("found a MATLAB 7.3 file (HDF5), expected version 5 to 7; save it with -v7")
    _check(data)
    from scipy.io import loadmat  # deferred import: few recordings are MATLAB files

    try:
        variables = loadmat(io.BytesIO(data), squeeze_me=True, struct_as_record=False, mat_dtype=True)
    except Exception as error:  # the format has no end of invalid contents; a reader must never raise another error
        raise ValueError(f"found an invalid MATLAB file ({type(error).__name__}: {error}); save it again") from None
    tables: dict[str, Table] = {}
    for name, spec in column_map.tables.items():
        columns = {
            column: values
            for column in column_map.needed(name)
            if (values := _column(variables, ".".join(filter(None, (spec.variable, column))))) is not None
        }
        if spec.time not in columns:
            skipped.append(f"found no variable {spec.variable}.{spec.time}, expected the time of table {name!r}")
            continue
        n = len(columns[spec.time])
        wrong = [column for column, values in columns.items() if len(values) != n]
        skipped += [f"{column}: found {len(columns[column])} values, expected {n} as in its time" for column in wrong]
        tables[name] = Table({column: values for column, values in columns.items() if column not in wrong}, {})
    if sum(len(values) for table in tables.values() for values in table.numbers.values()) > MAX_VALUES:
        raise ValueError(f"found over {MAX_VALUES:,} numbers, expected one flight; split it")
    return tables


def _column(variables: dict[str, Any], name: str) -> np.ndarray | None:
    """Return a variable by its dotted name as numbers, (n,); a trailing (k) selects a column from 1."""
    name, _, index = name.rstrip(")").partition("(")
    value: Any = variables
    for part in name.split("."):
        value = value.get(part) if isinstance(value, dict) else getattr(value, part, None)
        if value is None or part.startswith("_"):
            return None
    values = np.asarray(value)
    if values.dtype.kind not in "fiub" or values.ndim not in (1, 2):
        return None
    if index:
        if not index.isdecimal() or values.ndim != 2 or not 1 <= int(index) <= min(values.shape):
            return None
        values = values[:, int(index) - 1] if values.shape[0] >= values.shape[1] else values[int(index) - 1]
    return values.astype(float).ravel() if values.ndim == 1 else None


def _check(data: bytes) -> None:
    """Verify the sizes of all elements.

    Raises:
        ValueError: if the file is not of version 5, or larger than allowed.
    """
    if len(data) < _HEADER or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("found no header of a MATLAB file, expected version 5 to 7; save it with -v7")
    order = "<" if data[126:128] == b"IM" else ">"
    allowed = min(max(_MIN_UNPACKED, _MAX_RATIO * len(data)), _MAX_UNPACKED)
    for kind, body in _elements(data, _HEADER, order):
        if kind == _COMPRESSED:
            try:
                unpacked = zlib.decompressobj().decompress(bytes(body), allowed + 1)
            except zlib.error as error:
                raise ValueError(f"found damaged data ({error}), expected a MATLAB file; copy it again") from None
            allowed -= len(unpacked)
            if allowed < 0:
                raise ValueError("found data that decompress to far more than a flight has; decompress a trusted file")
            for inner, inner_body in _elements(unpacked, 0, order):
                _check_matrix(inner, inner_body, order, 0)
        else:
            _check_matrix(kind, body, order, 0)


def _elements(data: bytes | memoryview, at: int, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield the elements of a sequence: type, data."""
    view = memoryview(data)
    while at + 8 <= len(view):
        kind, size = struct.unpack_from(order + "II", view, at)
        if kind >> 16:  # small element: size and type share four bytes
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            at += 8
        else:
            begin = at + 8
            at = begin + size + (0 if kind == _COMPRESSED else -size % 8)
        if begin + size > len(view):
            raise ValueError(f"found an element of {size:,} bytes that is truncated, expected all of it; copy it again")
        yield kind, view[begin : begin + size]


def _check_matrix(kind: int, body: memoryview, order: str, depth: int) -> None:
    if kind != _MATRIX or not len(body):
        return
    if depth > _MAX_DEPTH:
        raise ValueError(f"found structures nested over {_MAX_DEPTH} deep, expected a flight; simplify the variables")
    parts = list(_elements(body, 0, order))
    if len(parts) < 2 or len(parts[0][1]) < 8:
        raise ValueError("found a variable without dimensions, expected a MATLAB file; save it again")
    dims = np.frombuffer(parts[1][1][: len(parts[1][1]) // 4 * 4], order + "i4").astype(float)
    count, array_class = float(np.prod(dims)), parts[0][1][0 if order == "<" else 3]
    limit = _MAX_ELEMENTS if array_class in (_CELL, _STRUCT, _OBJECT) else 2 * MAX_VALUES
    if not 0 <= count <= limit or (dims < 0).any():
        raise ValueError(
            f"found a variable of {count:,.0f} elements, expected {limit:,} at most; save the flight alone"
        )
    for inner, inner_body in parts[2:]:
        _check_matrix(inner, inner_body, order, depth + 1)
