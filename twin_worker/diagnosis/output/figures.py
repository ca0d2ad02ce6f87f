"""Figures of a diagnosis: location on the path, residuals, measured against simulated force, candidates."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from fleet.report.ink import INK, MUTED
from fleet.report.report_text import printable
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.output.keep import safe
from twin_worker.diagnosis.output.traces import (
    OUTCOME_TEXT,
    format_segments,
    marks,
    residuals,
    show_empty,
    simulated,
    time_limits,
)
from twin_worker.numerics.plot_style import style_axes

KINDS = ("path", "residuals", "simulated", "candidates")
_MAX_STEM = 50  # letters of a flight name in a file name, which is limited to 255 bytes
_MAX_TITLE = 40  # letters of a flight name in a title
_MAX_CANDIDATES = 12  # candidates in the figure
_MIN_CANDIDATES = 4  # least number of rows, so that a single bar stays thin
_STYLE: Any = {  # of all figures
    "figure.constrained_layout.use": True,
    "axes.labelsize": 9,
    "axes.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.labelcolor": INK,
    "text.parse_math": False,
}
_RIVAL: Any = {"facecolor": "white", "edgecolor": INK, "hatch": "////", "lw": 0.8}
_OTHER: Any = {"color": MUTED, "alpha": 0.45}
_SMALL: Any = {"fontsize": 8, "color": INK, "va": "center"}
_DPI = 110  # figures are about as wide as a page
_N_COLOURS = 96  # a palette reduces the file size to a third; a page contains four figures per flight


def draw(report: Report, folder: Path, stem: str = "") -> list[Path]:
    """Draw the figures of one flight into a folder; return the files, in the order of `KINDS`.

    Args:
        report: of the flight
        folder: created if missing
        stem: start of the file names; default: from the flight name
    """
    folder.mkdir(parents=True, exist_ok=True)
    stem = stem or stems([report.flight])[0]
    name = printable(report.flight)
    shown = replace(report, flight=name if len(name) <= _MAX_TITLE else name[: _MAX_TITLE - 2] + " …")
    paths = [folder / f"{stem}-{kind}.png" for kind in KINDS]
    with matplotlib.rc_context(_STYLE), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a letter without a glyph becomes a box
        for path, draw_figure in zip(paths, (_path, residuals, simulated, _candidates), strict=True):
            picture = _rendered(draw_figure(shown))
            picture.quantize(_N_COLOURS, dither=Image.Dither.NONE).save(path)
    return paths


def _rendered(figure: Figure) -> Image.Image:
    """Render a figure once; `Figure.savefig` lays it out and draws it twice."""
    figure.set_dpi(_DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def stems(flights: Sequence[str]) -> list[str]:
    """Return a unique, safe file stem for every flight."""
    out: list[str] = []
    for flight in flights:
        stem, number = safe(flight)[:_MAX_STEM], 1
        while stem in out:
            number += 1
            stem = f"{safe(flight)[:_MAX_STEM]}-{number}"
        out.append(stem)
    return out


def _path(report: Report) -> Figure:
    """Draw the path from above and the height over time, located segments in colour."""
    series = report.series
    figure = Figure(figsize=(11, 5.4))
    above, height = figure.subplots(1, 2, width_ratios=(1.15, 1))
    north, east, up = series.position.T
    valid = np.isfinite(series.position).all(axis=1)
    for ax, x, y in ((above, east, north), (height, series.t, up)):
        ax.plot(x, y, color=MUTED, lw=1.0, label="flown" if ax is above else None)
        _draw_located(ax, report, x, y)
        if valid.any():
            first = int(np.argmax(valid))
            label = "start" if ax is above else None
            ax.plot(x[first], y[first], "o", color=INK, mfc="white", ms=7, zorder=6, clip_on=False, label=label)
        else:
            show_empty(ax, "no position")
    above.set_aspect("equal", adjustable="datalim")
    height.set_xlim(*time_limits(series))
    above.set(xlabel="east [m]", ylabel="north [m]")
    height.set(xlabel="time [s]", ylabel="height [m]")
    style_axes(above, "from above")
    style_axes(height, "height over time")
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(f"{report.flight}: {OUTCOME_TEXT[report.outcome]}", fontsize=10, color=INK)
    return figure


def _draw_located(ax: Any, report: Report, x: np.ndarray, y: np.ndarray) -> None:
    """Draw the located segments in colour; where they overlap, longer ones are wider and below."""
    t = report.series.t
    ordered = sorted(marks(report), key=lambda mark: -int(mark.mask(t).sum()))
    for k, mark in enumerate(ordered):
        mask = mark.mask(t)
        width = 2.4 + 2.4 * (len(ordered) - 1 - k)
        label = f"{mark.name}: {format_segments(mark.segments)}"
        ax.plot(np.where(mask, x, np.nan), np.where(mask, y, np.nan), color=mark.colour, lw=width, label=label)


def _candidates(report: Report) -> Figure:
    """Draw the gain of every candidate: selected ones in colour, inseparable ones hatched."""
    ranked = sorted(report.ranking, key=lambda candidate: -candidate.gain)[:_MAX_CANDIDATES]
    figure = Figure(figsize=(11, 0.3 * max(len(ranked), _MIN_CANDIDATES) + 1.5))
    ax = figure.subplots()
    chosen = {
        finding.hypothesis.label: mark.colour for finding, mark in zip(report.findings, marks(report), strict=False)
    }
    rivals = {name for finding in report.findings for name in finding.rivals}
    proven = "confirmed" if report.outcome is ReportOutcome.NAMED else "not confirmed"
    legend: dict[str, Patch] = {}
    for row, candidate in enumerate(ranked):
        label, style = "others", _OTHER
        if candidate.label in chosen:  # the best onset of its label; further ones have other onsets
            label, style = f"selected, {proven}: {candidate.label}", {"color": chosen.pop(candidate.label)}
        elif candidate.label.split(":")[0] in rivals:
            label, style = "not separable from it", _RIVAL
        legend[label] = Patch(**style, label=label)
        ax.barh(row, max(candidate.gain, 0.0), height=0.68, **style)
        ax.annotate(
            f"{candidate.gain:,.0f}", (max(candidate.gain, 0.0), row), (4, 0), textcoords="offset points", **_SMALL
        )
    ax.set_yticks(range(len(ranked)), [f"{candidate.label}  {candidate.onset}".strip() for candidate in ranked])
    ax.margins(x=0.1)
    ax.set_ylim(max(len(ranked), _MIN_CANDIDATES) - 0.4, -0.6)
    ax.set_axisbelow(True)
    ax.set_xlabel("gain: drop of the whitened sum of squares")
    count_text = f", the best {len(ranked)} of {len(report.ranking)}" if ranked else ""
    style_axes(ax, f"{report.flight}: candidates{count_text}")
    ax.tick_params(axis="y", labelsize=8, labelcolor=INK, length=0)
    ax.grid(visible=False, axis="y")
    if ranked:
        figure.legend(handles=list(legend.values()), loc="outside lower center", ncols=4)
    else:
        show_empty(ax, "no candidate with a significant gain")
        ax.set(xticks=[], xlabel="")
    return figure
