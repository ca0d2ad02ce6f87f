"""Figures of a diagnosis: location on the path, residuals, measured against simulated force, candidates."""

import io
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from fleet.report.ink import INK, MUTED
from fleet.report.report_text import plain
from twin_worker.diagnosis.inference.report import Outcome, Report
from twin_worker.diagnosis.output.marks import LEGEND, SAID, empty, marks, span, times
from twin_worker.diagnosis.output.traces import residuals, simulated
from twin_worker.diagnosis.output.written import safe
from twin_worker.numerics.plot_style import house

KINDS = ("path", "residuals", "simulated", "candidates")
_LETTERS = 50  # letters of a flight name in a file name, which is limited to 255 bytes
_TITLE = 40  # letters of a flight name in a title
_BARS = 12  # candidates in the figure
_FEWEST = 4  # least number of rows, so that a single bar stays thin
_RIVAL: Any = {"facecolor": "white", "edgecolor": INK, "hatch": "////", "lw": 0.8}
_OTHER: Any = {"color": MUTED, "alpha": 0.45}
_SMALL: Any = {"fontsize": 8, "color": INK, "va": "center"}
_DPI = 110  # figures are about as wide as a page
_INKS = 96  # a palette reduces the file size to a third; a page contains four figures per flight


def draw(report: Report, folder: Path, stem: str = "") -> list[Path]:
    """Draw the figures of one flight into a folder; return the files, in the order of `KINDS`.

    Args:
        report: of the flight
        folder: created if missing
        stem: start of the file names; default: from the flight name
    """
    folder.mkdir(parents=True, exist_ok=True)
    stem = stem or stems([report.flight])[0]
    name = plain(report.flight)
    shown = replace(report, flight=name if len(name) <= _TITLE else name[: _TITLE - 2] + " …")
    made = [folder / f"{stem}-{kind}.png" for kind in KINDS]
    with matplotlib.rc_context({"text.parse_math": False}), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a letter without a glyph becomes a box
        for path, picture in zip(made, (_path, residuals, simulated, _candidates), strict=True):
            _save(picture(shown), path)
    return made


def _save(figure: Figure, path: Path) -> None:
    """Save a figure as a PNG with a reduced palette."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=_DPI)
    with Image.open(drawn) as picture:
        picture.convert("RGB").quantize(_INKS, dither=Image.Dither.NONE).save(path, optimize=True)


def stems(flights: Sequence[str]) -> list[str]:
    """Return a unique, safe file stem for every flight."""
    out: list[str] = []
    for flight in flights:
        found, number = safe(flight)[:_LETTERS], 1
        while found in out:
            number += 1
            found = f"{safe(flight)[:_LETTERS]}-{number}"
        out.append(found)
    return out


def _path(report: Report) -> Figure:
    """Draw the path from above and the height over time, located segments in colour."""
    series = report.series
    figure = Figure(figsize=(11, 5.4), layout="constrained")
    above, height = figure.subplots(1, 2, width_ratios=(1.15, 1))
    north, east, up = series.place.T
    known = np.isfinite(series.place).all(axis=1)
    for ax, x, y in ((above, east, north), (height, series.t, up)):
        ax.plot(x, y, color=MUTED, lw=1.0, label="flown" if ax is above else None)
        _located(ax, report, x, y)
        if known.any():
            first = int(np.argmax(known))
            label = "start" if ax is above else None
            ax.plot(x[first], y[first], "o", color=INK, mfc="white", ms=7, zorder=6, clip_on=False, label=label)
        else:
            empty(ax, "no position")
    above.set_aspect("equal", adjustable="datalim")
    height.set_xlim(*span(series))
    for ax, words in ((above, ("east [m]", "north [m]")), (height, ("time [s]", "height [m]"))):
        ax.set_xlabel(words[0], fontsize=9, color=INK)
        ax.set_ylabel(words[1], fontsize=9, color=INK)
    house(above, "from above")
    house(height, "height over time")
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3, **LEGEND)
    figure.suptitle(f"{report.flight}: {SAID[report.outcome]}", fontsize=10, color=INK)
    return figure


def _located(ax: Any, report: Report, x: np.ndarray, y: np.ndarray) -> None:
    """Draw the located segments in colour; where they overlap, longer ones are wider and below."""
    t = report.series.t
    found = sorted(marks(report), key=lambda mark: -int(mark.rows(t).sum()))
    for k, mark in enumerate(found):
        rows = mark.rows(t)
        width = 2.4 + 2.4 * (len(found) - 1 - k)
        label = f"{mark.name}: {times(mark.segments)}"
        ax.plot(np.where(rows, x, np.nan), np.where(rows, y, np.nan), color=mark.colour, lw=width, label=label)


def _candidates(report: Report) -> Figure:
    """Draw the gain of every candidate: selected ones in colour, inseparable ones hatched."""
    tried = sorted(report.tried, key=lambda one: -one.gain)[:_BARS]
    figure = Figure(figsize=(11, 0.3 * max(len(tried), _FEWEST) + 1.5), layout="constrained")
    ax = figure.subplots()
    chosen = {one.guess.label: mark.colour for one, mark in zip(report.findings, marks(report), strict=False)}
    rivals = {name for one in report.findings for name in one.rivals}
    proven = "confirmed" if report.outcome is Outcome.NAMED else "not confirmed"
    key: dict[str, Patch] = {}
    for place, one in enumerate(tried):
        words, looks = "others", _OTHER
        if one.label in chosen:  # the best onset of its label; further ones have other onsets
            words, looks = f"selected, {proven}: {one.label}", {"color": chosen.pop(one.label)}
        elif one.label.split(":")[0] in rivals:
            words, looks = "not separable from it", _RIVAL
        key[words] = Patch(**looks, label=words)
        ax.barh(place, max(one.gain, 0.0), height=0.68, **looks)
        ax.annotate(f"{one.gain:,.0f}", (max(one.gain, 0.0), place), (4, 0), textcoords="offset points", **_SMALL)
    ax.set_yticks(range(len(tried)), [f"{one.label}  {one.since}".strip() for one in tried])
    ax.margins(x=0.1)
    ax.set_ylim(max(len(tried), _FEWEST) - 0.4, -0.6)
    ax.set_axisbelow(True)
    ax.set_xlabel("gain: drop of the whitened sum of squares", fontsize=9, color=INK)
    how_many = f", the best {len(tried)} of {len(report.tried)}" if tried else ""
    house(ax, f"{report.flight}: candidates{how_many}")
    ax.tick_params(axis="y", labelsize=8, labelcolor=INK, length=0)
    ax.grid(visible=False, axis="y")
    if tried:
        figure.legend(handles=list(key.values()), loc="outside lower center", ncols=4, **LEGEND)
    else:
        empty(ax, "no candidate with a significant gain")
        ax.set(xticks=[], xlabel="")
    return figure
