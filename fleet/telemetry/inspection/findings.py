"""Figures that `fleet inspect` reports for each aircraft: the keys of its JSON with their units."""

from collections import Counter
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from fleet.airframes.airframe import SERVO_COUNT, servo_map
from fleet.contract import COLUMNS
from fleet.frames import to_ned
from fleet.telemetry.inspection.abilities import AbilityResult, abilities
from fleet.telemetry.inspection.survey import Survey, SurveyEvent, airborne, mode_spans
from fleet.telemetry.inspection.thinned import inside, seconds

_SURFACES = {4: "aileron", 19: "elevator", 21: "rudder", 70: "throttle", 77: "left elevon", 78: "right elevon"}
_SURFACES |= {79: "left V-tail", 80: "right V-tail", 24: "left flaperon", 25: "right flaperon"}
_SURFACES |= {73: "left throttle", 74: "right throttle"}
_SURFACES |= {33 + n: f"motor {n + 1}" for n in range(8)} | {82 + n: f"motor {n + 9}" for n in range(4)}
_PX4_SURFACES = {101 + n: f"motor {n + 1}" for n in range(12)}  # PWM_MAIN_FUNCn, PWM_AUX_FUNCn
_PX4_PORTS = (("PWM_MAIN_FUNC", 0), ("PWM_AUX_FUNC", 8))  # parameter, number of outputs before its first
_DEFAULT_SURFACES = {1: "aileron", 2: "elevator", 3: "throttle", 4: "rudder"}
_MOTOR_COUNT = {1: 4, 2: 6, 3: 8, 4: 8, 5: 6, 7: 3}  # by FRAME_CLASS: quad, hexa, octo, octaquad, Y6, tri
_MOTORS_ASSUMED = "motors assumed (no SERVOn_FUNCTION)"
_MIN_STD_US = 5.0  # standard deviation below which a channel is constant [us]
_SATURATION_US = 1.0  # distance from SERVOn_MIN or _MAX below which a channel is saturated [us]
_MIN_AIRSPEED_STD = 0.05  # standard deviation below which airspeed is constant [m/s]
_MAX_SEVERITY = 3  # MAV_SEVERITY_ERROR; a lower number is more severe
_SENSOR_PARAMS = ("ARSPD_TYPE", "ARSPD_ENABLE", "SYS_HAS_NUM_ASPD")  # parameters that configure an airspeed sensor
_SENSOR_MESSAGES = ("AIRSPEED", "AIRSPEED_AUTOCAL")  # messages that an autopilot sends only with an airspeed sensor


class LinkTexts(NamedTuple):
    """Data outside contract messages: firmware, and texts with time [s since 1970] and severity."""

    firmware: str = ""
    texts: tuple[tuple[float, int, str], ...] = ()


class ModeInterval(msgspec.Struct, frozen=True):
    """One interval of one flight mode."""

    mode: str
    start_s: Annotated[float, Meta(description="start, since the start of the recording [s]")]
    seconds: Annotated[float, Meta(description="duration [s]")]


class GapInterval(msgspec.Struct, frozen=True):
    """One interval without rows."""

    start_s: Annotated[float, Meta(description="start, since the start of the recording [s]")]
    seconds: Annotated[float, Meta(description="duration [s]")]


class RowStatistics(msgspec.Struct, frozen=True):
    """Statistics of the rows of one field."""

    rows: Annotated[int, Meta(description="number of rows")]
    rate_hz: Annotated[float, Meta(description="mean rate outside gaps [Hz]")]
    gaps: Annotated[int, Meta(description="intervals over 3 times the median, too long to interpolate; at most 1,000")]
    gap_s: Annotated[float, Meta(description="total duration of the gaps [s]")]
    longest: Annotated[GapInterval | None, Meta(description="the longest gap")] = None


class ServoStatistics(msgspec.Struct, frozen=True):
    """One output channel, in flight if the aircraft flew, else over the whole recording."""

    channel: int
    surface: Annotated[str, Meta(description="control surface or motor by the servo map, or empty")]
    low_us: Annotated[float, Meta(description="minimum pulse width [us]")]
    high_us: Annotated[float, Meta(description="maximum pulse width [us]")]
    moves: Annotated[bool, Meta(description="standard deviation above 5 us")]
    saturated: Annotated[float, Meta(description="fraction of the time at SERVOn_MIN or _MAX, 0..1")]


class AirspeedStatistics(msgspec.Struct, frozen=True):
    """Airspeed reported by the autopilot, in flight if the aircraft flew."""

    sensor: Annotated[str, Meta(description="yes, no or unknown")]
    how: Annotated[str, Meta(description="evidence for `sensor`")]
    low: Annotated[float | None, Meta(description="5th percentile [m/s]; null without rows")] = None
    median: Annotated[float | None, Meta(description="[m/s]")] = None
    high: Annotated[float | None, Meta(description="95th percentile [m/s]")] = None
    constant: Annotated[bool, Meta(description="standard deviation below 0.05 m/s")] = False


class WindStatistics(msgspec.Struct, frozen=True):
    """Wind reported by the autopilot, in flight if the aircraft flew."""

    speed: Annotated[float, Meta(description="speed of the mean wind [m/s]")]
    from_deg: Annotated[float, Meta(description="direction the mean wind comes from [deg]")]
    low: Annotated[float, Meta(description="5th percentile of the speed [m/s]")]
    high: Annotated[float, Meta(description="95th percentile of the speed [m/s]")]


class MissionStatistics(msgspec.Struct, frozen=True):
    """The last mission of the recording."""

    items: int = 0
    complete: bool = False
    uploads: Annotated[int, Meta(description="number of different item lists")] = 0
    flown: Annotated[tuple[int, ...], Meta(description="active items in order of time")] = ()
    sentence: Annotated[str, Meta(description="problem with the mission, or empty")] = ""


class TimedEvent(msgspec.Struct, frozen=True):
    """One event."""

    t_s: Annotated[float, Meta(description="time since the start of the recording [s]")]
    kind: Annotated[str, Meta(description="mode, armed, disarmed, item, mission, parameter, text, clock, link or gap")]
    text: str


class AircraftFindings(msgspec.Struct, frozen=True, kw_only=True):
    """One aircraft of one recording; fields may be added, existing fields keep their meaning."""

    uav: Annotated[int, Meta(description="UAV id")]
    vehicle: Annotated[str, Meta(description="fixed_wing, quadplane, multirotor, helicopter or unknown")]
    autopilot: Annotated[str, Meta(description="ardupilot, px4 or generic")]
    firmware: Annotated[str, Meta(description="firmware as the autopilot reports it, or empty")]
    begun: Annotated[float, Meta(description="start of the recording [s since 1970]")]
    seconds: Annotated[float, Meta(description="duration of the recording [s]")]
    airborne_s: Annotated[float, Meta(description="time in flight, from speed and height [s]")]
    distance_m: Annotated[float, Meta(description="length of the ground track in flight [m]")]
    altitude_m: Annotated[
        tuple[float, float] | None, Meta(description="minimum and maximum in flight, above mean sea level [m]")
    ] = None
    received: Annotated[int, Meta(description="messages received")] = 0
    missed: Annotated[int, Meta(description="messages lost, from gaps in the sequence number")] = 0
    rejected: Annotated[int, Meta(description="messages or fields rejected")] = 0
    clock_jumps: int = 0
    modes: tuple[ModeInterval, ...] = ()
    rows: Annotated[dict[str, RowStatistics], Meta(description="by field, as in `fleet schema sample`")] = {}
    mission: MissionStatistics = MissionStatistics()
    params: Annotated[int, Meta(description="parameters received")] = 0
    params_complete: bool = False
    servo_map: Annotated[str, Meta(description="assignment of output channels to control surfaces or motors")] = ""
    servos: tuple[ServoStatistics, ...] = ()
    airspeed: AirspeedStatistics = AirspeedStatistics("unknown", "")
    wind: Annotated[WindStatistics | None, Meta(description="null if the autopilot reports no wind")] = None
    events: tuple[TimedEvent, ...] = ()
    events_lost: Annotated[int, Meta(description="events beyond the maximum number")] = 0
    abilities: tuple[AbilityResult, ...] = ()


class FileFindings(msgspec.Struct, frozen=True, kw_only=True):
    """One recording; `fleet inspect --json` writes a list of these under the key `files`."""

    file: str
    bytes: int = 0
    sentences: Annotated[tuple[str, ...], Meta(description="data that was skipped, damaged or unreadable")] = ()
    aircraft: tuple[AircraftFindings, ...] = ()
    twin: Annotated[dict[str, Any] | None, Meta(description="with --twin: results of a twin, by UAV id")] = None


def compute_findings(survey: Survey, link_texts: LinkTexts) -> AircraftFindings:
    """Compute the figures of one aircraft from its survey."""
    status, in_air = survey.status, airborne(survey)
    return AircraftFindings(
        uav=survey.uav,
        vehicle=survey.vehicle,
        autopilot=status.autopilot if status else "generic",
        firmware=link_texts.firmware,
        begun=survey.start_t,
        seconds=round(survey.newest_t - survey.start_t, 1),
        airborne_s=round(seconds(in_air), 1),
        distance_m=_distance(survey),
        altitude_m=_altitude(survey),
        received=status.received if status else 0,
        missed=status.missed if status else 0,
        rejected=(status.rejected if status else 0) + survey.rejected_fields,
        clock_jumps=status.clock_jumps if status else 0,
        modes=tuple(
            ModeInterval(mode, _relative_s(survey, span.start), round(span.seconds, 1))
            for span, mode in mode_spans(survey)
        ),
        rows={name: _row_statistics(survey, name) for name in COLUMNS},
        mission=_mission(survey),
        params=len(survey.values),
        params_complete=survey.params.complete if survey.params else False,
        servo_map=_servo_map_text(survey),
        servos=_servos(survey),
        airspeed=_airspeed(survey),
        wind=_wind(survey),
        events=tuple(
            TimedEvent(_relative_s(survey, event.t), event.kind, event.text)
            for event in merged_events(survey, link_texts)
        ),
        events_lost=survey.dropped_events,
        abilities=tuple(abilities(survey)),
    )


def merged_events(survey: Survey, link_texts: LinkTexts) -> list[SurveyEvent]:
    """Return the events and severe texts in time order, without duplicate texts."""
    shown = [(t, text.strip()) for t, severity, text in link_texts.texts if severity <= _MAX_SEVERITY]
    severe = [SurveyEvent(t, "text", text) for t, text in shown]
    texts = {event.text for event in severe}
    other = [event for event in survey.events if event.kind != "text" or event.text.strip() not in texts]
    return sorted(other + severe)


def _relative_s(survey: Survey, t: float) -> float:
    return max(round(t - survey.start_t, 1), 0.0)


def _rows_in_air(survey: Survey, name: str) -> np.ndarray:
    """Return the rows of one field in flight, or all rows if the aircraft never flew."""
    t, x = survey.rows[name].rows()
    selected = inside(t, airborne(survey))
    return x[selected] if selected.any() else x


def _distance(survey: Survey) -> float:
    t, x = survey.rows["position"].rows()
    origin, total = survey.origin(), 0.0
    for span in airborne(survey):
        path = x[(t >= span.start) & (t <= span.stop)]
        if origin is not None and len(path) > 1:
            total += float(np.linalg.norm(np.diff(to_ned(origin, *path.T)[:, :2], axis=0), axis=1).sum())
    return round(total)


def _altitude(survey: Survey) -> tuple[float, float] | None:
    x = _rows_in_air(survey, "position")
    return (round(float(x[:, 2].min()) * 1e-3, 1), round(float(x[:, 2].max()) * 1e-3, 1)) if len(x) else None


def _row_statistics(survey: Survey, name: str) -> RowStatistics:
    rows = survey.rows[name]
    gaps = rows.gaps()
    longest = None
    if gaps:
        span = max(gaps, key=lambda gap: gap.seconds)
        longest = GapInterval(_relative_s(survey, span.start), round(span.seconds, 2))
    return RowStatistics(rows.count, round(rows.rate_hz, 2), len(gaps), round(seconds(gaps), 1), longest)


def _mission(survey: Survey) -> MissionStatistics:
    flown = tuple(int(event.text.split()[1]) for event in survey.events if event.kind == "item")
    mission = survey.mission
    if mission is None:
        return MissionStatistics(sentence="no mission list in the recording", flown=flown)
    return MissionStatistics(len(mission.items), mission.complete, survey.mission_count, flown, mission.sentence)


def _surfaces(survey: Survey) -> tuple[dict[int, str], str]:
    """Return the control surface or motor of each output, and what was assumed about a rotorcraft."""
    surfaces = {
        n: surface
        for n in range(1, SERVO_COUNT + 1)
        if (surface := _SURFACES.get(int(survey.values.get(f"SERVO{n}_FUNCTION", -1))))
    }
    for parameter, before in _PX4_PORTS:
        numbers = {before + n: int(survey.values.get(f"{parameter}{n}", 0)) for n in range(1, 9)}
        surfaces |= {n: _PX4_SURFACES[number] for n, number in numbers.items() if number in _PX4_SURFACES}
    if not survey.vehicle_class.is_rotorcraft:
        return surfaces or _DEFAULT_SURFACES, ""
    if surfaces:
        return surfaces, ""
    count = _MOTOR_COUNT.get(int(survey.values.get("FRAME_CLASS", 1)), 4)
    return {n: f"motor {n}" for n in range(1, count + 1)}, _MOTORS_ASSUMED


def _servo_map_text(survey: Survey) -> str:
    surfaces, assumed = _surfaces(survey)
    text = ", ".join(f"{n} {surface}" for n, surface in sorted(surfaces.items()))
    if survey.vehicle_class.is_rotorcraft:
        return f"{assumed}: {text}" if assumed else text
    return servo_map(survey.values).sentence or text


def _servos(survey: Survey) -> tuple[ServoStatistics, ...]:
    pulses = _rows_in_air(survey, "servo")
    surfaces, servos = _surfaces(survey)[0], []
    for n in range(1, pulses.shape[1] + 1 if len(pulses) else 1):
        us = pulses[:, n - 1]
        if us.max() < 500:  # not a servo pulse
            continue
        low, high = (survey.values.get(f"SERVO{n}_{end}", np.nan) for end in ("MIN", "MAX"))
        at_end = (us <= low + _SATURATION_US) | (us >= high - _SATURATION_US)
        low_us, high_us = float(us.min()), float(us.max())
        moves = bool(us.std() > _MIN_STD_US)
        servos.append(ServoStatistics(n, surfaces.get(n, ""), low_us, high_us, moves, round(float(at_end.mean()), 4)))
    return tuple(servos)


def _sensor(survey: Survey) -> tuple[str, str]:
    for name in _SENSOR_PARAMS:
        if name in survey.values:
            return "yes" if survey.values[name] > 0 else "no", f"{name} is {survey.values[name]:g}"
    sensor_messages = [name for name in _SENSOR_MESSAGES if survey.status and name in survey.status.rates_hz]
    if sensor_messages:
        return "yes", f"{sensor_messages[0]} is sent"
    return "unknown", "no evidence in parameters or messages"


def _airspeed(survey: Survey) -> AirspeedStatistics:
    sensor, evidence = _sensor(survey)
    air = _rows_in_air(survey, "air")
    if not len(air):
        return AirspeedStatistics(sensor, evidence)
    low, median, high = (round(float(v), 1) for v in np.percentile(air[:, 0], (5, 50, 95)))
    return AirspeedStatistics(sensor, evidence, low, median, high, bool(air[:, 0].std() < _MIN_AIRSPEED_STD))


def _wind(survey: Survey) -> WindStatistics | None:
    w = _rows_in_air(survey, "wind")
    if not len(w):
        return None
    mean = w.mean(axis=0)
    low, high = (round(float(v), 1) for v in np.percentile(np.hypot(*w.T), (5, 95)))
    from_deg = np.degrees(np.arctan2(-mean[1], -mean[0])) % 360
    return WindStatistics(round(float(np.hypot(*mean)), 1), round(float(from_deg)), low, high)


def mode_seconds(aircraft: AircraftFindings) -> dict[str, float]:
    """Return the total duration of each mode [s], the longest first."""
    total: Counter[str] = Counter()
    for mode in aircraft.modes:
        total[mode.mode] += mode.seconds  # type: ignore[assignment]
    return dict(total.most_common())
