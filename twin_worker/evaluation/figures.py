"""Figures of an evaluation: figure 9 of the paper, coverage, probability integral transform, error by look-ahead."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.special import ndtr, ndtri

from fleet.report.ink import INK, LINES, MUTED, ROUTE
from twin_worker.confidence.tube_and_horizon import LIMIT, QUANTILE
from twin_worker.evaluation.scoring.case import OURS, Case
from twin_worker.evaluation.scoring.score import LIMITS, Scores, score
from twin_worker.numerics.plot_style import house
from twin_worker.telemetry.flight_phase import MODES

_COLOURS = dict(zip((OURS, "paper", "dynamics", "route_wind", "route", "imm", "ct", "cv"), LINES, strict=True))
_BESIDE = ("paper", "route_wind")  # drawn with ours where all methods would be too many
_WINDOW_S = 60.0  # of figure 9 [s]
_PAPER_S = 16.5  # lower quartile of the times within 10 % in the paper [s]
_PIT_S = (5, 16, 30, 60)
_AXES = ("along", "cross", "vertical")


def draw(folder: Path, cases: Sequence[Case]) -> list[Path]:
    """Draw all figures of the included starts into a folder; return the files."""
    if not cases:
        return []
    names = [name for name in _COLOURS if all(name in case.asked.told for case in cases)]
    scores = {name: score(cases, name) for name in names}
    usual = _usual(scores[OURS])
    figures = {
        "fig9a_route.png": _route(cases[usual], names),
        "fig9b_relative_error.png": _relative(cases, scores),
        "fig9c_within_10_percent.png": _boxes(scores),
        "coverage.png": _coverage({name: one for name, one in scores.items() if np.isfinite(one.tube).any()}),
        "pit.png": _pit(scores[OURS]),
        "error.png": _errors(scores),
        "phases.png": _phases(scores, np.array([case.phase for case in cases])),
    }
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=130)
    return [folder / name for name in figures]


def _usual(ours: Scores) -> int:
    """Return the start with the median error after 60 s."""
    column = ours.at(_WINDOW_S)
    assert column is not None
    return int(np.argsort(ours.distance[:, column])[len(ours.flight) // 2])


def _route(case: Case, names: Sequence[str]) -> Figure:
    """Draw mission, flight and predictions of one start over 60 s, north up."""
    figure = Figure(figsize=(8, 8), layout="constrained")
    ax = figure.subplots()
    within = case.asked.ahead <= _WINDOW_S
    lines = [case.flown[within], *(case.asked.told[name].path[within] for name in (OURS, *_BESIDE) if name in names)]
    ax.plot(*case.route[:, 1::-1].T, color=ROUTE, lw=0.9, ls=":", marker="o", ms=4, alpha=0.6, label="mission")
    told = case.asked.told[OURS]
    if told.tube is not None:
        for k in np.flatnonzero(within)[5::5]:
            ax.fill(*_ellipse(told.path, told.tube, int(k)), color=_COLOURS[OURS], alpha=0.12, lw=0)
    ax.plot(*lines[0][:, 1::-1].T, color=INK, lw=2.2, label="flown, 60 s")
    for name, line in zip([n for n in (OURS, *_BESIDE) if n in names], lines[1:], strict=True):
        ax.plot(*line[:, 1::-1].T, color=_COLOURS[name], lw=1.4, ls="-" if name == OURS else "--", label=name)
    ax.plot(*lines[0][0, 1::-1], "o", color=INK, ms=7)
    low, high = np.nanmin(np.vstack(lines), axis=0), np.nanmax(np.vstack(lines), axis=0)
    middle, half = 0.5 * (low + high), 0.58 * max(float((high - low)[:2].max()), 60.0)
    ax.set_xlim(middle[1] - half, middle[1] + half)
    ax.set_ylim(middle[0] - half, middle[0] + half)
    ax.set_aspect("equal")
    ax.set_xlabel("east [m]", fontsize=9, color=INK)
    ax.set_ylabel("north [m]", fontsize=9, color=INK)
    ax.legend(frameon=False, fontsize=8)
    house(ax, f"{case.asked.flight}: the start with the median error; shaded: tube every 5 s")
    return figure


def _ellipse(path: np.ndarray, tube: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return east and north of the tube's outline at one look-ahead."""
    turn = np.linspace(0, 2 * np.pi, 40)
    way = path[min(k + 1, len(path) - 1), :2] - path[k - 1, :2]
    way = way / max(float(np.linalg.norm(way)), 1e-6)
    a, b = tube[k, 0] * np.cos(turn), tube[k, 1] * np.sin(turn)
    return path[k, 1] + a * way[1] + b * way[0], path[k, 0] + a * way[0] - b * way[1]


def _relative(cases: Sequence[Case], scores: dict[str, Scores]) -> Figure:
    """Draw the relative error M1 over the look-ahead: median of every method, quartiles of ours and the paper's."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    ax = figure.subplots()
    length = np.array([case.length for case in cases])
    for name, one in scores.items():
        relative = 100 * one.distance / length
        low, middle, high = _quantiles(relative, (25, 50, 75))
        ax.plot(one.ahead, middle, color=_COLOURS[name], **_line(name), label=name)
        if name in (OURS, "paper"):
            ax.fill_between(one.ahead, low, high, color=_COLOURS[name], alpha=0.15, lw=0)
    ax.axhline(100 * LIMIT, color=INK, lw=1.0, ls="--")
    ax.set_ylim(0, 40)
    ax.set_xlim(0, scores[OURS].ahead[-1])
    ax.set_xlabel("look-ahead [s]", fontsize=9, color=INK)
    ax.set_ylabel("error over path flown [%]", fontsize=9, color=INK)
    ax.legend(frameon=False, fontsize=8, ncols=4)
    house(ax, f"relative error, median of {len(cases)} starts; shaded: quartiles; dashed: 10 %")
    return figure


def _boxes(scores: dict[str, Scores]) -> Figure:
    """Draw box plots of the time within 10 % of every method."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    ax = figure.subplots()
    for place, (name, one) in enumerate(scores.items()):
        times = np.minimum(one.passages[LIMITS[0]][:, 0], _WINDOW_S)
        box = ax.boxplot(times, positions=[place], widths=0.55, showfliers=False, patch_artist=True)
        box["boxes"][0].set(facecolor=_COLOURS[name], alpha=0.35, edgecolor=_COLOURS[name])
        for line in (*box["whiskers"], *box["caps"], *box["medians"]):
            line.set(color=_COLOURS[name], lw=1.6)
        jitter = np.random.default_rng(place).uniform(-0.18, 0.18, len(times))
        ax.plot(place + jitter, times, ".", color=_COLOURS[name], ms=3, alpha=0.35)
    ax.axhline(_PAPER_S, color=INK, lw=1.0, ls="--")
    ax.set_xticks(range(len(scores)), list(scores))
    ax.set_ylabel("time within 10 % [s]", fontsize=9, color=INK)
    said = f"time within 10 % of the path flown in the first {_WINDOW_S:.0f} s, {len(scores[OURS].flight)} starts"
    house(ax, f"{said}; dashed: lower quartile of Huang 2021, {_PAPER_S:.1f} s")
    return figure


def _coverage(scores: dict[str, Scores]) -> Figure:
    """Draw the share inside the tube over the look-ahead: all starts, and each flight of ours."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    ax = figure.subplots()
    ours = scores.get(OURS)
    if ours is not None:
        for flight in np.unique(ours.flight):
            ax.plot(
                ours.ahead[1:], 100 * _means(ours.inside[ours.flight == flight])[1:], color=MUTED, lw=0.9, alpha=0.5
            )
        ax.plot([], [], color=MUTED, lw=0.9, alpha=0.5, label="one flight of ours")
    for name, one in scores.items():
        ax.plot(one.ahead[1:], 100 * _means(one.inside)[1:], color=_COLOURS[name], lw=2.0, label=name)
    ax.axhline(100 * QUANTILE, color=INK, lw=1.0, ls="--", label="target")
    lowest = min(float(np.nanmin(_means(one.inside))) for one in scores.values())
    ax.set_ylim(min(50.0, 100 * lowest - 5.0), 101)
    ax.set_xlabel("look-ahead [s]", fontsize=9, color=INK)
    ax.set_ylabel("inside the tube [%]", fontsize=9, color=INK)
    ax.legend(frameon=False, fontsize=8, loc="lower left")
    house(ax, "share of flights inside the tube on all three axes")
    return figure


def _pit(ours: Scores) -> Figure:
    """Draw the PIT histogram of errors in the normal distribution of the tube; a calibrated tube gives a flat one."""
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    look = [s for s in _PIT_S if ours.at(s) is not None]
    panels = figure.subplots(3, len(look), sharex=True, sharey=True, squeeze=False)
    sigma = ours.tube / ndtri(0.5 + 0.5 * QUANTILE ** (1 / 3))
    for i, axis in enumerate(_AXES):
        for ax, s in zip(panels[i], look, strict=True):
            column = ours.at(s)
            where = ndtr(ours.error[:, column, i] / sigma[:, column, i])
            where = where[np.isfinite(where)]
            share = 100 * np.histogram(where, 10, (0, 1))[0] / max(len(where), 1)
            ax.bar(np.arange(10) + 0.5, share, width=0.9, color=_COLOURS[OURS], alpha=0.55)
            ax.axhline(10, color=INK, lw=1.0, ls="--")
            ax.set_axisbelow(True)
            house(ax, f"{axis}, {s} s")
    figure.supxlabel("decile of the predicted distribution", fontsize=9, color=INK)
    figure.supylabel("share of starts [%]", fontsize=9, color=INK)
    said = "peak in the middle: the tube is too wide; peaks at both ends: too narrow"
    figure.suptitle(said, fontsize=10, color=INK)
    return figure


def _errors(scores: dict[str, Scores]) -> Figure:
    """Draw the median error over the look-ahead of every method, and the 90 % quantile of ours."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    ax = figure.subplots()
    for name, one in scores.items():
        (middle,) = _quantiles(one.distance[:, 1:], (50,))
        ax.plot(one.ahead[1:], middle, color=_COLOURS[name], **_line(name), label=name)
    (high,) = _quantiles(scores[OURS].distance[:, 1:], (90,))
    ax.plot(scores[OURS].ahead[1:], high, color=_COLOURS[OURS], lw=1.2, ls=":", label="ours, 90 %")
    ax.set_xscale("log")
    ax.set_yscale("log")
    ticks = [s for s in (1, 2, 5, 10, 16, 30, 60, 120, 180) if s <= scores[OURS].ahead[-1]]
    ax.set_xticks(ticks, [str(s) for s in ticks])
    ax.minorticks_off()
    ax.set_xlabel("look-ahead [s]", fontsize=9, color=INK)
    ax.set_ylabel("distance, median [m]", fontsize=9, color=INK)
    ax.legend(frameon=False, fontsize=8)
    house(ax, f"error by look-ahead, {len(scores[OURS].flight)} starts")
    return figure


def _phases(scores: dict[str, Scores], phases: np.ndarray) -> Figure:
    """Draw the median error over the look-ahead by flight phase after the start."""
    figure = Figure(figsize=(10, 7), layout="constrained")
    top = 0.0
    panels = figure.subplots(2, 2, sharex=True, sharey=True).flat
    for ax, phase in zip(panels, MODES, strict=True):
        rows = phases == phase
        for name in [name for name in (OURS, *_BESIDE) if name in scores]:
            if rows.any():
                (middle,) = _quantiles(scores[name].distance[rows], (50,))
                ax.plot(scores[name].ahead, middle, color=_COLOURS[name], lw=2.0 if name == OURS else 1.3, label=name)
                top = max(top, float(np.nanmax(middle[scores[name].ahead <= _WINDOW_S])))
        house(ax, f"{phase}, {int(rows.sum())} starts")
    panels[0].set_xlim(0, _WINDOW_S)
    panels[0].set_ylim(0, 1.05 * top or 1.0)
    panels[0].legend(frameon=False, fontsize=8)
    figure.supxlabel("look-ahead [s]", fontsize=9, color=INK)
    figure.supylabel("distance, median [m]", fontsize=9, color=INK)
    return figure


def _line(name: str) -> dict[str, Any]:
    """Return line width and style: ours is wide; `dynamics`, which may coincide with it, is dashed."""
    return {"lw": 2.6 if name == OURS else 1.3, "ls": "--" if name == "dynamics" else "-"}


def _quantiles(values: np.ndarray, shares: Sequence[float]) -> Any:
    """Return quantiles of the valid values by column; nan without any, (q, k)."""
    out = np.full((len(shares), values.shape[1]), np.nan)
    known = np.isfinite(values).any(axis=0)
    out[:, known] = np.nanpercentile(values[:, known], shares, axis=0)
    return out


def _means(values: np.ndarray) -> np.ndarray:
    out = np.full(values.shape[1], np.nan)
    known = np.isfinite(values).any(axis=0)
    out[known] = np.nanmean(values[:, known], axis=0)
    return out
