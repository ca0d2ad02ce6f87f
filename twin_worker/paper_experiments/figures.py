"""Draw figures 7 and 8 of the paper from own experiments."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fleet.report.ink import BAD, GOOD, INK, LINES, MUTED, axis_limits
from twin_worker.numerics.plot_style import style_axes
from twin_worker.paper_experiments.experiment import SEEN_RUN_S, STATE_NAMES, Experiment
from twin_worker.telemetry.flight_phase import PHASES

_STYLES = ((LINES[0], "first step"), (BAD, "refined"), (GOOD, "coupled model"))
_UNITS = {"u": "m/s", "v": "m/s", "w": "m/s", "p": "rad/s", "q": "rad/s", "r": "rad/s"}
_MEANING = (
    "100 %: the run equals the measurement; 0 %: as good as its mean; boxes: quartiles, whiskers: 5 to 95 %; "
    "medians of the titles: first step, refined, coupled model"
)


def draw(folder: Path, first: str, results: Sequence[Experiment], conditions: str) -> list[Path]:
    """Draw figure 7 for every mode and figure 8, over unseen and seen data, into a folder; return the files.

    Args:
        folder: created if missing
        first: name of the first step
        results: experiments
        conditions: air and length of the identification window, for the titles
    """
    folder.mkdir(parents=True, exist_ok=True)
    by_mode = {mode: group for mode in PHASES if (group := [result for result in results if result.mode == mode])}
    fits = {mode: np.array([result.fit for result in group]) for mode, group in by_mode.items()}
    seen_by_mode = {mode: [result.fit_seen for result in results if result.mode_seen == mode] for mode in PHASES}
    seen = {mode: np.array(group) for mode, group in seen_by_mode.items() if group}
    figures = {}
    for mode, group in by_mode.items():
        ranked = sorted(group, key=lambda result: float(result.fit[1].mean()))
        figures[f"fig7_{first}_{mode}.png"] = _runs(ranked[len(ranked) // 2], first, conditions)  # median of refined
    seconds = next(iter(by_mode.values()))[0].seconds if by_mode else np.zeros(2)
    unseen_s = seconds[-1] + seconds[1] - seconds[0]
    title = f"Fit per state, first step {first}: {conditions}"
    figures[f"fig8_{first}.png"] = _boxes(fits, f"{title}, free run over the next {unseen_s:.0f} s, unseen")
    figures[f"fig8_{first}_seen.png"] = _boxes(seen, f"{title}, free run over the last {SEEN_RUN_S:.0f} s of these")
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=130)
    return [folder / name for name in figures]


def _runs(result: Experiment, first: str, conditions: str) -> Figure:
    """Draw every state of one experiment: measured and each model."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    for k, (ax, name) in enumerate(zip(figure.subplots(3, 3, sharex=True).flat, STATE_NAMES, strict=True)):
        ax.plot(result.seconds, result.actual[:, k], color=INK, lw=1.8, label="measured")
        for run, (colour, label) in zip(result.runs, _STYLES, strict=True):
            ax.plot(result.seconds, run[:, k], color=colour, lw=1.1, label=label)
        # scale to the measured line: a diverged run may leave the axes
        low, high = axis_limits(result.actual[:, k], min_range=0.02)
        ax.set_ylim(low - 0.5 * (high - low), high + 0.5 * (high - low))
        style_axes(ax, f"{name} [{_UNITS.get(name, 'rad')}]   fit {_listed(result.fit[:, k])} %")
    figure.supxlabel("unseen data [s]; fit: first step, refined, coupled model", fontsize=9, color=INK)
    title = f"{result.mode}, uav-{result.uav}, the median experiment of this mode; first step {first}; {conditions}"
    _add_title(figure, title)
    return figure


def _add_title(figure: Figure, title: str) -> None:
    """Draw the title, and under it the legend of the first panel, above all panels, where it covers no data."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=len(labels),
        frameon=False,
        fontsize=9,
        title=title,
        title_fontproperties={"size": 11},
        labelcolor=INK,
    )


def _listed(fits: np.ndarray) -> str:
    """List fits with minus signs of text, which are wider than hyphens."""
    return ", ".join(f"{fit:.0f}" for fit in fits).replace("-", "\u2212")


def _boxes(fits: dict[str, np.ndarray], title: str) -> Figure:
    """Draw box plots of the fit per state, one panel per mode: fits (N, 3, 9) [%]."""
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    panels = figure.subplots(2, 2, sharey=True, squeeze=False).flat
    places = np.arange(len(STATE_NAMES))
    for ax, (mode, fit) in zip(panels, fits.items(), strict=False):
        for i, (colour, label) in enumerate(_STYLES):
            boxes = ax.boxplot(
                fit[:, i],
                positions=places + 0.27 * (i - 1),
                widths=0.22,
                whis=(5, 95),
                showfliers=False,
                patch_artist=True,
            )
            for box in boxes["boxes"]:
                box.set(facecolor=colour, alpha=0.35, edgecolor=colour)
            for line in (*boxes["whiskers"], *boxes["caps"], *boxes["medians"]):
                line.set(color=colour)
            ax.plot([], [], color=colour, lw=5, alpha=0.5, label=label)
        ax.axhline(0, color=MUTED, lw=0.8)
        ax.set_xticks(places, STATE_NAMES)
        medians = _listed(np.median(fit.mean(axis=2), axis=0))
        style_axes(ax, f"{mode}: {len(fit)} experiments, median of the mean over states {medians} %")
    for ax in list(panels):
        ax.set_visible(False)
    figure.supylabel("fit of a free run, cut off at −100 [%]", fontsize=9, color=INK)
    figure.supxlabel(_MEANING, fontsize=8, color=MUTED)
    _add_title(figure, title)
    return figure
