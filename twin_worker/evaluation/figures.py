"""Figures of an evaluation: figure 9 of the paper, coverage, probability integral transform, error by look-ahead."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from scipy.special import ndtr, ndtri

from fleet.report.ink import INK, LINES, MUTED, ROUTE
from twin_worker.confidence.tube_and_horizon import ERROR_LIMIT, NOMINAL_COVERAGE
from twin_worker.evaluation.scoring.log import OURS, EvaluationCase
from twin_worker.evaluation.scoring.score import LIMITS, MethodScores, score_method
from twin_worker.numerics.plot_style import style_axes
from twin_worker.telemetry.flight_phase import PHASES

_COLOURS = dict(zip((OURS, "paper", "dynamics", "route_wind", "route", "imm", "ct", "cv"), LINES, strict=True))
_STYLE: Any = {  # of all figures
    "figure.constrained_layout.use": True,
    "axes.labelsize": 9,
    "axes.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 8,
}
_COMPARED = ("paper", "route_wind")  # drawn with ours where all methods would be too many
_SHOWN_S = 60.0  # of figure 9 [s]
_PAPER_S = 16.5  # lower quartile of the times within 10 % in the paper [s]
_PIT_S = (5, 16, 30, 60)
_AXES = ("along", "cross", "vertical")


def draw(folder: Path, cases: Sequence[EvaluationCase]) -> list[Path]:
    """Draw all figures of the included starts into a folder; return the files."""
    if not cases:
        return []
    names = [name for name in _COLOURS if all(name in case.start.forecasts for case in cases)]
    scores = {name: score_method(cases, name) for name in names}
    with_tube = {name: one for name, one in scores.items() if np.isfinite(one.tube).any()}
    with matplotlib.rc_context(_STYLE):
        figures = {
            "fig9a_route.png": _route_figure(cases[_median_start(scores[OURS])], names),
            "fig9b_relative_error.png": _relative_figure(cases, scores),
            "fig9c_within_10_percent.png": _box_figure(scores),
            "coverage.png": _coverage_figure(with_tube),
            "pit.png": _pit_figure(scores[OURS]),
            "error.png": _error_figure(scores),
            "phases.png": _phase_figure(scores, np.array([case.phase for case in cases])),
        }
        for name, figure in figures.items():
            figure.savefig(folder / name, dpi=130)
    return [folder / name for name in figures]


def _median_start(own_scores: MethodScores) -> int:
    """Return the start with the median error after 60 s."""
    column = own_scores.column_at(_SHOWN_S)
    assert column is not None
    return int(np.argsort(own_scores.distance[:, column])[len(own_scores.flight) // 2])


def _route_figure(case: EvaluationCase, names: Sequence[str]) -> Figure:
    """Draw mission, flight and predictions of one start over 60 s, north up."""
    figure = Figure(figsize=(8, 8))
    ax = figure.subplots()
    shown = case.start.ahead <= _SHOWN_S
    compared = [name for name in (OURS, *_COMPARED) if name in names]
    lines = [case.positions[shown], *(case.start.forecasts[name].path[shown] for name in compared)]
    ax.plot(*case.route[:, 1::-1].T, color=ROUTE, lw=0.9, ls=":", marker="o", ms=4, alpha=0.6, label="mission")
    forecast = case.start.forecasts[OURS]
    if forecast.tube is not None:
        for k in np.flatnonzero(shown)[5::5]:
            ax.fill(*_ellipse(forecast.path, forecast.tube, int(k)), color=_COLOURS[OURS], alpha=0.12, lw=0)
    ax.plot(*lines[0][:, 1::-1].T, color=INK, lw=2.2, label="flown, 60 s")
    for name, line in zip(compared, lines[1:], strict=True):
        ax.plot(*line[:, 1::-1].T, color=_COLOURS[name], lw=1.4, ls="-" if name == OURS else "--", label=name)
    ax.plot(*lines[0][0, 1::-1], "o", color=INK, ms=7)
    low, high = np.nanmin(np.vstack(lines), axis=0), np.nanmax(np.vstack(lines), axis=0)
    centre, half = 0.5 * (low + high), 0.58 * max(float((high - low)[:2].max()), 60.0)
    ax.set(xlim=(centre[1] - half, centre[1] + half), ylim=(centre[0] - half, centre[0] + half), aspect="equal")
    ax.set(xlabel="east [m]", ylabel="north [m]")
    ax.legend()
    style_axes(ax, f"{case.start.flight}: the start with the median error; shaded: tube every 5 s")
    return figure


def _ellipse(path: np.ndarray, tube: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return east and north of the tube's outline at one look-ahead."""
    angle = np.linspace(0, 2 * np.pi, 40)
    direction = path[min(k + 1, len(path) - 1), :2] - path[k - 1, :2]
    direction = direction / max(float(np.linalg.norm(direction)), 1e-6)
    a, b = tube[k, 0] * np.cos(angle), tube[k, 1] * np.sin(angle)
    return path[k, 1] + a * direction[1] + b * direction[0], path[k, 0] + a * direction[0] - b * direction[1]


def _relative_figure(cases: Sequence[EvaluationCase], scores: dict[str, MethodScores]) -> Figure:
    """Draw the relative error M1 over the look-ahead: median of every method, quartiles of ours and the paper's."""
    figure = Figure(figsize=(9, 5))
    ax = figure.subplots()
    length = np.array([case.length for case in cases])
    for name, method_scores in scores.items():
        relative = 100 * method_scores.distance / length
        low, median, high = _quantiles(relative, (25, 50, 75))
        ax.plot(method_scores.ahead, median, color=_COLOURS[name], **_line_style(name), label=name)
        if name in (OURS, "paper"):
            ax.fill_between(method_scores.ahead, low, high, color=_COLOURS[name], alpha=0.15, lw=0)
    ax.axhline(100 * ERROR_LIMIT, color=INK, lw=1.0, ls="--")
    ax.set(xlim=(0, scores[OURS].ahead[-1]), ylim=(0, 40))
    ax.set(xlabel="look-ahead [s]", ylabel="error over path flown [%]")
    ax.legend(ncols=4)
    style_axes(ax, f"relative error, median of {len(cases)} starts; shaded: quartiles; dashed: 10 %")
    return figure


def _box_figure(scores: dict[str, MethodScores]) -> Figure:
    """Draw box plots of the time within 10 % of every method."""
    figure = Figure(figsize=(9, 5))
    ax = figure.subplots()
    for position, (name, method_scores) in enumerate(scores.items()):
        times = np.minimum(method_scores.passages[LIMITS[0]][:, 0], _SHOWN_S)
        box = ax.boxplot(times, positions=[position], widths=0.55, showfliers=False, patch_artist=True)
        box["boxes"][0].set(facecolor=_COLOURS[name], alpha=0.35, edgecolor=_COLOURS[name])
        for line in (*box["whiskers"], *box["caps"], *box["medians"]):
            line.set(color=_COLOURS[name], lw=1.6)
        jitter = np.random.default_rng(position).uniform(-0.18, 0.18, len(times))
        ax.plot(position + jitter, times, ".", color=_COLOURS[name], ms=3, alpha=0.35)
    ax.axhline(_PAPER_S, color=INK, lw=1.0, ls="--")
    ax.set_xticks(range(len(scores)), list(scores))
    ax.set_ylabel("time within 10 % [s]")
    title = f"time within 10 % of the path flown in the first {_SHOWN_S:.0f} s, {len(scores[OURS].flight)} starts"
    style_axes(ax, f"{title}; dashed: lower quartile of Huang 2021, {_PAPER_S:.1f} s")
    return figure


def _coverage_figure(scores: dict[str, MethodScores]) -> Figure:
    """Draw the share inside the tube over the look-ahead: all starts, and each flight of ours."""
    figure = Figure(figsize=(9, 5))
    ax = figure.subplots()
    thin: dict[str, Any] = {"color": MUTED, "lw": 0.9, "alpha": 0.5}
    own_scores = scores.get(OURS)
    if own_scores is not None:
        for flight in np.unique(own_scores.flight):
            share = 100 * _means(own_scores.inside[own_scores.flight == flight])
            ax.plot(own_scores.ahead[1:], share[1:], **thin)
        ax.plot([], [], label="one flight of ours", **thin)
    for name, one in scores.items():
        ax.plot(one.ahead[1:], 100 * _means(one.inside)[1:], color=_COLOURS[name], lw=2.0, label=name)
    ax.axhline(100 * NOMINAL_COVERAGE, color=INK, lw=1.0, ls="--", label="target")
    lowest = min(float(np.nanmin(_means(one.inside))) for one in scores.values())
    ax.set(ylim=(min(50.0, 100 * lowest - 5.0), 101), xlabel="look-ahead [s]", ylabel="inside the tube [%]")
    ax.legend(loc="lower left")
    style_axes(ax, "share of flights inside the tube on all three axes")
    return figure


def _pit_figure(own_scores: MethodScores) -> Figure:
    """Draw the PIT histogram of errors in the normal distribution of the tube; a calibrated tube gives a flat one."""
    figure = Figure(figsize=(10, 6.5))
    look_aheads = [s for s in _PIT_S if own_scores.column_at(s) is not None]
    panels = figure.subplots(3, len(look_aheads), sharex=True, sharey=True, squeeze=False)
    sigma = own_scores.tube / ndtri(0.5 + 0.5 * NOMINAL_COVERAGE ** (1 / 3))
    for i, axis in enumerate(_AXES):
        for ax, s in zip(panels[i], look_aheads, strict=True):
            column = own_scores.column_at(s)
            pit_values = ndtr(own_scores.error[:, column, i] / sigma[:, column, i])
            pit_values = pit_values[np.isfinite(pit_values)]
            share = 100 * np.histogram(pit_values, 10, (0, 1))[0] / max(len(pit_values), 1)
            ax.bar(np.arange(10) + 0.5, share, width=0.9, color=_COLOURS[OURS], alpha=0.55)
            ax.axhline(10, color=INK, lw=1.0, ls="--")
            ax.set_axisbelow(True)
            style_axes(ax, f"{axis}, {s} s")
    figure.supxlabel("decile of the predicted distribution", fontsize=9, color=INK)
    figure.supylabel("share of starts [%]", fontsize=9, color=INK)
    title = "peak in the middle: the tube is too wide; peaks at both ends: too narrow"
    figure.suptitle(title, fontsize=10, color=INK)
    return figure


def _error_figure(scores: dict[str, MethodScores]) -> Figure:
    """Draw the median error over the look-ahead of every method, and the 90 % quantile of ours."""
    figure = Figure(figsize=(9, 6))
    ax = figure.subplots()
    for name, method_scores in scores.items():
        (median,) = _quantiles(method_scores.distance[:, 1:], (50,))
        ax.plot(method_scores.ahead[1:], median, color=_COLOURS[name], **_line_style(name), label=name)
    (high,) = _quantiles(scores[OURS].distance[:, 1:], (90,))
    ax.plot(scores[OURS].ahead[1:], high, color=_COLOURS[OURS], lw=1.2, ls=":", label="ours, 90 %")
    ax.set(xscale="log", yscale="log", xlabel="look-ahead [s]", ylabel="distance, median [m]")
    ticks = [s for s in (1, 2, 5, 10, 16, 30, 60, 120, 180) if s <= scores[OURS].ahead[-1]]
    ax.set_xticks(ticks, [str(s) for s in ticks])
    ax.minorticks_off()
    ax.legend()
    style_axes(ax, f"error by look-ahead, {len(scores[OURS].flight)} starts")
    return figure


def _phase_figure(scores: dict[str, MethodScores], phases: np.ndarray) -> Figure:
    """Draw the median error over the look-ahead by flight phase after the start."""
    figure = Figure(figsize=(10, 7))
    top = 0.0
    panels = figure.subplots(2, 2, sharex=True, sharey=True).flat
    for ax, phase in zip(panels, PHASES, strict=True):
        rows = phases == phase
        for name in [name for name in (OURS, *_COMPARED) if name in scores]:
            if rows.any():
                (median,) = _quantiles(scores[name].distance[rows], (50,))
                ax.plot(scores[name].ahead, median, color=_COLOURS[name], lw=2.0 if name == OURS else 1.3, label=name)
                top = max(top, float(np.nanmax(median[scores[name].ahead <= _SHOWN_S])))
        style_axes(ax, f"{phase}, {int(rows.sum())} starts")
    panels[0].set(xlim=(0, _SHOWN_S), ylim=(0, 1.05 * top or 1.0))
    panels[0].legend()
    figure.supxlabel("look-ahead [s]", fontsize=9, color=INK)
    figure.supylabel("distance, median [m]", fontsize=9, color=INK)
    return figure


def _line_style(name: str) -> dict[str, Any]:
    """Return line width and style: ours is wide; `dynamics`, which may coincide with it, is dashed."""
    return {"lw": 2.6 if name == OURS else 1.3, "ls": "--" if name == "dynamics" else "-"}


def _quantiles(values: np.ndarray, shares: Sequence[float]) -> Any:
    """Return quantiles of the valid values by column; nan without any, (q, k)."""
    out = np.full((len(shares), values.shape[1]), np.nan)
    valid = np.isfinite(values).any(axis=0)
    out[:, valid] = np.nanpercentile(values[:, valid], shares, axis=0)
    return out


def _means(values: np.ndarray) -> np.ndarray:
    out = np.full(values.shape[1], np.nan)
    valid = np.isfinite(values).any(axis=0)
    out[valid] = np.nanmean(values[:, valid], axis=0)
    return out
