"""Time panels: altitude, speeds, angles, servos, strip of modes and events, strip of rates."""

from typing import Any

import numpy as np

from fleet.contract import COLUMNS
from fleet.report.ink import BAD, INK, LINES, MUTED, axis_limits, downsample
from fleet.telemetry.inspection.findings import AircraftFindings, LinkTexts, merged_events
from fleet.telemetry.inspection.survey import Survey, airborne, mode_spans
from fleet.telemetry.inspection.thinned import inside

_MARKS = {  # marker and colour of each event kind
    "armed": ("^", "#00795A"),
    "disarmed": ("v", "#00795A"),
    "text": ("X", BAD),
    "clock": ("*", BAD),
    "link": ("s", BAD),
    "gap": ("|", BAD),
    "mission": ("D", "#7A6BB8"),
    "parameter": ("P", "#A67C00"),
}
_BINS = 300


def altitude(ax: Any, survey: Survey) -> None:
    """Draw the altitude."""
    t, x = survey.rows["position"].rows()
    if not _line(ax, survey, "position", 2, scale=1e-3, label="altitude"):
        return _no_rows(ax, "altitude")
    in_flight = inside(t, airborne(survey))
    ax.set_ylim(*axis_limits((x[in_flight] if in_flight.any() else x)[:, 2] * 1e-3, min_range=10.0))
    _label(ax, "altitude\n[m above MSL]", columns=0)
    return None


def speeds(ax: Any, survey: Survey) -> None:
    """Draw airspeed and ground speed."""
    t, v = survey.rows["velocity"].rows()
    has_airspeed = _line(ax, survey, "air", 0, label="airspeed")
    if len(t):
        ax.plot(
            *_elapsed(survey, *downsample(t, np.hypot(v[:, 0], v[:, 1]), _max_interval(survey, "velocity"))),
            color=LINES[1],
            lw=0.9,
            label="ground speed",
        )
    if not has_airspeed and not len(t):
        return _no_rows(ax, "speed")
    ax.set_ylim(bottom=0)
    _label(ax, "speed\n[m/s]")
    return None


def angles(ax: Any, survey: Survey) -> None:
    """Draw roll, pitch and commanded roll."""
    if not _line(ax, survey, "attitude", 0, scale=180 / np.pi, label="roll"):
        return _no_rows(ax, "attitude")
    _line(ax, survey, "attitude", 1, scale=180 / np.pi, colour=LINES[1], label="pitch")
    _line(ax, survey, "command", 0, scale=180 / np.pi, colour=INK, label="roll commanded", ls=(0, (1, 1)), lw=0.7)
    ax.axhline(0, color=MUTED, lw=0.5)
    _label(ax, "angle\n[deg]")
    return None


def servos(ax: Any, survey: Survey, findings: AircraftFindings) -> None:
    """Draw the pulse widths of moving channels, or the throttle without them."""
    moving = [servo for servo in findings.servos if servo.moves]
    low, high = 3_000.0, 0.0
    for servo in moving:
        colour = LINES[(servo.channel - 1) % len(LINES)]
        label = f"{servo.channel} {servo.surface}".strip()
        low, high = min(low, servo.low_us), max(high, servo.high_us)
        _line(ax, survey, "servo", servo.channel - 1, colour=colour, label=label, lw=0.8)
    if moving:
        ax.set_ylim(*axis_limits(np.array([low, high])))  # in flight: before it some channels are 0
        return _label(ax, "servo\n[us]", columns=8)
    if not _line(ax, survey, "air", 1, scale=100.0, label="throttle"):
        return _no_rows(ax, "servo" if not findings.servos else "moving servo")
    return _label(ax, "throttle\n[%]")


def events_strip(ax: Any, survey: Survey, facts: LinkTexts, colours: dict[str, str]) -> None:
    """Draw the strip of modes, mission items and events."""
    length = max(survey.newest_t - survey.start_t, 1.0)
    for span, mode in mode_spans(survey):
        start = span.start - survey.start_t
        ax.barh(2, span.seconds, left=start, height=0.8, color=colours[mode], lw=0)
        if span.seconds / length > 0.012 * len(mode) + 0.01:
            ax.text(
                start + span.seconds / 2, 2, mode, ha="center", va="center", color="white", size=7, parse_math=False
            )
    edge, shown = -np.inf, set()
    for event in merged_events(survey, facts):
        at = event.t - survey.start_t
        if event.kind == "item":
            ax.plot([at, at], [0.65, 1.35], color=INK, lw=0.8)
            if at - edge > 0.02 * length:
                ax.text(at, 1, f" {event.text.split()[1]}", ha="left", va="center", size=6.5, clip_on=True)
                edge = at
        elif event.kind in _MARKS:
            mark, colour = _MARKS[event.kind]
            label = None if event.kind in shown else event.kind
            ax.plot(at, 0, mark, color=colour, ms=5, ls="none", label=label, clip_on=False)
            shown.add(event.kind)
    ax.set(ylim=(-0.5, 2.5), yticks=[0, 1, 2], yticklabels=["events", "item", "mode"])
    ax.tick_params(axis="y", length=0)
    if shown:
        ax.legend(loc="upper left", bbox_to_anchor=(1.005, 1.05), ncols=1, handletextpad=0.1)


def rates(ax: Any, survey: Survey, findings: AircraftFindings) -> None:
    """Draw the strip of rates: full colour is the nominal rate, white no rows, red a gap."""
    from matplotlib.colors import LinearSegmentedColormap

    names = [name for name in COLUMNS if survey.rows[name].count]
    length = max(survey.newest_t - survey.start_t, 1.0)
    centres = survey.start_t + (np.arange(_BINS) + 0.5) * length / _BINS
    share = np.array([_share(survey, name, centres, length / _BINS) for name in names]).reshape(-1, _BINS)
    blues = LinearSegmentedColormap.from_list("rate", ["#FFFFFF", "#9CC9E5", "#0072B2"])
    extent = (0, length, len(names) - 0.5, -0.5)
    ax.imshow(share, cmap=blues, vmin=0, vmax=1, aspect="auto", extent=extent, interpolation="nearest")
    for row, name in enumerate(names):
        for gap in survey.rows[name].gaps():
            width = max(gap.seconds, length / _BINS)  # a short gap stays visible
            ax.barh(row, width, left=gap.start - survey.start_t, height=0.8, color=BAD, lw=0)
    ax.set(yticks=range(len(names)), yticklabels=[f"{name} {findings.rows[name].rate_hz:.3g} Hz" for name in names])
    ax.tick_params(axis="y", length=0, labelsize=6.5)
    ax.grid(visible=False)
    if not names:
        _no_rows(ax, "")


def _share(survey: Survey, name: str, centres: np.ndarray, width: float) -> np.ndarray:
    """Return the rate around each centre relative to the nominal rate, (n,) 0..1."""
    rows = survey.rows[name]
    t = rows.rows()[0]
    usual = rows.rate_hz / max(rows.stride, 1)
    half = max(0.5 * width, 1.5 / usual if usual else 0.5 * width)
    count = np.searchsorted(t, centres + half) - np.searchsorted(t, centres - half)
    return np.clip(count / max(2 * half * usual, 1e-9), 0, 1) if usual else (count > 0).astype(float)


def _line(
    ax: Any, survey: Survey, name: str, column: int, *, scale: float = 1.0, colour: str = LINES[0], **style: Any
) -> bool:
    """Draw one column over time; return False without rows."""
    t, x = survey.rows[name].rows()
    if len(t):
        points = downsample(t, x[:, column] * scale, _max_interval(survey, name))
        ax.plot(*_elapsed(survey, *points), color=colour, **({"lw": 0.9} | style))
    return bool(len(t))


def _max_interval(survey: Survey, name: str) -> float:
    rows = survey.rows[name]
    return max(rows.max_interval_s, 3 * rows.stride / rows.rate_hz) if rows.rate_hz else rows.max_interval_s


def _elapsed(survey: Survey, t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return t - survey.start_t, y


def _label(ax: Any, text: str, columns: int = 4) -> None:
    ax.set_ylabel(text)
    if columns:
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=columns)


def _no_rows(ax: Any, what: str) -> None:
    ax.text(
        0.5, 0.5, f"no {what} rows".replace("  ", " "), ha="center", va="center", transform=ax.transAxes, color=MUTED
    )
    ax.set(yticks=[])
