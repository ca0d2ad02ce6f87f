"""Read parameter files of ground stations.

Lines are `NAME,VALUE` or `NAME VALUE` (Mission Planner, MAVProxy) or `system component NAME VALUE type`
(QGroundControl); `#` starts a comment. Source: QGroundControl user guide, "Parameter File Format".
"""

import re
from math import isfinite
from pathlib import Path

from fleet.telemetry.mavlink.microservices.params import MAX_PARAMS

_MAX_BYTES = 1 << 20
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,31}")
_QGC_COLUMNS = 5


def read_parameters(path: Path) -> dict[str, float]:
    """Read a parameter file.

    Raises:
        ValueError: if it is not a parameter file, or a line is invalid; the message names the line.
        OSError: if it cannot be read.
    """
    with path.open("rb") as file:
        text = file.read(_MAX_BYTES + 1).decode(errors="replace").removeprefix("\ufeff")
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    values = dict(_parameter(path.name, number, line) for number, line in enumerate(lines, start=1) if line)
    if not 0 < len(values) <= MAX_PARAMS:
        raise ValueError(
            f"{path.name}: found {len(values):,} parameters, expected 1 to {MAX_PARAMS:,}; name a parameter file"
        )
    return values


def _parameter(name: str, number: int, line: str) -> tuple[str, float]:
    columns = line.replace(",", " ").split()
    if len(columns) == _QGC_COLUMNS:
        columns = columns[2:4]
    try:
        key, value = columns[0], float(columns[1])
    except (IndexError, ValueError):
        key, value = "", 0.0
    if not _NAME.fullmatch(key) or not isfinite(value):
        raise ValueError(
            f"{name} line {number}: found {line[:60]!r}, expected a name and a number; save the parameters again"
        )
    return key, value
