"""Panels of a report: ground track; altitude, speeds, angles, servos, modes and events, rates over time."""

from typing import Any

import numpy as np
from matplotlib.patheffects import withStroke

from fleet.contract import COLUMNS
from fleet.frames import Origin, to_ned
from fleet.mission import (
    FIRST_ITEM,
    KIND,
    LOITER_TIME,
    LOITER_TO_ALT,
    LOITER_TURNS,
    LOITER_UNLIMITED,
    P_E,
    P_N,
    RADIUS,
    SEQ,
    unroll_route,
)
from fleet.report.ink import BAD, GRID, INK, LINES, MUTED, ROUTE, axis_limits, downsample
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
    return _label(ax, "altitude\n[m above MSL]", columns=0)


def speeds(ax: Any, survey: Survey) -> None:
    """Draw airspeed and ground speed."""
    t, v = survey.rows["velocity"].rows()
    has_airspeed = _line(ax, survey, "air", 0, label="airspeed")
    if len(t):
        t, speed = downsample(t, np.hypot(v[:, 0], v[:, 1]), _max_interval(survey, "velocity"))
        ax.plot(t - survey.start_t, speed, color=LINES[1], lw=0.9, label="ground speed")
    if not has_airspeed and not len(t):
        return _no_rows(ax, "speed")
    ax.set_ylim(bottom=0)
    return _label(ax, "speed\n[m/s]")


def angles(ax: Any, survey: Survey) -> None:
    """Draw roll, pitch and commanded roll."""
    if not _line(ax, survey, "attitude", 0, scale=180 / np.pi, label="roll"):
        return _no_rows(ax, "attitude")
    _line(ax, survey, "attitude", 1, scale=180 / np.pi, colour=LINES[1], label="pitch")
    _line(ax, survey, "command", 0, scale=180 / np.pi, colour=INK, label="roll commanded", ls=(0, (1, 1)), lw=0.7)
    ax.axhline(0, color=MUTED, lw=0.5)
    return _label(ax, "angle\n[deg]")


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
            middle = start + span.seconds / 2
            ax.text(middle, 2, mode, ha="center", va="center", color="white", size=7, parse_math=False)
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
        times, y = downsample(t, x[:, column] * scale, _max_interval(survey, name))
        ax.plot(times - survey.start_t, y, color=colour, **({"lw": 0.9} | style))
    return bool(len(t))


def _max_interval(survey: Survey, name: str) -> float:
    rows = survey.rows[name]
    return max(rows.max_interval_s, 3 * rows.stride / rows.rate_hz) if rows.rate_hz else rows.max_interval_s


def _label(ax: Any, text: str, columns: int = 4) -> None:
    ax.set_ylabel(text)
    if columns:
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=columns)


def _no_rows(ax: Any, what: str) -> None:
    text = f"no {what} rows".replace("  ", " ")
    ax.text(0.5, 0.5, text, ha="center", va="center", transform=ax.transAxes, color=MUTED)
    ax.set(yticks=[])


_CIRCLES = (LOITER_TURNS, LOITER_UNLIMITED, LOITER_TIME, LOITER_TO_ALT)
_MAX_EXTENT = 2.0  # waypoints beyond this multiple of the flown extent are not shown [-]
_HALO = [withStroke(linewidth=2.0, foreground="white")]
_USUAL_RADIUS = 60.0  # default WP_LOITER_RAD of ArduPlane [m]


def ground_track(ax: Any, survey: Survey, findings: AircraftFindings, colours: dict[str, str]) -> None:
    """Draw the ground track, or a note without positions."""
    ax.set_title("Ground track, relative to the first position", loc="left")
    t, x = survey.rows["position"].rows()
    origin = survey.origin()
    if origin is None:
        ax.set(xticks=[])
        return _no_rows(ax, "position")
    p = to_ned(origin, *x.T)
    in_flight = inside(t, airborne(survey))
    in_flight = in_flight if in_flight.any() else np.ones(len(t), bool)
    _draw_path(ax, survey, t, p, colours)
    legs = _legs(survey, origin)
    low, high = p[in_flight, :2].min(axis=0), p[in_flight, :2].max(axis=0)
    reach = _MAX_EXTENT * max(*(high - low), 50.0)
    near = [leg for leg in legs if ((low - reach < leg[P_N : P_E + 1]) & (leg[P_N : P_E + 1] < high + reach)).all()]
    _route(ax, near, survey)
    if len(near) < len(legs):
        ax.text(0.02, 0.02, f"{len(legs) - len(near)} waypoints outside the map", transform=ax.transAxes, color=MUTED)
    _frame(ax, np.vstack([p[in_flight, :2], *[leg[None, P_N : P_E + 1] for leg in near]]))
    _ends(ax, p[in_flight])
    return _wind(ax, findings)


def _draw_path(ax: Any, survey: Survey, t: np.ndarray, p: np.ndarray, colours: dict[str, str]) -> None:
    """Draw the path in mode colours; grey without a mode."""
    ax.plot(p[:, 1], p[:, 0], color=GRID, lw=2.0, zorder=1)
    labelled: set[str] = set()
    for span, mode in mode_spans(survey):
        in_span = (t >= span.start) & (t <= span.stop)
        if in_span.sum() < 2:
            continue
        at, east = downsample(t[in_span], p[in_span, 1], np.inf)
        label = None if mode in labelled else mode
        ax.plot(east, np.interp(at, t, p[:, 0]), color=colours[mode], lw=1.3, zorder=3, label=label)
        labelled.add(mode)


def _legs(survey: Survey, origin: Origin) -> list[np.ndarray]:
    """Return the legs of the route, at most one per mission item."""
    legs_by_seq: dict[int, np.ndarray] = {}
    first = FIRST_ITEM.get(survey.status.autopilot, 1) if survey.status else 1
    for leg in unroll_route(survey.items, seq=first, origin=origin, params=survey.values, first=first).legs:
        if leg[SEQ] >= 0:
            legs_by_seq.setdefault(int(leg[SEQ]), leg)
    return [legs_by_seq[seq] for seq in sorted(legs_by_seq)]


def _route(ax: Any, legs: list[np.ndarray], survey: Survey) -> None:
    if not legs:
        return
    east, north = [leg[P_E] for leg in legs], [leg[P_N] for leg in legs]
    ax.plot(east, north, color=ROUTE, lw=0.9, ls=(0, (5, 3)), marker="D", ms=3.5, mfc="white", zorder=2, label="route")
    occupied: set[tuple[int, int]] = set()
    for leg in legs:
        at = (round(leg[P_E] / 20), round(leg[P_N] / 20))
        offset = (4, 4) if at not in occupied else (4, -9)  # separate labels of items at one position
        occupied.add(at)
        style = {"color": ROUTE, "size": 7, "zorder": 5, "path_effects": _HALO}
        text = str(int(leg[SEQ]))
        ax.annotate(text, (leg[P_E], leg[P_N]), xytext=offset, textcoords="offset points", **style)
        if int(leg[KIND]) in _CIRCLES:
            radius = abs(leg[RADIUS]) or abs(survey.values.get("WP_LOITER_RAD", _USUAL_RADIUS))
            a = np.linspace(0, 2 * np.pi, 90)
            ax.plot(leg[P_E] + radius * np.sin(a), leg[P_N] + radius * np.cos(a), color=ROUTE, lw=0.8, ls=":", zorder=2)


def _frame(ax: Any, p: np.ndarray) -> None:
    """Frame the path and the waypoints with equal scales."""
    low, high = p.min(axis=0), p.max(axis=0)
    middle, size = 0.5 * (low + high), 1.12 * np.maximum(high - low, 25.0)
    box = ax.get_position()
    width, height = ax.figure.get_size_inches() * (box.width, box.height)
    scale = max(size[1] / width, size[0] / height)
    east, north = 0.5 * scale * width, 0.5 * scale * height
    ax.set(xlim=(middle[1] - east, middle[1] + east), ylim=(middle[0] - north, middle[0] + north), aspect="equal")
    ax.set_xlabel("east [m]")
    ax.set_ylabel("north [m]")


def _ends(ax: Any, p: np.ndarray) -> None:
    """Mark start, end and direction of the flight."""
    ax.plot(p[0, 1], p[0, 0], "o", color=INK, ms=5, mfc="white", zorder=6, label="start")
    ax.plot(p[-1, 1], p[-1, 0], "s", color=INK, ms=4.5, zorder=6, label="end")
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1))])
    for k in np.searchsorted(distance, np.linspace(0, distance[-1], 10)[1:-1]):
        back = max(int(np.searchsorted(distance, distance[k] - 0.004 * distance[-1])) - 1, 0)
        if back < k:
            arrow = {"arrowstyle": "-|>", "color": INK, "lw": 0, "mutation_scale": 9, "shrinkA": 0, "shrinkB": 0}
            ax.annotate("", (p[k, 1], p[k, 0]), (p[back, 1], p[back, 0]), arrowprops=arrow, zorder=4)


def _wind(ax: Any, findings: AircraftFindings) -> None:
    """Draw the wind arrow in the corner."""
    if findings.wind is None or findings.wind.speed < 0.1:
        return
    heading = np.radians(findings.wind.from_deg + 180)
    size = {"units": "inches", "scale_units": "inches", "scale": 1 / 0.36, "width": 0.022}
    placement = {"transform": ax.transAxes, "pivot": "middle", "angles": "uv", "zorder": 6}
    ax.quiver([0.93], [0.92], [np.sin(heading)], [np.cos(heading)], color=MUTED, **size, **placement)
    label = f"wind {findings.wind.speed:.1f} m/s"
    ax.text(0.985, 0.815, label, ha="right", color=MUTED, size=7, transform=ax.transAxes, path_effects=_HALO, zorder=6)
