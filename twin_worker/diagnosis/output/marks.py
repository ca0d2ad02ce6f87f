"""Names, colours and time segments shared by the figures and the page of a diagnosis."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fleet.effects import Onset
from fleet.report.ink import INK, LINES, MUTED
from twin_worker.diagnosis.inference.report import FigureSeries, Report, ReportOutcome

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
LEGEND: Any = {"frameon": False, "fontsize": 8, "labelcolor": INK}


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
    located = [
        (
            finding.hypothesis.label,
            finding.segments,
            None if finding.hypothesis.onset.kind is Onset.ALWAYS else finding.hypothesis.onset.t0,
        )
        for finding in report.findings
    ]
    channel, segments = report.where
    if report.outcome is ReportOutcome.UNKNOWN and channel:
        located.append((f"unknown, {CHANNEL_TEXT.get(channel, channel)}", segments, None))
    return [
        FigureMark(name, _COLOURS[k % len(_COLOURS)], tuple(s), onset) for k, (name, s, onset) in enumerate(located)
    ]


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
