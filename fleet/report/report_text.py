"""Text tables of an inspected recording, with the same figures as the JSON output."""

from collections import Counter
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from fleet.process.sanitise import plain
from fleet.telemetry.inspection.findings import File, Findings, Kind, mode_seconds

_MOST_EVENTS = 14
_NEWS = (
    "text",
    "clock",
    "link",
    "gap",
    "parameter",
    "disarmed",
    "armed",
    "mission",
    "mode",
)  # most severe first; mission items are listed with the mission
_MANY = 12  # most mission items listed


def table(file: File) -> RenderableType:
    """Return the tables of one recording, one per aircraft."""
    parts: list[RenderableType] = [Text(f"{plain(file.file)}  {file.bytes / 1e6:.1f} MB", style="bold")]
    parts += [Text(f"  {plain(sentence)}", style="red") for sentence in file.sentences]
    for told in file.aircraft:
        parts += [_aircraft(told, _twin(file.twin, told.uav)), Text("")]
    if file.twin and "sentence" in file.twin:
        parts.append(Text(f"  twin: {plain(str(file.twin['sentence']))}", style="red"))
    return Group(*parts)


def lines(told: Findings) -> list[tuple[str, str]]:
    """Return the summary without events and abilities: (heading, text)."""
    return [
        ("aircraft", _who(told)),
        ("time", _time(told)),
        ("link", _link(told)),
        (
            "modes",
            ", ".join(f"{name} {seconds:.0f} s" for name, seconds in mode_seconds(told).items()) or "none reported",
        ),
        ("rows", ", ".join(f"{name} {kind.rate_hz:.1f} Hz" for name, kind in told.rows.items() if kind.rows)),
        (
            "no rows of",
            ", ".join(name for name, kind in told.rows.items() if not kind.rows) or "none missing",
        ),
        ("gaps", _gaps(told.rows)),
        ("mission", _mission(told)),
        ("parameters", f"{told.params:,}" + (", complete" if told.params_complete else ", incomplete")),
        ("servo map", told.servo_map),
        ("servos", _servos(told)),
        ("airspeed", _airspeed(told)),
        ("wind", _wind(told)),
    ]


def _aircraft(told: Findings, twin: str) -> Table:
    out = Table(box=None, show_header=False, pad_edge=False, padding=(0, 1))
    out.add_column(style="cyan", no_wrap=True, min_width=12)
    out.add_column(overflow="fold")
    for heading, words in lines(told):
        out.add_row(f"  {heading}", Text(plain(words)))
    for number, (when, words) in enumerate(events(told, _MOST_EVENTS)):
        out.add_row("  events" if number == 0 else "", Text(f"{when:>8} {plain(words)}"))
    for number, can in enumerate(told.abilities):
        mark, style = ("yes", "green") if can.can else ("no ", "yellow")
        out.add_row("  twin can" if number == 0 else "", Text.assemble((mark, style), f" {can.name}: {plain(can.why)}"))
    if twin:
        out.add_row("  twin result", Text(plain(twin)))
    return out


def events(told: Findings, most: int) -> list[tuple[str, str]]:
    """Return the most severe events in time order and the number of others: (time, text)."""
    chosen = sorted(
        (event for event in told.events if event.kind != "item"), key=lambda event: (_NEWS.index(event.kind), event.t_s)
    )[:most]
    said = [
        (f"{e.t_s:.1f} s", e.text if e.kind == e.text else f"{e.kind}: {e.text}") for e in told.events if e in chosen
    ]
    left = Counter(event.kind for event in told.events if event not in chosen)
    if left or told.events_lost:
        more = ", ".join(f"{n} {kind}" for kind, n in left.items())
        said.append(("", f"and {left.total() + told.events_lost} more ({more}), see --json"))
    return said or [("", "none")]


def _who(told: Findings) -> str:
    kind = told.vehicle.replace("_", " ")
    return f"uav-{told.uav}, {kind}, {told.autopilot}, {told.firmware or 'firmware unknown'}"


def _time(told: Findings) -> str:
    begun = datetime.fromtimestamp(min(max(told.begun, 0.0), 4e9), UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    height = f", {told.altitude_m[0]:.0f} to {told.altitude_m[1]:.0f} m above MSL" if told.altitude_m else ""
    flown = (
        f"{told.airborne_s:.0f} s in the air, {told.distance_m / 1e3:.1f} km" if told.airborne_s else "never in the air"
    )
    return f"{told.seconds:.0f} s from {begun}; {flown}{height}"


def _link(told: Findings) -> str:
    jumps = f"{told.clock_jumps} clock jumps" if told.clock_jumps else "no clock jump"
    return f"{told.received:,} messages, {told.missed:,} missed, {told.rejected:,} rejected, {jumps}"


def _gaps(rows: dict[str, Kind]) -> str:
    said = [
        f"{name} {kind.gaps}, {kind.gap_s:.0f} s (longest {kind.longest.seconds:.1f} s at {kind.longest.start_s:.0f} s)"
        for name, kind in rows.items()
        if kind.longest is not None
    ]
    return ", ".join(said) or "none"


def _mission(told: Findings) -> str:
    flown = told.mission.flown
    shown = " ".join(map(str, flown[:_MANY])) + (f" … {flown[-1]}" if len(flown) > _MANY else "")
    sequence = f"active {shown}" if flown else "no active item reported"
    what = (
        f"{told.mission.items} items" + ("" if told.mission.complete else ", incomplete") if told.mission.items else ""
    )
    again = f"{told.mission.uploads} uploads" if told.mission.uploads > 1 else ""
    return "; ".join(filter(None, (what, told.mission.sentence, again, sequence)))


def _servos(told: Findings) -> str:
    said = []
    for servo in told.servos:
        name = f"{servo.channel} {servo.surface}".strip()
        if not servo.moves:
            said.append(f"{name} constant at {servo.low_us:.0f}")
            continue
        end = f" ({servo.saturated:.0%} saturated)" if servo.saturated >= 0.005 else ""
        said.append(f"{name} {servo.low_us:.0f} to {servo.high_us:.0f} us{end}")
    return ", ".join(said) or "no rows"


def _airspeed(told: Findings) -> str:
    air = told.airspeed
    sensor = {"yes": "sensor", "no": "no sensor"}.get(air.sensor, "sensor unknown")
    if air.median is None:
        return f"{sensor} ({air.how}), no rows"
    constant = ", constant" if air.constant else ""
    return f"{sensor} ({air.how}); {air.low:.1f} to {air.high:.1f} m/s, median {air.median:.1f}{constant}"


def _wind(told: Findings) -> str:
    if told.wind is None:
        return "not reported by the autopilot"
    wind = told.wind
    return (
        f"autopilot estimate {wind.speed:.1f} m/s from {wind.from_deg:.0f} deg, {wind.low:.1f} to {wind.high:.1f} m/s"
    )


def _twin(answer: dict[str, Any] | None, uav: int) -> str:
    """Describe the twin results of this aircraft; empty without any."""
    told = (answer or {}).get(str(uav))
    if not isinstance(told, dict):
        return ""
    methods = told.get("methods")
    made = ", ".join(f"{n} by {name}" for name, n in methods.items()) if isinstance(methods, dict) else ""
    first = told.get("first_verified_s")
    verified = f"verified after {first:.0f} s" if isinstance(first, int | float) else "never verified"
    return "; ".join(
        filter(None, (f"predictions: {made or 'none'}", verified, *_within(told), str(told.get("sentence", ""))))
    )


def _within(told: dict[str, Any]) -> list[str]:
    within = told.get("within")
    shares = {at: x for at, x in within.items() if isinstance(x, int | float)} if isinstance(within, dict) else {}
    said = ", ".join(f"{share:.0%} at {at} s" for at, share in shares.items())
    return [f"within 10 %: {said}"] if said else []


def spans(uavs: Iterable[int]) -> str:
    """Format ids as ranges: 0-3, 7."""
    parts: list[list[int]] = []
    for uav in sorted(uavs):
        if parts and parts[-1][1] == uav - 1:
            parts[-1][1] = uav
        else:
            parts.append([uav, uav])
    return ", ".join(f"{low}-{high}" if high > low else str(low) for low, high in parts)
