"""Colours and lines of the report, matching the light theme of the viewer; and its HTML page."""

from collections.abc import Iterable
from html import escape
from pathlib import Path

import numpy as np

from fleet.process.sanitise import printable

INK, MUTED, GRID = "#17212E", "#64748B", "#E2E8EF"
ROUTE, BAD, GOOD = "#7A6BB8", "#B93A00", "#00795A"
LINES = ("#0072B2", "#B93A00", "#00795A", "#A67C00", "#6A2C7A", "#56B4E9", "#334155", "#D55E9B")
_MODES = {
    "AUTO": "#0072B2",
    "MISSION": "#0072B2",
    "AUTO.MISSION": "#0072B2",
    "GUIDED": "#6A2C7A",
    "OFFBOARD": "#6A2C7A",
    "RTL": "#B93A00",
    "AUTO.RTL": "#B93A00",
    "QRTL": "#B93A00",
    "MANUAL": "#6B7280",
    "LOITER": "#00795A",
    "AUTO.LOITER": "#00795A",
    "FBWA": "#A67C00",
    "STABILIZE": "#A67C00",
}
_EXTRA_COLOURS = ("#56B4E9", "#D55E9B", "#2BC49A", "#8C6D46", "#334155", "#9A8FD0")
_MAX_POINTS = 3_000  # points of one line; more are not visible


def mode_colours(modes: Iterable[str]) -> dict[str, str]:
    """Return a colour for every mode; common modes have the same colour on every page."""
    names = list(dict.fromkeys(modes))
    free = [name for name in names if name not in _MODES]
    return {name: _MODES.get(name) or _EXTRA_COLOURS[free.index(name) % len(_EXTRA_COLOURS)] for name in names}


def downsample(t: np.ndarray, y: np.ndarray, max_interval: float) -> tuple[np.ndarray, np.ndarray]:
    """Downsample a line, keep its extremes, and insert NaN where an interval exceeds `max_interval`.

    Args:
        t: times, (n,) [s]
        y: values, (n,)
        max_interval: longest interval joined by a line [s]
    """
    if len(t) > _MAX_POINTS:
        parts = np.array_split(np.arange(len(t)), _MAX_POINTS // 2)
        extremes = np.sort(np.concatenate([[p[np.argmin(y[p])], p[np.argmax(y[p])]] for p in parts]))
        max_interval = max(max_interval, 2.5 * (t[-1] - t[0]) / len(parts))
        t, y = t[extremes], y[extremes]
    after = np.flatnonzero(np.diff(t) > max_interval) + 1
    return np.insert(t, after, t[after] if len(after) else []), np.insert(np.asarray(y, float), after, np.nan)


def axis_limits(values: np.ndarray, margin: float = 0.08, min_range: float = 1.0) -> tuple[float, float]:
    """Return axis limits that contain all values with a margin."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    padding = max(margin * (high - low), 0.5 * min_range)
    return low - padding, high + padding


_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"  # no external resources, no scripts
_COLOURS = {"ink": INK, "muted": MUTED, "line": GRID, "good": GOOD, "bad": BAD, "doubt": LINES[3], "odd": ROUTE}


def document(title: str, body: str) -> str:
    """Return a page in the project style; `title` is text, `body` is HTML."""
    colours = "".join(f"--{name}:{colour};" for name, colour in _COLOURS.items())
    style = f":root{{{colours}}}\n" + Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
    )
    head += f"<title>{escape_text(title)}</title>\n<style>{style}</style>"
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body><main>\n{body}\n</main></body></html>\n'


def escape_text(text: str) -> str:
    """Escape untrusted text, such as a file name."""
    return escape(printable(text))
