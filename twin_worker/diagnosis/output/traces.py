"""Figures over time: residuals before and after, measured against simulated specific force, and marks of effects."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from fleet.effects import Onset
from fleet.report.ink import GRID, INK, LINES, MUTED, axis_limits
from twin_worker.diagnosis.inference.report import FigureSeries, Report, ReportOutcome
from twin_worker.diagnosis.inference.validation.cross_validate import MIN_CHANNEL_RATIO
from twin_worker.diagnosis.model.baseline import CHANNELS
from twin_worker.numerics.plot_style import style_axes

Segments = Sequence[tuple[float, float]]

CHANNEL_TEXT = {
    "force_x": "force forward",
    "side": "sideslip",
    "lift": "angle of attack",
    "roll": "roll acceleration",
    "pitch": "pitch acceleration",
    "yaw": "yaw acceleration",
    "airspeed": "airspeed",
    "gps_x": "velocity against IMU, forward",
    "gps_y": "velocity against IMU, right",
    "gps_z": "velocity against IMU, down",
    "gyro_roll": "attitude against gyro, roll",
    "gyro_pitch": "attitude against gyro, pitch",
    "gyro_yaw": "attitude against gyro, yaw",
    "baro": "barometric height",
}
"""Display name of each residual channel."""

OUTCOME_TEXT = {
    ReportOutcome.NONE: "no mismatch",
    ReportOutcome.NAMED: "named",
    ReportOutcome.SUSPECTED: "suspected, not confirmed",
    ReportOutcome.UNKNOWN: "unknown",
}
"""Display text of each outcome."""

BEFORE, AFTER = LINES[1], LINES[0]  # without and with the effects, in every figure
_COLOURS = (LINES[4], LINES[2], LINES[3], LINES[7])  # of located segments, distinct from those two
_EDGE_S = 1.0  # an effect that starts earlier counts as present throughout [s]
_MAX_SEGMENTS = 3  # segments listed in full


class FigureMark(NamedTuple):
    """Located effect or mismatch: name, colour, segments [s], and onset if it started in flight [s]."""

    name: str
    colour: str
    segments: tuple[tuple[float, float], ...]
    onset: float | None

    def mask(self, t: np.ndarray) -> np.ndarray:
        """Return which times lie in the segments, (n,) bool."""
        inside = np.zeros(len(t), bool)
        for start, stop in self.segments:
            inside |= (t >= start) & (t <= stop)
        return inside

    def onset_times(self, limits: tuple[float, float]) -> list[float]:
        """Return the onsets within the flight [s]; none for an effect that is present throughout."""
        if self.onset is not None:
            return [self.onset]
        return [start for start, _ in self.segments if start > limits[0] + _EDGE_S]


def marks(report: Report) -> list[FigureMark]:
    """Return one mark for every finding, and one for an unknown mismatch."""
    located: list[tuple[str, Segments, float | None]] = []
    for finding in report.findings:
        onset = finding.hypothesis.onset
        located.append((finding.hypothesis.label, finding.segments, None if onset.kind is Onset.ALWAYS else onset.t0))
    channel, segments = report.where
    if report.outcome is ReportOutcome.UNKNOWN and channel:
        located.append((f"unknown, {CHANNEL_TEXT.get(channel, channel)}", segments, None))
    colours = itertools.cycle(_COLOURS)
    return [FigureMark(name, next(colours), tuple(s), since) for name, s, since in located]


def format_segments(segments: Segments) -> str:
    """Format segments, e.g. `83–95, 102–110 s`."""
    if not segments:
        return "no definite time"
    text = ", ".join(f"{start:.0f}–{stop:.0f}" for start, stop in segments[:_MAX_SEGMENTS]) + " s"
    more = len(segments) - _MAX_SEGMENTS
    return f"{text} and {more} more" if more > 0 else text


def true_segments(t: np.ndarray, mask: np.ndarray) -> list[tuple[float, float]]:
    """Return first and last time of every run of true rows, (n,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(float(t[i]), float(t[j - 1])) for i, j in zip(edges[::2], edges[1::2], strict=True)]


def time_limits(series: FigureSeries) -> tuple[float, float]:
    """Return the limits of the time axis [s]."""
    return (float(series.t[0]), max(float(series.t[-1]), float(series.t[0]) + 1.0)) if len(series.t) else (0.0, 1.0)


def show_empty(ax: Any, message: str) -> None:
    """Show in a panel why it is empty."""
    ax.text(0.5, 0.5, message, ha="center", va="center", transform=ax.transAxes, fontsize=9, color=MUTED)


_MAX_CHANNELS = 8  # channels drawn
_MIN_CHANNELS = 4  # channels drawn if none differs from its usual
_NOMINAL = 2.0  # half width of the shaded nominal band [standard deviations]
_FORCES = ("forward", "right", "down")


def residuals(report: Report) -> Figure:
    """Draw each channel that differs from its usual, before and after, worst first."""
    names, title = choose_channels(report)
    n_rows = max((len(names) + 1) // 2, 1)
    figure = Figure(figsize=(11, max(1.8 * n_rows + 1.0, 3.6)))
    panels = list(figure.subplots(n_rows, 2, sharex=True, squeeze=False).flat)
    for ax, name in zip(panels, names, strict=False):
        _residual(ax, report, name)
    for ax in panels[len(names) :]:
        ax.set_visible(False)
    for ax in panels[max(len(names) - 2, 0) : len(names)]:
        ax.tick_params(labelbottom=True)  # the right column may have one row less
        ax.set_xlabel("time [s]")
    if names:
        panels[0].set_xlim(*time_limits(report.series))
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.supylabel("standard deviations of nominal flights", fontsize=9, color=INK)
    figure.suptitle(f"{report.flight}: {title}", fontsize=10, color=INK)
    return figure


def choose_channels(report: Report) -> tuple[list[str], str]:
    """Return the channels to draw, worst first, and a title that counts nominal channels and those without data."""
    ratio = {name: report.ratio_before.get(name, np.nan) for name in CHANNELS}
    known = [
        name for name in CHANNELS if np.isfinite(ratio[name]) and np.isfinite(_valid_residuals(report, name)[0]).any()
    ]
    worst = sorted(known, key=lambda name: -ratio[name])
    unusual = [name for name in worst if ratio[name] > MIN_CHANNEL_RATIO]
    notes = [f"{len(known) - len(unusual)} of {len(CHANNELS)} channels at their usual"]
    if len(known) < len(CHANNELS):
        notes.append(f"{len(CHANNELS) - len(known)} without data")
    if len(unusual) > _MAX_CHANNELS:
        notes.append(f"drawn: the worst {_MAX_CHANNELS} of the other {len(unusual)}")
    if not unusual and worst:
        notes.append(f"drawn: the highest {min(_MIN_CHANNELS, len(worst))}")
    return unusual[:_MAX_CHANNELS] or worst[:_MIN_CHANNELS], ", ".join(notes)


def _valid_residuals(report: Report, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a channel before and after, nan on invalid rows, (n,) each."""
    series, c = report.series, CHANNELS.index(name)
    before, after = (np.where(series.ok, x[:, c], np.nan) for x in (series.before, series.after))
    return before, after


def _residual(ax: Any, report: Report, name: str) -> None:
    t = report.series.t
    before, after = _valid_residuals(report, name)
    ax.axhspan(-_NOMINAL, _NOMINAL, color=GRID, alpha=0.6, lw=0, label="usual")
    title = f"{CHANNEL_TEXT[name]}: {report.ratio_before[name]:.1f}"
    ax.plot(t, before, color=BEFORE, lw=0.9, label="without the effects" if report.findings else "residual")
    if report.findings:
        ax.plot(t, after, color=AFTER, lw=0.9, label="with them")
        title += f" → {report.ratio_after.get(name, np.nan):.1f}"
    for mark in marks(report):
        for k, onset in enumerate(mark.onset_times(time_limits(report.series))):
            ax.axvline(onset, color=mark.colour, lw=1.6, ls="--", label=None if k else f"begins: {mark.name}")
    # short peaks may exceed the axis, lasting deviations may not
    most = np.nanpercentile(np.abs(np.concatenate([before, after if report.findings else before])), 99.7)
    ax.set_ylim(-max(1.15 * most, 2.0 * _NOMINAL), max(1.15 * most, 2.0 * _NOMINAL))
    style_axes(ax, f"{title} × the usual mean square")


def simulated(report: Report) -> Figure:
    """Draw measured specific force and that simulated without and with the effects; on the right one block enlarged."""
    series = report.series
    figure = Figure(figsize=(11, 6.8))
    panels = figure.subplots(3, 2, sharex="col", sharey="row", width_ratios=(2.6, 1), squeeze=False)
    block = _median_block(report)
    caption = "one held-out block" + (", of median gain" if report.findings else "") if block else "no held-out block"
    for i, pair in enumerate(panels):
        for ax, width in zip(pair, (0.8, 1.6), strict=True):
            _force(ax, report, i, width)
        style_axes(pair[0], f"{_FORCES[i]} [m/s²]")
        style_axes(pair[1], "" if i else caption)
    for ax in panels[-1]:
        ax.set_xlabel("time [s]")
    panels[0, 0].set_xlim(*time_limits(series))
    panels[0, 1].set_xlim(*(block or time_limits(series)))
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    text = "measured against simulated"
    if np.isfinite(report.force_before):
        change = f" → {report.force_after:.2f}" if report.findings and np.isfinite(report.force_after) else ""
        text = f"rms error of the simulation on held-out blocks {report.force_before:.2f}{change} m/s²"
    figure.suptitle(f"{report.flight}: specific force, {text}", fontsize=10, color=INK)
    return figure


def _force(ax: Any, report: Report, i: int, width: float) -> None:
    series = report.series
    forces = (series.measured, series.base, series.model)
    measured, base, model = (np.where(series.ok, x[:, i], np.nan) for x in forces)
    for k, (start, stop) in enumerate(true_segments(series.t, series.held_out)):
        ax.axvspan(start, stop, color=GRID, alpha=0.6, lw=0, label="held out of the fit" if k == 0 else None)
    if not np.isfinite(measured).any():
        show_empty(ax, "not measured")
    ax.plot(series.t, measured, color=INK, lw=width, label="measured")
    without = "simulated without the effects" if report.findings else "simulated"
    ax.plot(series.t, base, color=BEFORE, lw=1.0, label=without)
    if report.findings:
        ax.plot(series.t, model, color=AFTER, lw=1.0, label="with them")
    drawn = np.concatenate([measured, base, model] if report.findings else [measured, base])
    drawn = drawn[np.isfinite(drawn)]
    if len(drawn):
        ax.set_ylim(*axis_limits(np.percentile(drawn, (0.1, 99.9)), min_range=0.2))


def _median_block(report: Report) -> tuple[float, float] | None:
    """Return the held-out block of median gain among those with located segments."""
    series, located_marks = report.series, marks(report)
    located = np.any([mark.mask(series.t) for mark in located_marks], axis=0) if located_marks else series.ok
    located = located if located.any() else series.ok
    gains: dict[tuple[float, float], float] = {}
    for start, stop in true_segments(series.t, series.held_out):
        mask = series.ok & located & (series.t >= start) & (series.t <= stop)
        before, after = (((series.measured - x)[mask] ** 2).ravel() for x in (series.base, series.model))
        known = np.isfinite(before) & np.isfinite(after)
        if known.any() and stop > start:
            gains[start, stop] = float((before - after)[known].mean())
    return sorted(gains, key=lambda block: gains[block])[len(gains) // 2] if gains else None
