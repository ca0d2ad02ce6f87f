"""The measured flights in words: one line a flight, and their medians."""

from collections.abc import Iterator
from statistics import median
from typing import Any

from .flown import AHEAD_S

Row = dict[str, Any]


def line(row: Row) -> str:
    """Say how soon a fault was found and what that was worth."""
    if row["named_s"] is None:
        flagged = "never" if row["flagged_s"] is None else f"after {row['flagged_s']:.0f} s"
        return f"seed {row['seed']}: flagged {flagged}, not named"
    names = " and ".join(" of the ".join(filter(None, one[:2])) for one in row["named"])
    found = f"flagged after {row['flagged_s']:.0f} s, named after {row['named_s']:.0f} s: {names} ({row['verdict']})"
    used = "predicts with it" if row["adapted"] else "predicts with the model as learnt"
    return f"seed {row['seed']}: {found}, {used}; {_errors(row['error_m'])}"


def summary(rows: list[Row]) -> Iterator[str]:
    """Say the medians of each fault over the flights it was named on, and on how many errors fell."""
    for fault in dict.fromkeys(row["fault"] for row in rows):
        tried = [row for row in rows if row["fault"] == fault]
        named = [row for row in tried if row["named_s"] is not None]
        yield f"{fault}: named on {len(named)} of {len(tried)} flights, {_count(named, 'verdict')}"
        if named:
            times = [median(row[which] for row in named) for which in ("flagged_s", "named_s")]
            error = {which: _medians(named, which) for which in named[0]["error_m"]}
            yield f"  median: flagged after {times[0]:.0f} s, named after {times[1]:.0f} s; {_errors(error)}"
            yield f"  nearer than before the name: {_nearer(named, 'before')}; than beside: {_nearer(named, 'beside')}"


def _errors(error: dict[str, dict[int, float]]) -> str:
    said = []
    for ahead in AHEAD_S:
        before, after, beside = (f"{error[which].get(ahead, float('nan')):.1f}" for which in error)
        said.append(f"{ahead} s ahead {before} → {after} m ({beside} m beside, not adapting)")
    return ", ".join(said)


def _medians(rows: list[Row], which: str) -> dict[int, float]:
    found = {
        ahead: [row["error_m"][which][ahead] for row in rows if ahead in row["error_m"][which]] for ahead in AHEAD_S
    }
    return {ahead: median(errors) for ahead, errors in found.items() if errors}


def _nearer(rows: list[Row], other: str) -> str:
    said = []
    for ahead in AHEAD_S:
        pairs = [(row["error_m"]["after"].get(ahead), row["error_m"][other].get(ahead)) for row in rows]
        whole = [(a, b) for a, b in pairs if a is not None and b is not None]
        said.append(f"{ahead} s ahead on {sum(a < b for a, b in whole)} of {len(whole)}")
    return ", ".join(said)


def _count(rows: list[Row], key: str) -> str:
    words = [row[key] for row in rows]
    return ", ".join(f"{words.count(word)} {word}" for word in dict.fromkeys(words))
