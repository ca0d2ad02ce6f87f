"""Survey of one recording: rows and events of each aircraft, collected in bounded memory."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from fleet.contract import COLUMNS, ROW_WIDTHS, Item, Link, Message, Mission, Params, Rows, Sample, Status
from fleet.frames import Origin
from fleet.telemetry.inspection.thinned import MAX_ROWS, DecimatedRows, TimeInterval, inside
from fleet.vehicles import UNKNOWN, VehicleClass, vehicle_class
from fleet.window import LONGEST_GAP

LINK_GAP_S = 3.0  # interval without any row that counts as a link gap [s]
MAX_EVENTS = 2_000
ROW_BUDGET = 5_000_000  # rows stored for all aircraft and fields
AIRBORNE_SPEED = 6.0  # a small fixed wing above this speed is in flight [m/s]
_AIRBORNE_HEIGHT = 5.0  # an armed aircraft this far above the lowest point is in flight [m]
ROTOR_AIRBORNE_SPEED, ROTOR_AIRBORNE_HEIGHT = 2.0, 1.5  # the same for aircraft that take off vertically [m/s, m]
_MIN_LANDING_S, _MIN_FLIGHT_S = 10.0, 5.0  # shorter landings and flights are ignored [s]
_AUTOMATIC_PARAMS = ("STAT_", "BARO1_GND_", "BARO2_GND_", "BARO3_GND_", "GND_ABS_")  # set by the autopilot


class SurveyEvent(NamedTuple):
    """One event: time [s since 1970], kind, text."""

    t: float
    kind: str  # mode, armed, disarmed, item, mission, parameter, text, clock, link or gap
    text: str


def _decimated_rows(name: str) -> DecimatedRows:
    dtype = "<f8" if name in ("position", "target", "gnss") else "<f4"
    return DecimatedRows(LONGEST_GAP.get(name, 1.0), MAX_ROWS, dtype)


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
    start_t: float
    kind: str = ""
    rows: dict[str, DecimatedRows] = field(default_factory=lambda: {name: _decimated_rows(name) for name in COLUMNS})
    newest_t: float = -np.inf
    rejected_fields: int = 0
    mode_changes: list[tuple[float, str]] = field(default_factory=list)
    arming_changes: list[tuple[float, bool]] = field(default_factory=list)
    status: Status | None = None
    mission: Mission | None = None
    mission_count: int = 0
    params: Params | None = None
    events: list[SurveyEvent] = field(default_factory=list)
    dropped_events: int = 0  # beyond `MAX_EVENTS`
    _current_item: int = -1
    _latest_text: str = ""
    _newest_sample_t: float = np.nan  # time of the newest sample [s since 1970]

    @property
    def vehicle(self) -> str:
        """Return the kind of vehicle, e.g. fixed_wing."""
        return self.status.vehicle if self.status else UNKNOWN

    @property
    def vehicle_class(self) -> VehicleClass:
        """Return the vehicle class."""
        return vehicle_class(self.vehicle)

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

    def add_event(self, t: float, kind: str, text: str) -> None:
        """Append an event, or count it as dropped beyond `MAX_EVENTS`."""
        if len(self.events) < MAX_EVENTS:
            self.events.append(SurveyEvent(t, kind, text))
        else:
            self.dropped_events += 1


def survey_recording(messages: Iterable[Message], kind: str = "") -> dict[int, Survey]:
    """Survey a complete recording.

    Args:
        messages: Sample, Status, Mission, Params in order of reception
        kind: kind of recording, as in `recordings.KINDS`
    Returns:
        survey of each aircraft, by UAV id
    """
    surveys: dict[int, Survey] = {}
    start_t = np.nan
    for message in messages:
        if not np.isfinite(message.t):
            continue
        start_t = message.t if np.isnan(start_t) else start_t
        if message.uav not in surveys:
            surveys[message.uav] = Survey(message.uav, start_t, kind)
            _distribute_budget(surveys)
        update(surveys[message.uav], message)
    for aircraft in surveys.values():
        aircraft.events.sort()
    return dict(sorted(surveys.items()))


def update(survey: Survey, message: Message) -> None:
    """Add one message of this aircraft."""
    survey.newest_t = max(survey.newest_t, message.t)
    if isinstance(message, Sample):
        _update_samples(survey, message)
    elif isinstance(message, Status):
        _update_status(survey, message)
    elif isinstance(message, Mission):
        if _mission_path(message) != _mission_path(survey.mission) or not survey.mission_count:
            survey.mission_count += bool(message.items)
            text = f"{len(message.items)} items" + ("" if message.complete else ", not all")
            survey.add_event(message.t, "mission", text)
        survey.mission = message
    elif isinstance(message, Params):
        _update_params(survey, message)


def _mission_path(mission: Mission | None) -> list[tuple[int, int, int, float]]:
    """Return command and position of all items but home; autopilots may change home, frames and unused parameters."""
    return [(i.command, i.lat_e7, i.lon_e7, i.alt_m) for i in (mission.items[1:] if mission else ())]


def _distribute_budget(surveys: dict[int, Survey]) -> None:
    max_rows = max(min(MAX_ROWS, ROW_BUDGET // (len(COLUMNS) * len(surveys))), 1_000)
    for survey in surveys.values():
        for rows in survey.rows.values():
            rows.max_rows = max_rows


def _update_samples(survey: Survey, sample: Sample) -> None:
    if sample.t - survey._newest_sample_t > LINK_GAP_S:
        survey.add_event(survey._newest_sample_t, "gap", f"no row for {sample.t - survey._newest_sample_t:.1f} s")
    survey._newest_sample_t = sample.t
    for name, decimated in survey.rows.items():
        rows: Rows | None = getattr(sample, name)
        if rows is None:
            continue
        try:
            t, x = rows.t.numpy(), rows.x.numpy()
            valid = t.ndim == 1 and x.ndim == 2 and len(x) == len(t) and x.shape[1] in ROW_WIDTHS[name]
        except ValueError:
            valid = False
        if not valid:
            survey.rejected_fields += 1
            continue
        decimated.add(t, x)
        if name == "leg":
            _update_item(survey, t, x[:, 0])


def _update_item(survey: Survey, t: np.ndarray, seq: np.ndarray) -> None:
    for item_t, item_seq in zip(t.tolist(), seq.tolist(), strict=True):
        if item_seq >= 0 and item_seq != survey._current_item:
            survey._current_item = int(item_seq)
            survey.add_event(item_t, "item", f"item {survey._current_item}")


def _update_status(survey: Survey, status: Status) -> None:
    previous, survey.status = survey.status, status
    if status.mode and (not survey.mode_changes or survey.mode_changes[-1][1] != status.mode):
        survey.mode_changes.append((status.t, status.mode))
        survey.add_event(status.t, "mode", status.mode)
    if not survey.arming_changes or survey.arming_changes[-1][1] != status.armed:
        if survey.arming_changes or status.armed:
            kind = "armed" if status.armed else "disarmed"
            survey.add_event(status.t, kind, kind)
        survey.arming_changes.append((status.t, status.armed))
    if status.clock_jumps > (previous.clock_jumps if previous else 0):
        survey.add_event(status.t, "clock", "the aircraft's clock jumped")
    if previous and status.link is not previous.link:
        survey.add_event(status.t, "link", "link lost" if status.link is Link.LOST else "link back")
    if status.sentence != survey._latest_text and status.link is Link.LIVE:
        survey._latest_text = status.sentence
        if status.sentence:
            survey.add_event(status.t, "text", status.sentence.removeprefix(f"uav-{survey.uav}: "))


def _update_params(survey: Survey, params: Params) -> None:
    previous = survey.values
    changed = [
        f"{name} {previous[name]:g} to {value:g}"
        for name, value in params.values.items()
        if name in previous and previous[name] != value and not name.startswith(_AUTOMATIC_PARAMS)
    ]
    if changed and survey.arming_changes and survey.arming_changes[-1][1]:
        remainder = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
        survey.add_event(params.t, "parameter", ", ".join(changed[:3]) + remainder)
    survey.params = params


def armed_spans(survey: Survey) -> list[TimeInterval]:
    """Return the armed intervals, or the complete recording if the arming state is unknown."""
    if not any(armed for _, armed in survey.arming_changes):
        return [TimeInterval(survey.start_t, survey.newest_t)]
    ends = [*(t for t, _ in survey.arming_changes[1:]), survey.newest_t]
    return [TimeInterval(t, stop) for (t, armed), stop in zip(survey.arming_changes, ends, strict=True) if armed]


def airborne(survey: Survey) -> list[TimeInterval]:
    """Return the flight intervals, derived from speed and height."""
    velocity_t, velocity = survey.rows["velocity"].rows()
    position_t, position = survey.rows["position"].rows()
    if not len(velocity_t) or not len(position_t):
        return []
    vertical_takeoff = survey.vehicle_class.can_hover
    min_speed = ROTOR_AIRBORNE_SPEED if vertical_takeoff else AIRBORNE_SPEED
    min_height = ROTOR_AIRBORNE_HEIGHT if vertical_takeoff else _AIRBORNE_HEIGHT
    armed = inside(velocity_t, armed_spans(survey))
    flying = armed & (np.linalg.norm(velocity, axis=1) > min_speed)
    if armed.any() and any(is_armed for _, is_armed in survey.arming_changes):
        height = np.interp(velocity_t, position_t, position[:, 2]) * 1e-3
        flying |= armed & (height - np.percentile(height[armed], 1) > min_height)
        height_t, above_home = survey.rows["height"].rows()
        if vertical_takeoff and len(height_t):  # covers a recording that is one long hover
            flying |= armed & (np.interp(velocity_t, height_t, above_home[:, 0]) > min_height)
    return _merge_spans(velocity_t, flying)


def _merge_spans(t: np.ndarray, mask: np.ndarray) -> list[TimeInterval]:
    """Merge intervals separated by short pauses, and drop short intervals."""
    spans: list[TimeInterval] = []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    for start, stop in zip(t[edges[::2]].tolist(), t[edges[1::2] - 1].tolist(), strict=True):
        if spans and start - spans[-1].stop < _MIN_LANDING_S:
            spans[-1] = TimeInterval(spans[-1].start, stop)
        else:
            spans.append(TimeInterval(start, stop))
    return [span for span in spans if span.seconds >= _MIN_FLIGHT_S]


def mode_spans(survey: Survey) -> list[tuple[TimeInterval, str]]:
    """Return each mode with its interval."""
    if not survey.mode_changes:
        return []
    ends = [*(t for t, _ in survey.mode_changes[1:]), survey.newest_t]
    return [(TimeInterval(t, stop), mode) for (t, mode), stop in zip(survey.mode_changes, ends, strict=True)]
