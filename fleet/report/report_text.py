"""Text tables of an inspected recording, with the same figures as the JSON output."""

from __future__ import annotations  # findings are needed for their types alone: `--help` imports no numba

from collections import Counter
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from fleet.process.sanitise import printable

if TYPE_CHECKING:
    from fleet.telemetry.inspection.findings import AircraftFindings, FileFindings, RowStatistics

_MAX_EVENTS = 14
_EVENT_PRIORITY = ("text", "clock", "link", "gap", "parameter", "disarmed", "armed", "mission", "mode")
"""Most severe first; mission items are listed with the mission."""
_MAX_ITEMS = 12  # most mission items listed


def table(file: FileFindings) -> RenderableType:
    """Return the tables of one recording, one per aircraft."""
    parts: list[RenderableType] = [Text(f"{printable(file.file)}  {file.bytes / 1e6:.1f} MB", style="bold")]
    parts += [Text(f"  {printable(sentence)}", style="red") for sentence in file.sentences]
    for findings in file.aircraft:
        parts += [_aircraft(findings, _twin_text(file.twin, findings.uav)), Text("")]
    if file.twin and "sentence" in file.twin:
        parts.append(Text(f"  twin: {printable(str(file.twin['sentence']))}", style="red"))
    return Group(*parts)


def summary_lines(findings: AircraftFindings) -> list[tuple[str, str]]:
    """Return the summary without events and abilities: (heading, text)."""
    from fleet.telemetry.inspection.findings import mode_seconds

    vehicle, firmware = findings.vehicle.replace("_", " "), findings.firmware or "firmware unknown"
    jumps = f"{findings.clock_jumps} clock jumps" if findings.clock_jumps else "no clock jump"
    rows = findings.rows.items()
    modes = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in mode_seconds(findings).items())
    return [
        ("aircraft", f"uav-{findings.uav}, {vehicle}, {findings.autopilot}, {firmware}"),
        ("time", _time(findings)),
        (
            "link",
            f"{findings.received:,} messages, {findings.missed:,} missed, {findings.rejected:,} rejected, {jumps}",
        ),
        ("modes", modes or "none reported"),
        ("rows", ", ".join(f"{name} {kind.rate_hz:.1f} Hz" for name, kind in rows if kind.rows)),
        ("no rows of", ", ".join(name for name, kind in rows if not kind.rows) or "none missing"),
        ("gaps", _gaps(findings.rows)),
        ("mission", _mission(findings)),
        ("parameters", f"{findings.params:,}" + (", complete" if findings.params_complete else ", incomplete")),
        ("servo map", findings.servo_map),
        ("servos", _servos(findings)),
        ("airspeed", _airspeed(findings)),
        ("wind", _wind(findings)),
    ]


def _aircraft(findings: AircraftFindings, twin: str) -> Table:
    out = Table(box=None, show_header=False, pad_edge=False, padding=(0, 1))
    out.add_column(style="cyan", no_wrap=True, min_width=12)
    out.add_column(overflow="fold")
    for heading, text in summary_lines(findings):
        out.add_row(f"  {heading}", Text(printable(text)))
    for number, (when, text) in enumerate(events(findings, _MAX_EVENTS)):
        out.add_row("  events" if number == 0 else "", Text(f"{when:>8} {printable(text)}"))
    for number, ability in enumerate(findings.abilities):
        mark, style = ("yes", "green") if ability.can else ("no ", "yellow")
        verdict = Text.assemble((mark, style), f" {ability.name}: {printable(ability.why)}")
        out.add_row("  twin can" if number == 0 else "", verdict)
    if twin:
        out.add_row("  twin result", Text(printable(twin)))
    return out


def events(findings: AircraftFindings, limit: int) -> list[tuple[str, str]]:
    """Return the most severe events in time order and the number of others: (time, text)."""
    candidates = [event for event in findings.events if event.kind != "item"]
    selected = sorted(candidates, key=lambda event: (_EVENT_PRIORITY.index(event.kind), event.t_s))[:limit]
    shown = [event for event in findings.events if event in selected]
    rows = [(f"{e.t_s:.1f} s", e.text if e.kind == e.text else f"{e.kind}: {e.text}") for e in shown]
    remaining = Counter(event.kind for event in findings.events if event not in selected)
    if remaining or findings.events_lost:
        more = ", ".join(f"{n} {kind}" for kind, n in remaining.items())
        rows.append(("", f"and {remaining.total() + findings.events_lost} more ({more}), see --json"))
    return rows or [("", "none")]


def _time(findings: AircraftFindings) -> str:
    begun = datetime.fromtimestamp(min(max(findings.begun, 0.0), 4e9), UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    text = f"{findings.seconds:.0f} s from {begun}; "
    if findings.airborne_s:
        text += f"{findings.airborne_s:.0f} s in the air, {findings.distance_m / 1e3:.1f} km"
    else:
        text += "never in the air"
    if findings.altitude_m:
        text += f", {findings.altitude_m[0]:.0f} to {findings.altitude_m[1]:.0f} m above MSL"
    return text


def _gaps(rows: dict[str, RowStatistics]) -> str:
    texts = [
        f"{name} {kind.gaps}, {kind.gap_s:.0f} s (longest {kind.longest.seconds:.1f} s at {kind.longest.start_s:.0f} s)"
        for name, kind in rows.items()
        if kind.longest is not None
    ]
    return ", ".join(texts) or "none"


def _mission(findings: AircraftFindings) -> str:
    mission, active = findings.mission, findings.mission.flown
    last = f" … {active[-1]}" if len(active) > _MAX_ITEMS else ""
    sequence = f"active {' '.join(map(str, active[:_MAX_ITEMS]))}{last}" if active else "no active item reported"
    count = f"{mission.items} items" + ("" if mission.complete else ", incomplete") if mission.items else ""
    uploads = f"{mission.uploads} uploads" if mission.uploads > 1 else ""
    return "; ".join(filter(None, (count, mission.sentence, uploads, sequence)))


def _servos(findings: AircraftFindings) -> str:
    texts = []
    for servo in findings.servos:
        name = f"{servo.channel} {servo.surface}".strip()
        if not servo.moves:
            texts.append(f"{name} constant at {servo.low_us:.0f}")
            continue
        end = f" ({servo.saturated:.0%} saturated)" if servo.saturated >= 0.005 else ""
        texts.append(f"{name} {servo.low_us:.0f} to {servo.high_us:.0f} us{end}")
    return ", ".join(texts) or "no rows"


def _airspeed(findings: AircraftFindings) -> str:
    air = findings.airspeed
    sensor = {"yes": "sensor", "no": "no sensor"}.get(air.sensor, "sensor unknown")
    if air.median is None:
        return f"{sensor} ({air.how}), no rows"
    constant = ", constant" if air.constant else ""
    return f"{sensor} ({air.how}); {air.low:.1f} to {air.high:.1f} m/s, median {air.median:.1f}{constant}"


def _wind(findings: AircraftFindings) -> str:
    if findings.wind is None:
        return "not reported by the autopilot"
    speed, low, high = findings.wind.speed, findings.wind.low, findings.wind.high
    return f"autopilot estimate {speed:.1f} m/s from {findings.wind.from_deg:.0f} deg, {low:.1f} to {high:.1f} m/s"


def _twin_text(answer: dict[str, Any] | None, uav: int) -> str:
    """Describe the twin results of this aircraft; empty without any."""
    result = (answer or {}).get(str(uav))
    if not isinstance(result, dict):
        return ""
    methods = result.get("methods")
    predictions = ", ".join(f"{n} by {name}" for name, n in methods.items()) if isinstance(methods, dict) else ""
    first = result.get("first_verified_s")
    verified = f"verified after {first:.0f} s" if isinstance(first, int | float) else "never verified"
    within = result.get("within")
    shares = {at: x for at, x in within.items() if isinstance(x, int | float)} if isinstance(within, dict) else {}
    shares_text = ", ".join(f"{share:.0%} at {at} s" for at, share in shares.items())
    accuracy = f"within 10 %: {shares_text}" if shares_text else ""
    texts = (f"predictions: {predictions or 'none'}", verified, accuracy, str(result.get("sentence", "")))
    return "; ".join(filter(None, texts))


def id_ranges(uavs: Iterable[int]) -> str:
    """Format ids as ranges: 0-3, 7."""
    parts: list[list[int]] = []
    for uav in sorted(uavs):
        if parts and parts[-1][1] == uav - 1:
            parts[-1][1] = uav
        else:
            parts.append([uav, uav])
    return ", ".join(f"{low}-{high}" if high > low else str(low) for low, high in parts)
