"""Survey of one recording: rows and events of each aircraft, collected in bounded memory."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from fleet.contract import COLUMNS, Item, Link, Message, Mission, Params, Rows, Sample, Status
from fleet.frames import Origin
from fleet.telemetry.inspection.thinned import MOST, Span, Thinned, inside

LONGEST_S = {
    "attitude": 0.5,
    "velocity": 1.0,
    "servo": 0.5,
    "position": 1.0,
}  # longest interval that the twin interpolates [s]
SILENT_S = 3.0  # interval without any row that counts as a link gap [s]
MOST_EVENTS = 2_000
BUDGET = 5_000_000  # rows stored for all aircraft and fields
FAST = 6.0  # a small fixed wing above this speed is in flight [m/s]
_HIGH = 5.0  # an armed aircraft this far above the lowest point is in flight [m]
ROTORS = ("multirotor", "helicopter", "quadplane")
ROTORS_FAST, ROTORS_HIGH = 2.0, 1.5  # the same for aircraft that take off vertically [m/s, m]
_BRIDGE_S, _HOP_S = 10.0, 5.0  # shorter landings and flights are ignored [s]
_BY_ITSELF = ("STAT_", "BARO1_GND_", "BARO2_GND_", "BARO3_GND_", "GND_ABS_")  # set by the autopilot


class Event(NamedTuple):
    """One event: time [s since 1970], kind, text."""

    t: float
    kind: str  # mode, armed, disarmed, item, mission, parameter, text, clock, link or gap
    text: str


def _thinned(name: str) -> Thinned:
    return Thinned(LONGEST_S.get(name, 1.0), MOST, "<f8" if name in ("position", "target", "gnss") else "<f4")


@dataclass
class Survey:
    """Rows and events of one aircraft; `update` adds messages.

    Attributes:
        uav: UAV id
        start_t: start of the recording [s since 1970]
        kind: kind of recording, as in `recordings.KINDS`; empty if unknown
        rows: measurements by field, as in `contract.COLUMNS`
        rejected_fields: number of message fields that violate the contract
        mode_changes: (start [s since 1970], mode) in order of time
        arming_changes: (start [s since 1970], armed) in order of time
        status, mission, params: the newest of each
        mission_count: number of item lists that differ from the previous one
    """

    uav: int
    begun: float
    kind: str = ""
    rows: dict[str, Thinned] = field(default_factory=lambda: {name: _thinned(name) for name in COLUMNS})
    newest: float = -np.inf
    refused: int = 0
    modes: list[tuple[float, str]] = field(default_factory=list)
    armings: list[tuple[float, bool]] = field(default_factory=list)
    status: Status | None = None
    mission: Mission | None = None
    missions: int = 0
    params: Params | None = None
    events: list[Event] = field(default_factory=list)
    lost_events: int = 0  # beyond `MAX_EVENTS`
    _seq: int = -1
    _sentence: str = ""
    _heard: float = np.nan  # time of the newest sample [s since 1970]

    @property
    def vehicle(self) -> str:
        """Return the kind of vehicle, e.g. fixed_wing."""
        return self.status.vehicle if self.status else "unknown"

    @property
    def items(self) -> tuple[Item, ...]:
        """Return the items of the last mission."""
        return self.mission.items if self.mission else ()

    @property
    def values(self) -> dict[str, float]:
        """Return the autopilot parameters by name."""
        return self.params.values if self.params else {}

    def origin(self) -> Origin | None:
        """Return the first position as the origin of a local frame; None without positions."""
        _, x = self.rows["position"].rows()
        return Origin(*(int(v) for v in x[0])) if len(x) else None

    def note(self, t: float, kind: str, text: str) -> None:
        """Append an event, or count it as dropped beyond `MAX_EVENTS`."""
        if len(self.events) < MOST_EVENTS:
            self.events.append(Event(t, kind, text))
        else:
            self.lost_events += 1


def survey(messages: Iterable[Message], kind: str = "") -> dict[int, Survey]:
    """Survey a complete recording.

    Args:
        messages: Sample, Status, Mission, Params in order of reception
        kind: kind of recording, as in `recordings.KINDS`
    Returns:
        survey of each aircraft, by UAV id
    """
    found: dict[int, Survey] = {}
    begun = np.nan
    for message in messages:
        if not np.isfinite(message.t):
            continue
        begun = message.t if np.isnan(begun) else begun
        if message.uav not in found:
            found[message.uav] = Survey(message.uav, begun, kind)
            _share(found)
        hear(found[message.uav], message)
    for each in found.values():
        each.events.sort()
    return dict(sorted(found.items()))


def hear(known: Survey, message: Message) -> None:
    """Add one message of this aircraft."""
    known.newest = max(known.newest, message.t)
    if isinstance(message, Sample):
        _hear_sample(known, message)
    elif isinstance(message, Status):
        _hear_status(known, message)
    elif isinstance(message, Mission):
        if _course(message) != _course(known.mission) or not known.missions:
            known.missions += bool(message.items)
            known.note(message.t, "mission", f"{len(message.items)} items" + ("" if message.complete else ", not all"))
        known.mission = message
    elif isinstance(message, Params):
        _hear_params(known, message)


def _course(mission: Mission | None) -> list[tuple[int, int, int, float]]:
    """Return command and position of all items but home; autopilots may change home, frames and unused parameters."""
    return [(i.command, i.lat_e7, i.lon_e7, i.alt_m) for i in (mission.items[1:] if mission else ())]


def _share(found: dict[int, Survey]) -> None:
    """Distribute the row budget equally over the aircraft."""
    most = max(min(MOST, BUDGET // (len(COLUMNS) * len(found))), 1_000)
    for each in found.values():
        for kind in each.rows.values():
            kind.most = most


def _hear_sample(known: Survey, sample: Sample) -> None:
    if sample.t - known._heard > SILENT_S:
        known.note(known._heard, "gap", f"no row for {sample.t - known._heard:.1f} s")
    known._heard = sample.t
    for name, kind in known.rows.items():
        rows: Rows | None = getattr(sample, name)
        if rows is None:
            continue
        try:
            t, x = rows.t.numpy(), rows.x.numpy()
        except ValueError:
            known.refused += 1
            continue
        if x.ndim != 2 or t.shape != x.shape[:1] or x.shape[1] != len(COLUMNS[name]):
            known.refused += 1
            continue
        kind.add(t, x)
        if name == "leg":
            _follow(known, t, x[:, 0])


def _follow(known: Survey, t: np.ndarray, seq: np.ndarray) -> None:
    for at, number in zip(t.tolist(), seq.tolist(), strict=True):
        if number >= 0 and number != known._seq:
            known._seq = int(number)
            known.note(at, "item", f"item {known._seq}")


def _hear_status(known: Survey, status: Status) -> None:
    before, known.status = known.status, status
    if status.mode and (not known.modes or known.modes[-1][1] != status.mode):
        known.modes.append((status.t, status.mode))
        known.note(status.t, "mode", status.mode)
    if not known.armings or known.armings[-1][1] != status.armed:
        if known.armings or status.armed:
            known.note(status.t, "armed" if status.armed else "disarmed", "armed" if status.armed else "disarmed")
        known.armings.append((status.t, status.armed))
    if status.clock_jumps > (before.clock_jumps if before else 0):
        known.note(status.t, "clock", "the aircraft's clock jumped")
    if before and status.link is not before.link:
        known.note(status.t, "link", "link lost" if status.link is Link.LOST else "link back")
    if status.sentence != known._sentence and status.link is Link.LIVE:
        known._sentence = status.sentence
        if status.sentence:
            known.note(status.t, "text", status.sentence.removeprefix(f"uav-{known.uav}: "))


def _hear_params(known: Survey, params: Params) -> None:
    before = known.values
    changed = {n: v for n, v in params.values.items() if before.get(n, v) != v and not n.startswith(_BY_ITSELF)}
    if changed and known.armings and known.armings[-1][1]:
        said = [f"{name} {before[name]:g} to {value:g}" for name, value in list(changed.items())[:3]]
        more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
        known.note(params.t, "parameter", ", ".join(said) + more)
    known.params = params


def armed_spans(known: Survey) -> list[Span]:
    """Return the armed intervals, or the complete recording if the arming state is unknown."""
    if not any(armed for _, armed in known.armings):
        return [Span(known.begun, known.newest)]
    ends = [*(t for t, _ in known.armings[1:]), known.newest]
    return [Span(t, stop) for (t, armed), stop in zip(known.armings, ends, strict=True) if armed]


def airborne(known: Survey) -> list[Span]:
    """Return the flight intervals, derived from speed and height."""
    t_v, v = known.rows["velocity"].rows()
    t_p, p = known.rows["position"].rows()
    if not len(t_v) or not len(t_p):
        return []
    rotors = known.vehicle in ROTORS
    fast, high = (ROTORS_FAST, ROTORS_HIGH) if rotors else (FAST, _HIGH)
    armed = inside(t_v, armed_spans(known))
    flying = armed & (np.linalg.norm(v, axis=1) > fast)
    if armed.any() and any(on for _, on in known.armings):
        height = np.interp(t_v, t_p, p[:, 2]) * 1e-3
        flying |= armed & (height - np.percentile(height[armed], 1) > high)
        t_h, above_home = known.rows["height"].rows()
        if rotors and len(t_h):  # covers a recording that is one long hover
            flying |= armed & (np.interp(t_v, t_h, above_home[:, 0]) > high)
    return _bridged(t_v, flying)


def _bridged(t: np.ndarray, on: np.ndarray) -> list[Span]:
    """Merge intervals separated by short pauses, and drop short intervals."""
    spans: list[Span] = []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    for start, stop in zip(t[edges[::2]].tolist(), t[edges[1::2] - 1].tolist(), strict=True):
        if spans and start - spans[-1].stop < _BRIDGE_S:
            spans[-1] = Span(spans[-1].start, stop)
        else:
            spans.append(Span(start, stop))
    return [span for span in spans if span.seconds >= _HOP_S]


def spells(known: Survey) -> list[tuple[Span, str]]:
    """Return each mode with its interval."""
    if not known.modes:
        return []
    ends = [*(t for t, _ in known.modes[1:]), known.newest]
    return [(Span(t, stop), mode) for (t, mode), stop in zip(known.modes, ends, strict=True)]
