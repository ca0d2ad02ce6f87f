"""Time panels: altitude, speeds, angles, servos, strip of modes and events, strip of rates."""

from typing import Any

import numpy as np

from fleet.contract import COLUMNS
from fleet.report.ink import BAD, INK, LINES, MUTED, drawn, spread
from fleet.telemetry.inspection.findings import Facts, Findings, happened
from fleet.telemetry.inspection.survey import Survey, airborne, spells
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


def altitude(ax: Any, known: Survey) -> None:
    """Draw the altitude."""
    t, x = known.rows["position"].rows()
    if not _line(ax, known, "position", 2, scale=1e-3, label="altitude"):
        return _none(ax, "altitude")
    there = inside(t, airborne(known))
    ax.set_ylim(*spread((x[there] if there.any() else x)[:, 2] * 1e-3, least=10.0))
    _label(ax, "altitude\n[m above MSL]", columns=0)
    return None


def speeds(ax: Any, known: Survey) -> None:
    """Draw airspeed and ground speed."""
    t, v = known.rows["velocity"].rows()
    found = _line(ax, known, "air", 0, label="airspeed")
    if len(t):
        ax.plot(*_since(known, *drawn(t, np.hypot(v[:, 0], v[:, 1]), _widest(known, "velocity"))), color=LINES[1],
                lw=0.9, label="ground speed")  # fmt: skip
    if not found and not len(t):
        return _none(ax, "speed")
    ax.set_ylim(bottom=0)
    _label(ax, "speed\n[m/s]")
    return None


def angles(ax: Any, known: Survey) -> None:
    """Draw roll, pitch and commanded roll."""
    if not _line(ax, known, "attitude", 0, scale=180 / np.pi, label="roll"):
        return _none(ax, "attitude")
    _line(ax, known, "attitude", 1, scale=180 / np.pi, colour=LINES[1], label="pitch")
    _line(ax, known, "command", 0, scale=180 / np.pi, colour=INK, label="roll commanded", ls=(0, (1, 1)), lw=0.7)
    ax.axhline(0, color=MUTED, lw=0.5)
    _label(ax, "angle\n[deg]")
    return None


def servos(ax: Any, known: Survey, told: Findings) -> None:
    """Draw the pulse widths of moving channels, or the throttle without them."""
    moving = [servo for servo in told.servos if servo.moves]
    low, high = 3_000.0, 0.0
    for servo in moving:
        colour = LINES[(servo.channel - 1) % len(LINES)]
        label = f"{servo.channel} {servo.surface}".strip()
        low, high = min(low, servo.low_us), max(high, servo.high_us)
        _line(ax, known, "servo", servo.channel - 1, colour=colour, label=label, lw=0.8)
    if moving:
        ax.set_ylim(*spread(np.array([low, high])))  # in flight: before it some channels are 0
        return _label(ax, "servo\n[us]", columns=8)
    if not _line(ax, known, "air", 1, scale=100.0, label="throttle"):
        return _none(ax, "servo" if not told.servos else "moving servo")
    return _label(ax, "throttle\n[%]")


def happenings(ax: Any, known: Survey, facts: Facts, colours: dict[str, str]) -> None:
    """Draw the strip of modes, mission items and events."""
    length = max(known.newest - known.begun, 1.0)
    for span, mode in spells(known):
        start = span.start - known.begun
        ax.barh(2, span.seconds, left=start, height=0.8, color=colours[mode], lw=0)
        if span.seconds / length > 0.012 * len(mode) + 0.01:
            ax.text(
                start + span.seconds / 2, 2, mode, ha="center", va="center", color="white", size=7, parse_math=False
            )
    edge, shown = -np.inf, set()
    for event in happened(known, facts):
        at = event.t - known.begun
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


def rates(ax: Any, known: Survey, told: Findings) -> None:
    """Draw the strip of rates: full colour is the nominal rate, white no rows, red a gap."""
    from matplotlib.colors import LinearSegmentedColormap

    names = [name for name in COLUMNS if known.rows[name].count]
    length = max(known.newest - known.begun, 1.0)
    centres = known.begun + (np.arange(_BINS) + 0.5) * length / _BINS
    share = np.array([_share(known, name, centres, length / _BINS) for name in names]).reshape(-1, _BINS)
    blues = LinearSegmentedColormap.from_list("rate", ["#FFFFFF", "#9CC9E5", "#0072B2"])
    extent = (0, length, len(names) - 0.5, -0.5)
    ax.imshow(share, cmap=blues, vmin=0, vmax=1, aspect="auto", extent=extent, interpolation="nearest")
    for row, name in enumerate(names):
        for gap in known.rows[name].gaps():
            wide = max(gap.seconds, length / _BINS)  # a short gap stays visible
            ax.barh(row, wide, left=gap.start - known.begun, height=0.8, color=BAD, lw=0)
    ax.set(yticks=range(len(names)), yticklabels=[f"{name} {told.rows[name].rate_hz:.3g} Hz" for name in names])
    ax.tick_params(axis="y", length=0, labelsize=6.5)
    ax.grid(visible=False)
    if not names:
        _none(ax, "")


def _share(known: Survey, name: str, centres: np.ndarray, width: float) -> np.ndarray:
    """Return the rate around each centre relative to the nominal rate, (n,) 0..1."""
    rows = known.rows[name]
    t = rows.rows()[0]
    usual = rows.rate_hz / max(rows.stride, 1)
    half = max(0.5 * width, 1.5 / usual if usual else 0.5 * width)
    count = np.searchsorted(t, centres + half) - np.searchsorted(t, centres - half)
    return np.clip(count / max(2 * half * usual, 1e-9), 0, 1) if usual else (count > 0).astype(float)


def _line(
    ax: Any, known: Survey, name: str, column: int, *, scale: float = 1.0, colour: str = LINES[0], **style: Any
) -> bool:
    """Draw one column over time; return False without rows."""
    t, x = known.rows[name].rows()
    if len(t):
        points = drawn(t, x[:, column] * scale, _widest(known, name))
        ax.plot(*_since(known, *points), color=colour, **({"lw": 0.9} | style))
    return bool(len(t))


def _widest(known: Survey, name: str) -> float:
    rows = known.rows[name]
    return max(rows.longest, 3 * rows.stride / rows.rate_hz) if rows.rate_hz else rows.longest


def _since(known: Survey, t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return t - known.begun, y


def _label(ax: Any, text: str, columns: int = 4) -> None:
    ax.set_ylabel(text)
    if columns:
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=columns)


def _none(ax: Any, what: str) -> None:
    ax.text(
        0.5, 0.5, f"no {what} rows".replace("  ", " "), ha="center", va="center", transform=ax.transAxes, color=MUTED
    )
    ax.set(yticks=[])
