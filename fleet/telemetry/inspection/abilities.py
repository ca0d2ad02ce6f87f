"""Compare the data of a recording with the requirements of each function of the twin.

The limits equal those of the twin; a test compares both.
"""

from typing import NamedTuple

import numpy as np

from fleet.airframes.airframe import ServoMap, servo_map
from fleet.contract import COLUMNS
from fleet.mission import FIRST, route
from fleet.process.sanitise import below
from fleet.telemetry.inspection.survey import FAST, LONGEST_S, ROTORS, ROTORS_FAST, Survey, airborne, spells
from fleet.telemetry.inspection.thinned import Span, inside, overlap, seconds
from fleet.window import INPUTS

NEEDED = tuple(LONGEST_S)
LEAST_S = 30.0  # minimum data for an identification [s]
WINDOW_S = 140.0  # window of one identification [s]
UNBROKEN_S = 4.0  # shortest continuous stretch for model verification [s]
RECENT_S = 2.0  # recent data that a turn-rate prediction requires [s]
ROUTE_S = 5.0  # time on a route that a route prediction requires [s]
QUIET = {"phi": 0.04, "theta": 0.04, "q": 0.05}  # standard deviations [rad, rad, rad/s]
LEAST_VA, PAIRED_S = 3.0, 0.5  # airspeed [m/s], age of rows paired with a ground velocity [s]
PAIRS = 50  # wind triangles that a wind estimate requires
ROUTE_MODES = ("AUTO", "MISSION", "AUTO.MISSION")
NO_WINGS = ("multirotor", "helicopter")
WINGS = ("fixed_wing", "quadplane")
DIAGNOSE_S, DIAGNOSE_ROWS = 25.0, 50  # gap-free flight, and rows of each required field, for a diagnosis
OWN_PAST_S = 50.0  # gap-free flight for a comparison with earlier flight data [s]
VANE_HZ = 18.0  # accelerometer rate for gust estimation [Hz]
_BEGIN_S, _END_S = 5.0, 1.5  # start and end of a recording excluded from a diagnosis [s]
_ITEMS_IN = {  # how to record mission items, by kind of recording
    "ULog": "PX4 logs no mission items; record telemetry instead (.tlog), with the mission downloaded while recording",
    "DataFlash log": "the autopilot logs them as CMD messages (ArduPilot); keep the log from its beginning",
    "DataFlash text log": "the autopilot logs them as CMD messages (ArduPilot); keep the log from its beginning",
    "fleet recording": "the gateway downloads it unless --listen-only is set; record with it connected",
}
_GOOD_HZ = 10.0  # below this rate fast motion is poorly resolved [Hz]
_STILL = 0.005  # standard deviation below which an input is constant, fraction of its range [-]
_WORD = {"delta_a": "aileron", "delta_e": "elevator", "delta_r": "rudder", "delta_t": "throttle"}


class Ability(NamedTuple):
    """One function of the twin, whether this recording supports it, and the reason with values found and required."""

    name: str
    can: bool
    why: str


def abilities(known: Survey) -> list[Ability]:
    """Check all functions of the twin in processing order."""
    flown = airborne(known)
    whole = whole_spans(known)
    starved = _wings(known) or _starved(known, flown, whole)
    swing = swings(known, overlap(whole, flown))
    axes = (
        _identify("identify longitudinal", known, starved, swing, ("delta_e", "delta_t")),
        _identify("identify lateral", known, starved, swing, ("delta_a", "delta_r")),
    )
    unidentified = _unidentified(axes)
    verified = _verify(known, unidentified, overlap(whole, flown))
    wind = _wind(known)
    return [
        *axes,
        verified,
        _on_route(known, unidentified, flown),
        _by_turn_rate(known, whole),
        wind,
        _diagnose(known, flown),
    ]


def _unidentified(axes: tuple[Ability, Ability]) -> str:
    """Return which axis cannot be identified, or an empty string."""
    broken = [axis.name.split()[-1] for axis in axes if not axis.can]
    if not broken:
        return ""
    return "neither axis can be identified" if len(broken) == 2 else f"the {broken[0]} axis cannot be identified"


def whole_spans(known: Survey) -> list[Span]:
    """Return the stretches in which all required fields are continuous."""
    whole = [Span(-np.inf, np.inf)]
    for name in NEEDED:
        whole = overlap(whole, known.rows[name].stretches())
    return whole


def swings(known: Survey, spans: list[Span]) -> dict[str, float]:
    """Return the standard deviation of each input in the intervals, fraction of its range [-]."""
    t, pulses = known.rows["servo"].rows()
    there = inside(t, spans)
    if there.sum() < 2:
        return dict.fromkeys(INPUTS, 0.0)
    u = servo_map(known.values).inputs(pulses[there])
    return dict(zip(INPUTS, u.std(axis=0).tolist(), strict=True))


def most_within(spans: list[Span], length: float) -> float:
    """Return the maximum coverage by the intervals of any window of `window_s` [s]."""
    best = 0.0
    for last in spans:
        start = last.stop - length
        best = max(best, seconds(overlap(spans, [Span(start, last.stop)])))
    return best


def _wings(known: Survey) -> str:
    return f"a {known.vehicle} is not modelled, turn-rate prediction only" if known.vehicle in NO_WINGS else ""


def _starved(known: Survey, flown: list[Span], whole: list[Span]) -> str:
    """Return what prevents an identification, or an empty string."""
    if lack := _lacking(known):
        return lack
    if not flown:
        fast = ROTORS_FAST if known.vehicle in ROTORS else FAST
        return f"never in flight: no 5 s faster than {fast:.0f} m/s"
    for name in NEEDED:
        covered = seconds(overlap(known.rows[name].stretches(), flown))
        if covered < 0.5 * seconds(flown):
            return (
                f"{name} at {known.rows[name].rate_hz:.1f} Hz is continuous for {covered:.0f} of {seconds(flown):.0f}"
                f" s in flight; required: no interval over {LONGEST_S[name]:g} s, recommended: {_GOOD_HZ:.0f} Hz"
            )
    parts = overlap(whole, flown)
    have = most_within(parts, WINDOW_S)
    if have < LEAST_S:
        return f"{below(have, LEAST_S)} s of complete data in flight, {LEAST_S:.0f} s are required"
    longest = max(part.seconds for part in parts)
    if longest < UNBROKEN_S:
        return f"the longest continuous stretch is {longest:.1f} s, {UNBROKEN_S:.0f} s are required"
    return ""


def _lacking(known: Survey) -> str:
    """Return which required fields have no rows, or an empty string."""
    none = [name for name in NEEDED if known.rows[name].count < 8]
    return f"no {', '.join(none)} rows in the recording" if none else ""


def _identify(name: str, known: Survey, starved: str, swing: dict[str, float], needed: tuple[str, ...]) -> Ability:
    if starved:
        return Ability(name, False, starved)
    still = [_WORD[each] for each in needed if swing[each] < _STILL]
    servos = servo_map(known.values)
    if len(still) == len(needed):
        return Ability(name, False, f"{' and '.join(still)} constant in flight{_assumed(servos)}")
    said = ", ".join(
        f"{_WORD[each]} varies by {swing[each]:.0%} of its range" for each in needed if swing[each] >= _STILL
    )
    said += f"; {still[0]} constant" if still else ""
    slow = [f"{kind} at {hz:.1f} Hz" for kind in ("attitude", "servo") if (hz := known.rows[kind].rate_hz) < _GOOD_HZ]
    if slow:
        said += f"; {' and '.join(slow)} resolves fast motion poorly, {_GOOD_HZ:.0f} Hz or more is recommended"
    if known.rows["air"].count == 0:
        said += "; no airspeed rows: zero wind assumed"
    return Ability(name, True, said + _assumed(servos))


def _assumed(servos: ServoMap) -> str:
    return " (servo map assumed)" if servos.sentence else ""


def _verify(known: Survey, unidentified: str, spans: list[Span]) -> Ability:
    if unidentified:
        return Ability("verify", False, unidentified)
    t, x = known.rows["attitude"].rows()
    there = x[inside(t, spans)]
    columns = [name for name, _ in COLUMNS["attitude"]]
    moved = {name: float(there[:, columns.index(name)].std()) for name in QUIET}
    phi, theta, q = np.degrees(list(moved.values()))
    found = f"bank varies by {phi:.1f} deg, pitch by {theta:.1f} deg, pitch rate by {q:.1f} deg/s"
    if all(moved[name] < least for name, least in QUIET.items()):
        need = "{:.1f} deg, {:.1f} deg or {:.1f} deg/s are required".format(*np.degrees(list(QUIET.values())))
        return Ability("verify", False, f"steady flight, too little excitation: {found}, {need}")
    return Ability("verify", True, found)


def _on_route(known: Survey, unidentified: str, flown: list[Span]) -> Ability:
    """Check route prediction with an identified model, else with the kinematic model of the vehicle type."""
    name = "predict on the route"
    if unidentified and known.vehicle not in (*WINGS, *NO_WINGS):
        return Ability(name, False, f"{unidentified}, and a vehicle of kind {known.vehicle} has no kinematic model")
    if none := [kind for kind in ("attitude", "velocity", "position") if known.rows[kind].count < 8]:
        return Ability(name, False, f"no {', '.join(none)} rows in the recording")
    following = overlap([span for span, mode in spells(known) if mode in ROUTE_MODES], flown)
    flew = seconds(following)
    if flew < ROUTE_S:
        modes = ", ".join(dict.fromkeys(mode for _, mode in spells(known))) or "no mode"
        return Ability(
            name,
            False,
            f"{below(flew, ROUTE_S)} s in a mode that follows a mission, {ROUTE_S:.0f} s are required ({modes})",
        )
    origin = known.origin()
    if not known.items or origin is None:
        remedy = _ITEMS_IN.get(known.kind, "let the ground station download it while recording")
        return Ability(name, False, f"no mission list in the recording; {remedy}")
    autopilot = known.status.autopilot if known.status else "unknown"
    first = FIRST.get(autopilot, 1)
    if not len(route(known.items, seq=first, origin=origin, params=known.values, first=first).legs):
        return Ability(name, False, f"the mission of {len(known.items)} items has no legs")
    if not known.rows["leg"].count:
        return Ability(name, False, "the current mission item is not in the recording (MISSION_CURRENT)")
    told = autopilot in ("ardupilot", "px4")
    law = "" if told else f"; guidance law of autopilot {autopilot} is identified from its bank commands, if any"
    items = f"{len(known.items)} mission items" + ("" if known.mission and known.mission.complete else ", not all")
    if known.vehicle in NO_WINGS:
        return Ability(name, True, f"{flew:.0f} s on the route, {items}; from speed and acceleration limits")
    how = f"kinematic fixed-wing model, since {unidentified}" if unidentified else "take-off and landing not modelled"
    return Ability(name, True, f"{flew:.0f} s on the route, {items}; {how}{law}")


def _by_turn_rate(known: Survey, whole: list[Span]) -> Ability:
    name = "predict by turn rate"
    if lack := _lacking(known):
        return Ability(name, False, lack)
    longest = max((span.seconds for span in whole), default=0.0)
    if longest < RECENT_S:
        rates = ", ".join(f"{kind} {known.rows[kind].rate_hz:.1f} Hz" for kind in NEEDED)
        return Ability(name, False, f"never {RECENT_S:.0f} s of complete data: {rates}; 2 Hz without gaps is required")
    return Ability(name, True, f"{seconds([s for s in whole if s.seconds >= RECENT_S]):.0f} s of complete data")


def _wind(known: Survey) -> Ability:
    name = "estimate wind"
    none = [kind for kind in ("velocity", "air", "attitude") if not known.rows[kind].count]
    if none:
        return Ability(name, False, f"no {', '.join(none)} rows in the recording")
    t, fresh = known.rows["velocity"].rows()[0], []
    t_air, air = known.rows["air"].rows()
    for kind in ("air", "attitude"):
        rows = known.rows[kind]
        other = rows.rows()[0]
        before = np.searchsorted(other, t) - 1
        limit = max(PAIRED_S, 1.5 * rows.stride / max(rows.rate_hz, 1e-3)) if rows.stride > 1 else PAIRED_S
        fresh.append((before >= 0) & (t - other[np.clip(before, 0, None)] < limit))
    fast = air[np.clip(np.searchsorted(t_air, t) - 1, 0, None), 0] >= LEAST_VA
    pairs = int((fresh[0] & fresh[1] & fast).sum())
    if pairs < PAIRS:
        most = float(air[:, 0].max())
        return Ability(name, False, f"{pairs} wind triangles, {PAIRS} are required; airspeed reaches {most:.1f} m/s")
    return Ability(name, True, f"{pairs} wind triangles of ground velocity, airspeed and heading")


def _diagnose(known: Survey, flown: list[Span]) -> Ability:
    """Check the requirements of `fleet diagnose`."""
    name = "diagnose"
    if known.vehicle in NO_WINGS:
        return Ability(name, False, f"no diagnosis of a {known.vehicle}: the reference simulation is a fixed wing")
    if few := [kind for kind in NEEDED if known.rows[kind].count < DIAGNOSE_ROWS]:
        return Ability(name, False, f"fewer than {DIAGNOSE_ROWS} {', '.join(few)} rows in the recording")
    trusted = seconds(_without_gaps(known, flown))
    if trusted < DIAGNOSE_S:
        found = below(trusted, DIAGNOSE_S)
        return Ability(name, False, f"{found} s in flight without gaps, {DIAGNOSE_S:.0f} s are required")
    said = f"{trusted:.0f} s in flight without gaps, compared with a model of `fleet calibrate`"
    said += " or earlier flight data" if trusted >= OWN_PAST_S else f"; {OWN_PAST_S:.0f} s for earlier flight data"
    lacks = [] if known.rows["imu"].rate_hz >= VANE_HZ else [f"accelerometer at {VANE_HZ:.0f} Hz"]
    lacks += [word for kind, word in (("air", "airspeed"), ("pressure", "pressure")) if not known.rows[kind].count]
    return Ability(name, True, said + (f"; reduced sensitivity without {', '.join(lacks)}" if lacks else ""))


def _without_gaps(known: Survey, flown: list[Span]) -> list[Span]:
    """Return the flight intervals without gaps in required fields, start and end of the rows excluded."""
    ends = [known.rows[kind].rows()[0][[0, -1]] for kind in NEEDED]
    parts = overlap(flown, [Span(max(a for a, _ in ends) + _BEGIN_S, min(b for _, b in ends) - _END_S)])
    for kind in NEEDED:
        gaps = known.rows[kind].gaps()
        starts, stops = [-np.inf, *(gap.stop for gap in gaps)], [*(gap.start for gap in gaps), np.inf]
        parts = overlap(parts, [Span(a, b) for a, b in zip(starts, stops, strict=True)])
    return parts
