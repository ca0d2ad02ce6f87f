"""Draw figures 7 and 8 of the paper from own experiments."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fleet.report.ink import BAD, INK, LINES, MUTED, axis_limits
from twin_worker.numerics.plot_style import style_axes
from twin_worker.paper_experiments.experiment import STATE_NAMES, Experiment
from twin_worker.telemetry.flight_phase import PHASES

_STEPS = (("first", LINES[0], "first step"), ("refined", BAD, "refined"))
_UNITS = {"u": "m/s", "v": "m/s", "w": "m/s", "p": "rad/s", "q": "rad/s", "r": "rad/s"}


def draw(folder: Path, first: str, results: Sequence[Experiment]) -> list[Path]:
    """Draw figure 7 for every mode and figure 8, over unseen and seen data, into a folder; return the files.

    Args:
        folder: created if missing
        first: name of the first step
        results: experiments
    """
    folder.mkdir(parents=True, exist_ok=True)
    by_mode = {mode: group for mode in PHASES if (group := [result for result in results if result.mode == mode])}
    fits = {mode: np.array([result.fit for result in group]) for mode, group in by_mode.items()}
    seen_by_mode = {mode: [result.fit_seen for result in results if result.mode_seen == mode] for mode in PHASES}
    seen = {mode: np.array(group) for mode, group in seen_by_mode.items() if group}
    figures = {}
    for mode, group in by_mode.items():
        ranked = sorted(group, key=lambda result: float(result.fit[1].mean()))
        figures[f"fig7_{first}_{mode}.png"] = _runs(ranked[len(ranked) // 2], first)  # the median fit of the refined
    figures[f"fig8_{first}.png"] = _boxes(fits, f"{first} and refined, over unseen data")
    figures[f"fig8_{first}_seen.png"] = _boxes(seen, f"{first} and refined, over identification data")
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=130)
    return [folder / name for name in figures]


def _runs(result: Experiment, first: str) -> Figure:
    """Draw every state of one experiment: measured, first step, refined."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    for k, (ax, name) in enumerate(zip(figure.subplots(3, 3, sharex=True).flat, STATE_NAMES, strict=True)):
        ax.plot(result.seconds, result.actual[:, k], color=INK, lw=1.6, label="measured")
        for step, colour, label in _STEPS:
            run = getattr(result, step)[:, k]
            ax.plot(result.seconds, run, color=colour, lw=1.1, label=label)
        # scale to the measured line: a diverged run may leave the axes
        low, high = axis_limits(result.actual[:, k], min_range=0.02)
        ax.set_ylim(low - (high - low), high + (high - low))
        fits = " → ".join(f"{result.fit[i, k]:.0f}" for i in (0, 1))
        style_axes(ax, f"{name} [{_UNITS.get(name, 'rad')}]   fit {fits} %")
    figure.axes[0].legend(frameon=False, fontsize=8)
    figure.supxlabel("unseen data [s]", fontsize=9, color=INK)
    figure.suptitle(f"{result.mode}, uav-{result.uav}: free run from {first} and refined", fontsize=11, color=INK)
    return figure


def _boxes(fits: dict[str, np.ndarray], title: str) -> Figure:
    """Draw box plots of the fit per state, one panel per mode: fits (N, 2, 9) [%]."""
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    panels = figure.subplots(2, 2, sharey=True, squeeze=False).flat
    places = np.arange(len(STATE_NAMES))
    for ax, (mode, fit) in zip(panels, fits.items(), strict=False):
        for i, (_, colour, label) in enumerate(_STEPS):
            boxes = ax.boxplot(
                fit[:, i], positions=places + 0.36 * (i - 0.5), widths=0.3, showfliers=False, patch_artist=True
            )
            for box in boxes["boxes"]:
                box.set(facecolor=colour, alpha=0.35, edgecolor=colour)
            for line in (*boxes["whiskers"], *boxes["caps"], *boxes["medians"]):
                line.set(color=colour)
            ax.plot([], [], color=colour, lw=5, alpha=0.5, label=label)
        ax.axhline(0, color=MUTED, lw=0.6)
        ax.set_xticks(places, STATE_NAMES)
        style_axes(ax, f"{mode}, n {len(fit)}")
    for ax in list(panels):
        ax.set_visible(False)
    figure.axes[0].legend(frameon=False, fontsize=8)
    figure.supylabel("fit of a free run, at least −100 [%]", fontsize=9, color=INK)
    figure.suptitle(f"Fit per state: {title}", fontsize=11, color=INK)
    return figure
