"""The measured table, for reading."""

from typing import Any

from rich.console import Console
from rich.table import Table

from .score import KEYS

_COMPARED = ("lon40", "lat40", "lon4", "lat4")
_HEADS = {"40": "40 s", "4": "4 s", "1": "1 s", "_step": "1 step"}


def show(scenario: str, found: dict[str, dict[str, Any]], console: Console) -> None:
    """Print one scenario: medians with quartiles, lon and lat, then the paired difference to the best peer."""
    n = max(row["n"] for row in found.values())
    table = Table(title=f"{scenario}: fit [%], median (quartiles) of {n} windows", title_justify="left")
    table.add_column("method", no_wrap=True)
    for key in KEYS:
        table.add_column(f"{key[:3]} {_HEADS[key[3:]]}", justify="right", no_wrap=True)
    for head in ("ms cold", "warm", "failed"):
        table.add_column(head, justify="right", no_wrap=True)
    for method, row in found.items():
        cells = [_cell(row[key], row[f"{key}_quartiles"]) for key in KEYS]
        times = ["" if row[key] is None else f"{row[key]:.3g}" for key in ("ms_cold", "ms_warm")]
        table.add_row(method, *cells, *times, str(row["failed"] or ""))
    console.print(table)
    for method, row in found.items():
        for rival, kind in (("best_peer", "best peer"), ("window_mean", "window mean")):
            if compared := row.get(f"over_{rival}"):
                pairs = "; ".join(_pair(key, compared[key]) for key in _COMPARED)
                console.print(f"  {method} over the {kind}, paired: {pairs}", highlight=False)
        for said in row["trouble"]:
            console.print(f"  {method}: {said}", markup=False)


def _cell(median: float | None, quartiles: list[float | None]) -> str:
    if median is None or None in quartiles:
        return "–"
    return f"{median:.0f} ({quartiles[0]:.0f} {quartiles[1]:.0f})"


def _pair(key: str, found: dict[str, Any]) -> str:
    low, high = found["quartiles"]
    name = "" if found["peer"] == "window_mean" else f" {found['peer']}"
    return f"{key} {found['median']:+.0f} ({low:+.0f} {high:+.0f}){name}"
