"""Does memory grow, or fill? Windows and records fill in the first half of a run; what grows goes on growing."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_SHARE, _LEAST_MB = 0.05, 5.0  # growth over the second half that may be chance [-, MB]
_SURE = 3.0  # standard errors from which a slope is one
_LEAST = 8  # rows from which anything is said


class Row(NamedTuple):
    """One process at one time: minutes since the beginning, its age [s], aircraft it holds, memory [MB]."""

    minutes: float
    who: str
    age_s: float
    aircraft: int
    mb: float


def own_mb(pid: int) -> float:
    """Give the memory that is a process's own or shared by processes; not files, as libraries are, that come page by
    page the first time they are used [MB]."""
    found = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if "Rss" in line)
    return sum(int(found[name].split()[0]) for name in ("RssAnon", "RssShmem")) / 1e3


def grown(rows: list[Row], full_min: float, *, by_age: bool = False) -> dict[str, Any]:
    """Fit  mb = a + b minutes + c aircraft (+ d age)  to the second half, and say whether b is growth.

    Args:
        rows: of one process, or of processes that follow each other
        full_min: after which all that is kept for a while is full; nothing before is fitted [min]
        by_age: compare processes at equal age
    Returns:
        what it had and b with its standard error [MB, MB/min]; `grows` is None where the run is too short to tell
    """
    since = max(0.5 * max((row.minutes for row in rows), default=0.0), full_min)
    half = [row for row in rows if row.minutes >= since]
    if len(half) < _LEAST:
        return {"rows": len(rows), "grows": None}
    minutes, mb = np.array([row.minutes for row in half]), np.array([row.mb for row in half])
    columns = [np.ones(len(half)), minutes - minutes.mean(), [row.aircraft for row in half]]
    if by_age:
        columns.append([min(row.age_s, 60.0 * full_min) for row in half])
    A = np.column_stack(columns).astype(float)
    fit, _, rank, _ = np.linalg.lstsq(A, mb, rcond=None)
    variance = float(np.sum((mb - A @ fit) ** 2)) / (len(half) - int(rank))
    sigma = float(np.sqrt(variance * np.linalg.pinv(A.T @ A)[1, 1]))
    more, others = float(fit[1]) * float(np.ptp(minutes)), len({row.aircraft for row in half}) > 1
    return {
        "rows": len(rows), "first_mb": round(rows[0].mb, 1), "half_mb": round(half[0].mb, 1),
        "last_mb": round(rows[-1].mb, 1), "mb_a_minute": round(float(fit[1]), 3), "sigma": round(sigma, 3),
        "grown_mb": round(more, 1), "mb_an_aircraft": round(float(fit[2]), 2) if others else None,
        "grows": bool(fit[1] > _SURE * sigma and more > max(_SHARE * float(mb.mean()), _LEAST_MB)),
    }  # fmt: skip
