"""Printable page for each aircraft of a recording: map, time panels, strips, applicable twin functions."""

import textwrap
import warnings
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from fleet.process.sanitise import plain
from fleet.report import panels
from fleet.report.ground import ground_track
from fleet.report.ink import BAD, GOOD, GRID, INK, MUTED, mode_colours
from fleet.report.report_text import lines
from fleet.telemetry.inspection.findings import Facts, Findings
from fleet.telemetry.inspection.survey import Survey, spells

_A4 = (8.27, 11.69)  # [in]
_DPI = 150
_STYLE: Any = {
    "font.size": 7.5,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.labelsize": 7.5,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.linewidth": 0.6,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "legend.frameon": False,
    "legend.fontsize": 6.5,
    "legend.borderaxespad": 0.1,
    "legend.columnspacing": 1.2,
    "legend.handlelength": 1.4,
    "svg.hashsalt": "parauav",
}
_HEADINGS = ("link", "modes", "mission", "parameters", "servo map", "airspeed", "wind")
_TROUBLE = ("text", "clock", "link", "gap")
_WIDTH = 62  # characters per line of the text beside the map
_MOST_LINES = 3  # lines of one entry
_LEFT = 0.585  # left edge of that text [share of the page width]
_SMALL: Any = {"size": 6.6, "va": "top", "parse_math": False}


class Sheet(NamedTuple):
    """Data of one page: one aircraft of a recording."""

    known: Survey
    told: Findings
    facts: Facts
    name: str  # name of the recording


def write(path: Path, sheets: Sequence[Sheet]) -> list[Path]:
    """Write the pages: one .pdf for all, or one .png or .svg each, named after recording and aircraft if several.

    Returns:
        the files written
    """
    with matplotlib.rc_context(_STYLE), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # missing glyphs are drawn as boxes
        if path.suffix == ".pdf":
            with PdfPages(path) as pdf:
                for sheet in sheets:
                    pdf.savefig(page(sheet))
            return [path]
        made: list[Path] = []
        for sheet in sheets:
            made.append(path if len(sheets) == 1 else _free(path, sheet, made))
            page(sheet).savefig(made[-1], dpi=_DPI)
    return made


def page(sheet: Sheet) -> Figure:
    """Draw one page."""
    known, told = sheet.known, sheet.told
    figure = Figure(figsize=_A4, facecolor="white")
    colours = mode_colours(mode for _, mode in spells(known))
    said = dict(lines(told))
    figure.text(
        0.06, 0.972, plain(f"uav-{told.uav}   {sheet.name}"), size=14, weight="bold", va="top", parse_math=False
    )
    for row, heading in enumerate(("aircraft", "time")):
        words = plain(said[heading]).removeprefix(f"uav-{told.uav}, ")
        figure.text(0.06, 0.951 - 0.0125 * row, words, size=8, color=MUTED, va="top", parse_math=False)
    ground = figure.add_axes((0.095, 0.65, 0.455, 0.255))
    ground_track(ground, known, told, colours)
    ground.legend(loc="upper left", bbox_to_anchor=(0.0, -0.145), ncols=6)
    _facts(figure, told, said)
    _over_time(figure, sheet, colours)
    figure.text(0.94, 0.012, "parauav: fleet inspect", size=6, color=MUTED, ha="right")
    return figure


def _over_time(figure: Figure, sheet: Sheet, colours: dict[str, str]) -> None:
    known, told = sheet.known, sheet.told
    grid = figure.add_gridspec(
        6, 1, left=0.125, right=0.905, top=0.568, bottom=0.05, hspace=0.24, height_ratios=(1, 1, 1.1, 1.2, 0.62, 1.0)
    )
    axes = [figure.add_subplot(grid[0])]
    axes += [figure.add_subplot(grid[row], sharex=axes[0]) for row in range(1, 6)]
    panels.altitude(axes[0], known)
    panels.speeds(axes[1], known)
    panels.angles(axes[2], known)
    panels.servos(axes[3], known, told)
    panels.happenings(axes[4], known, sheet.facts, colours)
    panels.rates(axes[5], known, told)
    for ax in axes[:4]:
        for span, mode in spells(known):
            start = span.start - known.begun
            ax.axvspan(start, start + span.seconds, color=colours[mode], alpha=0.07, lw=0, zorder=0)
    for ax in axes[:-1]:
        ax.tick_params(axis="x", labelbottom=False)
    axes[0].set_xlim(0.0, max(known.newest - known.begun, 1.0))
    axes[-1].set_xlabel("time since start of recording [s]        strip: blue nominal rate, paler lower rate, red gap")
    figure.align_ylabels(axes[:4])


def _facts(figure: Figure, told: Findings, said: dict[str, str]) -> None:
    """Write the recording summary and the applicable twin functions beside the map."""
    y = 0.916
    facts = {heading: said[heading] for heading in _HEADINGS}
    if any(not kind.rows for kind in told.rows.values()):
        facts["no rows of"] = said["no rows of"]
    facts["problems"] = (
        "; ".join(f"{e.t_s:.0f} s {e.text}" for e in told.events if e.kind in _TROUBLE) or "none reported"
    )
    for heading, words in facts.items():
        figure.text(_LEFT, y, heading, color=MUTED, weight="bold", **_SMALL)
        y = _words(figure, y, _LEFT + 0.083, plain(words), _WIDTH - 16)
    y -= 0.007
    figure.text(_LEFT, y, "Applicable twin functions", weight="bold", **_SMALL)
    y -= 0.0125
    for why, same in groupby(told.abilities, key=lambda can: (can.can, can.why)):
        names = ", ".join(can.name for can in same)
        mark, colour = ("yes", GOOD) if why[0] else ("no", BAD)
        figure.text(_LEFT, y, f"{mark}  {names}", color=colour, weight="bold", **_SMALL)
        y = _words(figure, y - 0.0093, _LEFT, plain(why[1]), _WIDTH)


def _words(figure: Figure, y: float, x: float, words: str, width: int) -> float:
    """Write wrapped text downwards from `y`, truncated to `_MAX_LINES`; return the next `y`."""
    found = textwrap.wrap(words, width)
    if len(found) > _MOST_LINES:
        found = [*found[: _MOST_LINES - 1], found[_MOST_LINES - 1][: width - 2] + " …"]
    for line in found:
        figure.text(x, y, line, **_SMALL)
        y -= 0.0088
    return y - 0.002


def _free(path: Path, sheet: Sheet, taken: Sequence[Path]) -> Path:
    """Return an unused file name for one of several pages."""
    stem = f"{path.stem}-{sheet.name.split('.')[0]}-uav{sheet.told.uav}"
    found, number = path.with_name(stem + path.suffix), 1
    while found in taken:
        number += 1
        found = path.with_name(f"{stem}-{number}{path.suffix}")
    return found
