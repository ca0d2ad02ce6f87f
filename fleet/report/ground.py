"""Ground track of the report: flown path in mode colours, route, waypoints, wind."""

from typing import Any

import numpy as np
from matplotlib.patheffects import withStroke

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
from fleet.report.ink import GRID, INK, MUTED, ROUTE, downsample
from fleet.telemetry.inspection.findings import AircraftFindings
from fleet.telemetry.inspection.survey import Survey, airborne, mode_spans
from fleet.telemetry.inspection.thinned import inside

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
        ax.text(0.5, 0.5, "no position rows", ha="center", va="center", transform=ax.transAxes, color=MUTED)
        ax.set(xticks=[], yticks=[])
        return
    p = to_ned(origin, *x.T)
    in_flight = inside(t, airborne(survey))
    in_flight = in_flight if in_flight.any() else np.ones(len(t), bool)
    _draw_path(ax, survey, t, p, colours)
    legs = _legs(survey, origin)
    low, high = p[in_flight, :2].min(axis=0), p[in_flight, :2].max(axis=0)
    reach = _MAX_EXTENT * max(*(high - low), 50.0)
    near = [
        leg for leg in legs if (leg[P_N : P_E + 1] > low - reach).all() and (leg[P_N : P_E + 1] < high + reach).all()
    ]
    _route(ax, near, survey)
    if len(near) < len(legs):
        ax.text(0.02, 0.02, f"{len(legs) - len(near)} waypoints outside the map", transform=ax.transAxes, color=MUTED)
    _frame(ax, np.vstack([p[in_flight, :2], *[leg[None, P_N : P_E + 1] for leg in near]]))
    _ends(ax, p[in_flight])
    _wind(ax, findings)


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
        ax.annotate(
            str(int(leg[SEQ])),
            (leg[P_E], leg[P_N]),
            xytext=offset,
            textcoords="offset points",
            color=ROUTE,
            size=7,
            zorder=5,
            path_effects=_HALO,
        )
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
