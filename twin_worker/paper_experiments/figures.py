"""Draw figures 7 and 8 of the paper from own experiments."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from fleet.report.ink import BAD, INK, LINES, MUTED, spread
from twin_worker.numerics.plot_style import house
from twin_worker.telemetry.flight_phase import MODES

if TYPE_CHECKING:
    from twin_worker.paper_experiments.experiment import Experiment

_STEPS = (("first", LINES[0], "first step"), ("refined", BAD, "refined"))
_UNITS = {"u": "m/s", "v": "m/s", "w": "m/s", "p": "rad/s", "q": "rad/s", "r": "rad/s"}


def draw(folder: Path, first: str, done: "Sequence[Experiment]", names: Sequence[str]) -> list[Path]:
    """Draw figure 7 for every mode and figure 8, over unseen and seen data, into a folder; return the files.

    Args:
        folder: created if missing
        first: name of the first step
        results: experiments
        names: state names of the columns
    """
    folder.mkdir(parents=True, exist_ok=True)
    its = {mode: some for mode in MODES if (some := [one for one in done if one.mode == mode])}
    fits = {mode: np.array([one.fit for one in some]) for mode, some in its.items()}
    before = {mode: [one.fit_seen for one in done if one.mode_seen == mode] for mode in MODES}
    seen = {mode: np.array(some) for mode, some in before.items() if some}
    figures = {f"fig7_{first}_{mode}.png": _runs(_usual(some), names, first) for mode, some in its.items()}
    figures[f"fig8_{first}.png"] = _boxes(fits, names, f"{first} and refined, over unseen data")
    figures[f"fig8_{first}_seen.png"] = _boxes(seen, names, f"{first} and refined, over identification data")
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=130)
    return [folder / name for name in figures]


def _usual(some: "list[Experiment]") -> "Experiment":
    """Return the experiment with the median fit of the refined model."""
    return sorted(some, key=lambda one: float(one.fit[1].mean()))[len(some) // 2]


def _runs(one: "Experiment", names: Sequence[str], first: str) -> Figure:
    """Draw every state of one experiment: measured, first step, refined."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    for k, (ax, name) in enumerate(zip(figure.subplots(3, 3, sharex=True).flat, names, strict=True)):
        ax.plot(one.seconds, one.actual[:, k], color=INK, lw=1.6, label="measured")
        for step, colour, label in _STEPS:
            run = getattr(one, step)[:, k]
            ax.plot(one.seconds, run, color=colour, lw=1.1, label=label)
        # scale to the measured line: a diverged run may leave the axes
        low, high = spread(one.actual[:, k], least=0.02)
        ax.set_ylim(low - (high - low), high + (high - low))
        fits = " → ".join(f"{one.fit[i, k]:.0f}" for i in (0, 1))
        house(ax, f"{name} [{_UNITS.get(name, 'rad')}]   fit {fits} %")
    figure.axes[0].legend(frameon=False, fontsize=8)
    figure.supxlabel("unseen data [s]", fontsize=9, color=INK)
    figure.suptitle(f"{one.mode}, uav-{one.uav}: free run from {first} and refined", fontsize=11, color=INK)
    return figure


def _boxes(fits: dict[str, np.ndarray], names: Sequence[str], title: str) -> Figure:
    """Draw box plots of the fit per state, one panel per mode: fits (N, 2, 9) [%]."""
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    panels = figure.subplots(2, 2, sharey=True, squeeze=False).flat
    places = np.arange(len(names))
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
        ax.set_xticks(places, names)
        house(ax, f"{mode}, n {len(fit)}")
    for ax in list(panels):
        ax.set_visible(False)
    figure.axes[0].legend(frameon=False, fontsize=8)
    figure.supylabel("fit of a free run, at least −100 [%]", fontsize=9, color=INK)
    figure.suptitle(f"Fit per state: {title}", fontsize=11, color=INK)
    return figure
