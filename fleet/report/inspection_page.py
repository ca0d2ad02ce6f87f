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

from fleet.process.sanitise import printable
from fleet.report import panels
from fleet.report.ink import BAD, GOOD, GRID, INK, MUTED, mode_colours
from fleet.report.panels import ground_track
from fleet.report.report_text import summary_lines
from fleet.telemetry.inspection.findings import AircraftFindings, LinkTexts
from fleet.telemetry.inspection.survey import Survey, mode_spans

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
_PROBLEM_KINDS = ("text", "clock", "link", "gap")
_WIDTH = 62  # characters per line of the text beside the map
_MAX_LINES = 3  # lines of one entry
_LEFT = 0.585  # left edge of that text [share of the page width]
_SMALL: Any = {"size": 6.6, "va": "top", "parse_math": False}


class ReportPage(NamedTuple):
    """Data of one page: one aircraft of a recording."""

    survey: Survey
    findings: AircraftFindings
    facts: LinkTexts
    name: str  # name of the recording


def write(path: Path, pages: Sequence[ReportPage]) -> list[Path]:
    """Write the pages: one .pdf for all, or one .png or .svg each, named after recording and aircraft if several.

    Returns:
        the files written
    """
    with matplotlib.rc_context(_STYLE), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # missing glyphs are drawn as boxes
        if path.suffix == ".pdf":
            with PdfPages(path) as pdf:
                for page_data in pages:
                    pdf.savefig(draw_page(page_data))
            return [path]
        written: list[Path] = []
        for page_data in pages:
            written.append(path if len(pages) == 1 else _unused_path(path, page_data, written))
            draw_page(page_data).savefig(written[-1], dpi=_DPI)
    return written


def draw_page(page_data: ReportPage) -> Figure:
    """Draw one page."""
    survey, findings = page_data.survey, page_data.findings
    figure = Figure(figsize=_A4, facecolor="white")
    colours = mode_colours(mode for _, mode in mode_spans(survey))
    texts = dict(summary_lines(findings))
    title = printable(f"uav-{findings.uav}   {page_data.name}")
    figure.text(0.06, 0.972, title, size=14, weight="bold", va="top", parse_math=False)
    for row, heading in enumerate(("aircraft", "time")):
        text = printable(texts[heading]).removeprefix(f"uav-{findings.uav}, ")
        figure.text(0.06, 0.951 - 0.0125 * row, text, size=8, color=MUTED, va="top", parse_math=False)
    ground = figure.add_axes((0.095, 0.65, 0.455, 0.255))
    ground_track(ground, survey, findings, colours)
    ground.legend(loc="upper left", bbox_to_anchor=(0.0, -0.145), ncols=6)
    _facts(figure, findings, texts)
    _over_time(figure, page_data, colours)
    figure.text(0.94, 0.012, "parauav: fleet inspect", size=6, color=MUTED, ha="right")
    return figure


def _over_time(figure: Figure, page_data: ReportPage, colours: dict[str, str]) -> None:
    survey, findings = page_data.survey, page_data.findings
    grid = figure.add_gridspec(
        6, 1, left=0.125, right=0.905, top=0.568, bottom=0.05, hspace=0.24, height_ratios=(1, 1, 1.1, 1.2, 0.62, 1.0)
    )
    axes = [figure.add_subplot(grid[0])]
    axes += [figure.add_subplot(grid[row], sharex=axes[0]) for row in range(1, 6)]
    panels.altitude(axes[0], survey)
    panels.speeds(axes[1], survey)
    panels.angles(axes[2], survey)
    panels.servos(axes[3], survey, findings)
    panels.events_strip(axes[4], survey, page_data.facts, colours)
    panels.rates(axes[5], survey, findings)
    for ax in axes[:4]:
        for span, mode in mode_spans(survey):
            start = span.start - survey.start_t
            ax.axvspan(start, start + span.seconds, color=colours[mode], alpha=0.07, lw=0, zorder=0)
    for ax in axes[:-1]:
        ax.tick_params(axis="x", labelbottom=False)
    axes[0].set_xlim(0.0, max(survey.newest_t - survey.start_t, 1.0))
    axes[-1].set_xlabel("time since start of recording [s]        strip: blue nominal rate, paler lower rate, red gap")
    figure.align_ylabels(axes[:4])


def _facts(figure: Figure, findings: AircraftFindings, texts: dict[str, str]) -> None:
    """Write the recording summary and the applicable twin functions beside the map."""
    y = 0.916
    facts = {heading: texts[heading] for heading in _HEADINGS}
    if any(not kind.rows for kind in findings.rows.values()):
        facts["no rows of"] = texts["no rows of"]
    problems = [f"{e.t_s:.0f} s {e.text}" for e in findings.events if e.kind in _PROBLEM_KINDS]
    facts["problems"] = "; ".join(problems) or "none reported"
    for heading, text in facts.items():
        figure.text(_LEFT, y, heading, color=MUTED, weight="bold", **_SMALL)
        y = _draw_text(figure, y, _LEFT + 0.083, printable(text), _WIDTH - 16)
    y -= 0.007
    figure.text(_LEFT, y, "Applicable twin functions", weight="bold", **_SMALL)
    y -= 0.0125
    for verdict, abilities in groupby(findings.abilities, key=lambda ability: (ability.can, ability.why)):
        names = ", ".join(ability.name for ability in abilities)
        mark, colour = ("yes", GOOD) if verdict[0] else ("no", BAD)
        figure.text(_LEFT, y, f"{mark}  {names}", color=colour, weight="bold", **_SMALL)
        y = _draw_text(figure, y - 0.0093, _LEFT, printable(verdict[1]), _WIDTH)


def _draw_text(figure: Figure, y: float, x: float, text: str, width: int) -> float:
    """Write wrapped text downwards from `y`, truncated to `_MAX_LINES`; return the next `y`."""
    text_lines = textwrap.wrap(text, width)
    if len(text_lines) > _MAX_LINES:
        text_lines = [*text_lines[: _MAX_LINES - 1], text_lines[_MAX_LINES - 1][: width - 2] + " …"]
    for line in text_lines:
        figure.text(x, y, line, **_SMALL)
        y -= 0.0088
    return y - 0.002


def _unused_path(path: Path, page_data: ReportPage, taken: Sequence[Path]) -> Path:
    """Return an unused file name for one of several pages."""
    stem = f"{path.stem}-{page_data.name.split('.')[0]}-uav{page_data.findings.uav}"
    candidate, number = path.with_name(stem + path.suffix), 1
    while candidate in taken:
        number += 1
        candidate = path.with_name(f"{stem}-{number}{path.suffix}")
    return candidate
