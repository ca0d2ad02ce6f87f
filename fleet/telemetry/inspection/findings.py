"""Figures that `fleet inspect` reports for each aircraft: the keys of its JSON with their units."""

from collections import Counter
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from fleet.airframes.airframe import servo_map
from fleet.contract import COLUMNS
from fleet.frames import to_ned
from fleet.telemetry.inspection.abilities import abilities
from fleet.telemetry.inspection.survey import Event, Survey, airborne, spells
from fleet.telemetry.inspection.thinned import inside, seconds

_SURFACES = {4: "aileron", 19: "elevator", 21: "rudder", 70: "throttle", 77: "left elevon", 78: "right elevon"}
_ASSUMED = {1: "aileron", 2: "elevator", 3: "throttle", 4: "rudder"}
_MOVES_US = 5.0  # standard deviation below which a channel is constant [us]
_AT_END_US = 1.0  # distance from SERVOn_MIN or _MAX below which a channel is saturated [us]
_CONSTANT = 0.05  # standard deviation below which airspeed is constant [m/s]
_SEVERE = 3  # MAV_SEVERITY_ERROR; a lower number is more severe
_SENSOR = ("ARSPD_TYPE", "ARSPD_ENABLE", "SYS_HAS_NUM_ASPD")  # parameters that configure an airspeed sensor
_SPOKEN = ("AIRSPEED", "AIRSPEED_AUTOCAL")  # messages that an autopilot sends only with an airspeed sensor


class Facts(NamedTuple):
    """Data outside contract messages: firmware, and texts with time [s since 1970] and severity."""

    firmware: str = ""
    texts: tuple[tuple[float, int, str], ...] = ()


class Mode(msgspec.Struct, frozen=True):
    """One interval of one flight mode."""

    mode: str
    start_s: Annotated[float, Meta(description="start, since the start of the recording [s]")]
    seconds: Annotated[float, Meta(description="duration [s]")]


class Gap(msgspec.Struct, frozen=True):
    """One interval without rows."""

    start_s: Annotated[float, Meta(description="start, since the start of the recording [s]")]
    seconds: Annotated[float, Meta(description="duration [s]")]


class Kind(msgspec.Struct, frozen=True):
    """Statistics of the rows of one field."""

    rows: Annotated[int, Meta(description="number of rows")]
    rate_hz: Annotated[float, Meta(description="mean rate outside gaps [Hz]")]
    gaps: Annotated[int, Meta(description="intervals over 3 times the median, too long to interpolate; at most 1,000")]
    gap_s: Annotated[float, Meta(description="total duration of the gaps [s]")]
    longest: Annotated[Gap | None, Meta(description="the longest gap")] = None


class Servo(msgspec.Struct, frozen=True):
    """One output channel, in flight if the aircraft flew, else over the whole recording."""

    channel: int
    surface: Annotated[str, Meta(description="control surface by the servo map, or empty")]
    low_us: Annotated[float, Meta(description="minimum pulse width [us]")]
    high_us: Annotated[float, Meta(description="maximum pulse width [us]")]
    moves: Annotated[bool, Meta(description="standard deviation above 5 us")]
    saturated: Annotated[float, Meta(description="fraction of the time at SERVOn_MIN or _MAX, 0..1")]


class Airspeed(msgspec.Struct, frozen=True):
    """Airspeed reported by the autopilot, in flight if the aircraft flew."""

    sensor: Annotated[str, Meta(description="yes, no or unknown")]
    how: Annotated[str, Meta(description="evidence for `sensor`")]
    low: Annotated[float | None, Meta(description="5th percentile [m/s]; null without rows")] = None
    median: Annotated[float | None, Meta(description="[m/s]")] = None
    high: Annotated[float | None, Meta(description="95th percentile [m/s]")] = None
    constant: Annotated[bool, Meta(description="standard deviation below 0.05 m/s")] = False


class Wind(msgspec.Struct, frozen=True):
    """Wind reported by the autopilot, in flight if the aircraft flew."""

    speed: Annotated[float, Meta(description="speed of the mean wind [m/s]")]
    from_deg: Annotated[float, Meta(description="direction the mean wind comes from [deg]")]
    low: Annotated[float, Meta(description="5th percentile of the speed [m/s]")]
    high: Annotated[float, Meta(description="95th percentile of the speed [m/s]")]


class Route(msgspec.Struct, frozen=True):
    """The last mission of the recording."""

    items: int = 0
    complete: bool = False
    uploads: Annotated[int, Meta(description="number of different item lists")] = 0
    flown: Annotated[tuple[int, ...], Meta(description="active items in order of time")] = ()
    sentence: Annotated[str, Meta(description="problem with the mission, or empty")] = ""


class Happened(msgspec.Struct, frozen=True):
    """One event."""

    t_s: Annotated[float, Meta(description="time since the start of the recording [s]")]
    kind: Annotated[str, Meta(description="mode, armed, disarmed, item, mission, parameter, text, clock, link or gap")]
    text: str


class Can(msgspec.Struct, frozen=True):
    """One function of the twin and whether this recording supports it."""

    name: str
    can: bool
    why: Annotated[str, Meta(description="values found and required")]


class Findings(msgspec.Struct, frozen=True, kw_only=True):
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
    modes: tuple[Mode, ...] = ()
    rows: Annotated[dict[str, Kind], Meta(description="by field, as in `fleet schema sample`")] = {}
    mission: Route = Route()
    params: Annotated[int, Meta(description="parameters received")] = 0
    params_complete: bool = False
    servo_map: Annotated[str, Meta(description="assignment of output channels to control surfaces")] = ""
    servos: tuple[Servo, ...] = ()
    airspeed: Airspeed = Airspeed("unknown", "")
    wind: Annotated[Wind | None, Meta(description="null if the autopilot reports no wind")] = None
    events: tuple[Happened, ...] = ()
    events_lost: Annotated[int, Meta(description="events beyond the maximum number")] = 0
    abilities: tuple[Can, ...] = ()


class File(msgspec.Struct, frozen=True, kw_only=True):
    """One recording; `fleet inspect --json` writes a list of these under the key `files`."""

    file: str
    bytes: int = 0
    sentences: Annotated[tuple[str, ...], Meta(description="data that was skipped, damaged or unreadable")] = ()
    aircraft: tuple[Findings, ...] = ()
    twin: Annotated[dict[str, Any] | None, Meta(description="with --twin: results of a twin, by UAV id")] = None


def findings(known: Survey, facts: Facts) -> Findings:
    """Compute the figures of one aircraft from its survey."""
    status, flown = known.status, airborne(known)
    return Findings(
        uav=known.uav,
        vehicle=known.vehicle,
        autopilot=status.autopilot if status else "generic",
        firmware=facts.firmware,
        begun=known.begun,
        seconds=round(known.newest - known.begun, 1),
        airborne_s=round(seconds(flown), 1),
        distance_m=_distance(known),
        altitude_m=_altitude(known),
        received=status.received if status else 0,
        missed=status.missed if status else 0,
        rejected=(status.rejected if status else 0) + known.refused,
        clock_jumps=status.clock_jumps if status else 0,
        modes=tuple(Mode(mode, _since(known, span.start), round(span.seconds, 1)) for span, mode in spells(known)),
        rows={name: _kind(known, name) for name in COLUMNS},
        mission=_mission(known),
        params=len(known.values),
        params_complete=known.params.complete if known.params else False,
        servo_map=_servo_words(known),
        servos=_servos(known),
        airspeed=_airspeed(known),
        wind=_wind(known),
        events=tuple(Happened(_since(known, e.t), e.kind, e.text) for e in happened(known, facts)),
        events_lost=known.lost_events,
        abilities=tuple(Can(*each) for each in abilities(known)),
    )


def happened(known: Survey, facts: Facts) -> list[Event]:
    """Return the events and severe texts in time order, without duplicate texts."""
    texts = {text.strip(): t for t, severity, text in reversed(facts.texts) if severity <= _SEVERE}
    kept = [event for event in known.events if event.kind != "text" or event.text.strip() not in texts]
    severe = [Event(t, "text", text.strip()) for t, severity, text in facts.texts if severity <= _SEVERE]
    return sorted(kept + severe)


def _since(known: Survey, t: float) -> float:
    return max(round(t - known.begun, 1), 0.0)


def _in_air(known: Survey, name: str) -> np.ndarray:
    """Return the rows of one field in flight, or all rows if the aircraft never flew."""
    t, x = known.rows[name].rows()
    there = inside(t, airborne(known))
    return x[there] if there.any() else x


def _distance(known: Survey) -> float:
    t, x = known.rows["position"].rows()
    origin, total = known.origin(), 0.0
    for span in airborne(known):
        there = x[(t >= span.start) & (t <= span.stop)]
        if origin is not None and len(there) > 1:
            total += float(np.linalg.norm(np.diff(to_ned(origin, *there.T)[:, :2], axis=0), axis=1).sum())
    return round(total)


def _altitude(known: Survey) -> tuple[float, float] | None:
    x = _in_air(known, "position")
    return (round(float(x[:, 2].min()) * 1e-3, 1), round(float(x[:, 2].max()) * 1e-3, 1)) if len(x) else None


def _kind(known: Survey, name: str) -> Kind:
    rows = known.rows[name]
    gaps = rows.gaps()
    longest = max(gaps, key=lambda gap: gap.seconds, default=None)
    worst = Gap(_since(known, longest.start), round(longest.seconds, 2)) if longest else None
    return Kind(rows.count, round(rows.rate_hz, 2), len(gaps), round(seconds(gaps), 1), worst)


def _mission(known: Survey) -> Route:
    if known.mission is None:
        return Route(sentence="no mission list in the recording", flown=_flown_items(known))
    said = known.mission.sentence
    return Route(len(known.items), known.mission.complete, known.missions, _flown_items(known), said)


def _flown_items(known: Survey) -> tuple[int, ...]:
    return tuple(int(event.text.split()[1]) for event in known.events if event.kind == "item")


def _surface(known: Survey, channel: int) -> str:
    functions = {n: int(known.values.get(f"SERVO{n}_FUNCTION", -1)) for n in range(1, 9)}
    if not any(function in _SURFACES for function in functions.values()):
        return _ASSUMED.get(channel, "")
    return _SURFACES.get(functions[channel], "")


def _servo_words(known: Survey) -> str:
    named = [f"{n} {word}" for n in range(1, 9) if (word := _surface(known, n))]
    return servo_map(known.values).sentence or ", ".join(named)


def _servos(known: Survey) -> tuple[Servo, ...]:
    """Describe the channels that carry pulses."""
    pulses = _in_air(known, "servo")
    found = []
    for n in range(1, pulses.shape[1] + 1 if len(pulses) else 1):
        us = pulses[:, n - 1]
        if us.max() < 500:  # not a servo pulse
            continue
        low, high = (known.values.get(f"SERVO{n}_{end}", np.nan) for end in ("MIN", "MAX"))
        at_end = (us <= low + _AT_END_US) | (us >= high - _AT_END_US)
        low_us, high_us = float(us.min()), float(us.max())
        moves = bool(us.std() > _MOVES_US)
        found.append(Servo(n, _surface(known, n), low_us, high_us, moves, round(float(at_end.mean()), 4)))
    return tuple(found)


def _sensor(known: Survey) -> tuple[str, str]:
    """Return whether there is an airspeed sensor, and the evidence."""
    for name in _SENSOR:
        if name in known.values:
            return "yes" if known.values[name] > 0 else "no", f"{name} is {known.values[name]:g}"
    spoken = [name for name in _SPOKEN if known.status and name in known.status.rates_hz]
    return ("yes", f"{spoken[0]} is sent") if spoken else ("unknown", "no evidence in parameters or messages")


def _airspeed(known: Survey) -> Airspeed:
    sensor, how = _sensor(known)
    air = _in_air(known, "air")
    if not len(air):
        return Airspeed(sensor, how)
    low, median, high = (round(float(v), 1) for v in np.percentile(air[:, 0], (5, 50, 95)))
    return Airspeed(sensor, how, low, median, high, bool(air[:, 0].std() < _CONSTANT))


def _wind(known: Survey) -> Wind | None:
    w = _in_air(known, "wind")
    if not len(w):
        return None
    mean = w.mean(axis=0)
    low, high = (round(float(v), 1) for v in np.percentile(np.hypot(*w.T), (5, 95)))
    blows_from = np.degrees(np.arctan2(-mean[1], -mean[0])) % 360
    return Wind(round(float(np.hypot(*mean)), 1), round(float(blows_from)), low, high)


def mode_seconds(told: Findings) -> dict[str, float]:
    """Return the total duration of each mode [s], the longest first."""
    total: Counter[str] = Counter()
    for mode in told.modes:
        total[mode.mode] += mode.seconds  # type: ignore[assignment]
    return dict(total.most_common())
