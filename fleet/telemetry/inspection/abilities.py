"""Compare the data of a recording with the requirements of each function of the twin.

The limits equal those of the twin; a test compares both.
"""

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from fleet.airframes.airframe import servo_map
from fleet.contract import COLUMNS
from fleet.mission import FIRST_ITEM, unroll_route
from fleet.process.sanitise import format_below
from fleet.telemetry.inspection.survey import (
    AIRBORNE_SPEED,
    ROTOR_AIRBORNE_SPEED,
    Survey,
    airborne,
    mode_spans,
)
from fleet.telemetry.inspection.thinned import TimeInterval, inside, overlap, seconds
from fleet.window import INPUTS, LONGEST_GAP

REQUIRED_FIELDS = tuple(LONGEST_GAP)
MIN_IDENTIFY_S = 30.0  # minimum data for an identification [s]
MAX_IDENTIFY_S = 140.0  # window of one identification [s]
MIN_STRETCH_S = 4.0  # shortest continuous stretch for model verification [s]
TURN_RATE_S = 2.0  # recent data that a turn-rate prediction requires [s]
MIN_ROUTE_S = 5.0  # time on a route that a route prediction requires [s]
MIN_EXCITATION = {"phi": 0.04, "theta": 0.04, "q": 0.05}  # standard deviations [rad, rad, rad/s]
MIN_AIRSPEED, MAX_PAIR_AGE_S = 3.0, 0.5  # airspeed [m/s], age of rows paired with a ground velocity [s]
MIN_WIND_TRIANGLES = 50  # wind triangles that a wind estimate requires
MIN_TILT_S = 20.0  # wind of a multirotor from its tilt [s]
ROUTE_MODES = ("AUTO", "MISSION", "AUTO.MISSION")
MIN_DIAGNOSE_S, MIN_DIAGNOSE_ROWS = 25.0, 50  # gap-free flight, and rows of each required field, for a diagnosis
MIN_OWN_PAST_S = 50.0  # gap-free flight for a comparison with earlier flight data [s]
GUST_SENSING_HZ = 18.0  # accelerometer rate for gust estimation [Hz]
_SKIP_BEGIN_S, _SKIP_END_S = 5.0, 1.5  # start and end of a recording excluded from a diagnosis [s]
_DATAFLASH_REMEDY = "the autopilot logs them as CMD messages (ArduPilot); keep the log from its beginning"
_ITEMS_REMEDY = {  # how to record mission items, by kind of recording
    "ULog": "PX4 logs no mission items; record telemetry instead (.tlog), with the mission downloaded while recording",
    "DataFlash log": _DATAFLASH_REMEDY,
    "DataFlash text log": _DATAFLASH_REMEDY,
    "fleet recording": "the gateway downloads it unless --listen-only is set; record with it connected",
}
_GOOD_HZ = 10.0  # below this rate fast motion is poorly resolved [Hz]
_MIN_INPUT_STD = 0.005  # standard deviation below which an input is constant, fraction of its range [-]
_SURFACE_NAME = {"delta_a": "aileron", "delta_e": "elevator", "delta_r": "rudder", "delta_t": "throttle"}


class AbilityResult(msgspec.Struct, frozen=True):
    """One function of the twin and whether this recording supports it."""

    name: str
    can: bool
    why: Annotated[str, Meta(description="values found and required")]


def abilities(survey: Survey) -> list[AbilityResult]:
    """Check all functions of the twin in processing order."""
    in_air = airborne(survey)
    complete = complete_spans(survey)
    obstacle = _obstacle(survey, in_air, complete)
    input_std = input_variation(survey, overlap(complete, in_air))
    longitudinal = _identify_axis(survey, obstacle, input_std, ("delta_e", "delta_t"))
    lateral = _identify_axis(survey, obstacle, input_std, ("delta_a", "delta_r"))
    failed = [name for name, axis in (("longitudinal", longitudinal), ("lateral", lateral)) if not axis[0]]
    unidentified = f"the {failed[0]} axis cannot be identified" if failed else ""
    unidentified = "neither axis can be identified" if len(failed) == 2 else unidentified
    checks = {
        "identify longitudinal": longitudinal,
        "identify lateral": lateral,
        "verify": _check_verify(survey, unidentified, overlap(complete, in_air)),
        "predict on the route": _check_route(survey, unidentified, in_air),
        "predict by turn rate": _check_turn_rate(survey, complete),
        "estimate wind": _check_wind(survey, in_air),
        "diagnose": _check_diagnose(survey, in_air),
    }
    return [AbilityResult(name, can, why) for name, (can, why) in checks.items()]


def complete_spans(survey: Survey) -> list[TimeInterval]:
    """Return the stretches in which all required fields are continuous."""
    complete = [TimeInterval(-np.inf, np.inf)]
    for name in REQUIRED_FIELDS:
        complete = overlap(complete, survey.rows[name].stretches())
    return complete


def input_variation(survey: Survey, spans: list[TimeInterval]) -> dict[str, float]:
    """Return the standard deviation of each input in the intervals, fraction of its range [-]."""
    t, pulses = survey.rows["servo"].rows()
    selected = inside(t, spans)
    if selected.sum() < 2:
        return dict.fromkeys(INPUTS, 0.0)
    u = servo_map(survey.values).inputs(pulses[selected])
    return dict(zip(INPUTS, u.std(axis=0).tolist(), strict=True))


def max_coverage(spans: list[TimeInterval], window_s: float) -> float:
    """Return the maximum coverage by the intervals of any window of `window_s` [s]."""
    windows = [TimeInterval(last.stop - window_s, last.stop) for last in spans]
    return max((seconds(overlap(spans, [window])) for window in windows), default=0.0)


def _obstacle(survey: Survey, in_air: list[TimeInterval], complete: list[TimeInterval]) -> str:
    """Return what prevents an identification, or an empty string."""
    if survey.vehicle_class.is_rotorcraft:
        return f"the dynamics of a {survey.vehicle} are not identified"
    if missing := _missing_fields(survey):
        return missing
    if not in_air:
        fast = ROTOR_AIRBORNE_SPEED if survey.vehicle_class.can_hover else AIRBORNE_SPEED
        return f"never in flight: no 5 s faster than {fast:.0f} m/s"
    for name in REQUIRED_FIELDS:
        rows = survey.rows[name]
        covered = seconds(overlap(rows.stretches(), in_air))
        if covered < 0.5 * seconds(in_air):
            return (
                f"{name} at {rows.rate_hz:.1f} Hz is continuous for {covered:.0f} of {seconds(in_air):.0f} s in flight"
                f"; required: no interval over {rows.longest_gap_s:.1f} s, recommended: {_GOOD_HZ:.0f} Hz"
            )
    parts = overlap(complete, in_air)
    available_s = max_coverage(parts, MAX_IDENTIFY_S)
    if available_s < MIN_IDENTIFY_S:
        available = format_below(available_s, MIN_IDENTIFY_S)
        return f"{available} s of complete data in flight, {MIN_IDENTIFY_S:.0f} s are required"
    longest = max(part.seconds for part in parts)
    if longest < MIN_STRETCH_S:
        return f"the longest continuous stretch is {longest:.1f} s, {MIN_STRETCH_S:.0f} s are required"
    return ""


def _missing_fields(survey: Survey) -> str:
    """Return which required fields have no rows, or an empty string."""
    missing = [name for name in REQUIRED_FIELDS if survey.rows[name].count < 8]
    return f"no {', '.join(missing)} rows in the recording" if missing else ""


def _identify_axis(
    survey: Survey, obstacle: str, input_std: dict[str, float], inputs: tuple[str, ...]
) -> tuple[bool, str]:
    if obstacle:
        return False, obstacle
    constant = [_SURFACE_NAME[channel] for channel in inputs if input_std[channel] < _MIN_INPUT_STD]
    assumption = " (servo map assumed)" if servo_map(survey.values).sentence else ""
    if len(constant) == len(inputs):
        return False, f"{' and '.join(constant)} constant in flight{assumption}"
    reason = ", ".join(
        f"{_SURFACE_NAME[each]} varies by {input_std[each]:.0%} of its range"
        for each in inputs
        if input_std[each] >= _MIN_INPUT_STD
    )
    reason += f"; {constant[0]} constant" if constant else ""
    slow = [f"{kind} at {hz:.1f} Hz" for kind in ("attitude", "servo") if (hz := survey.rows[kind].rate_hz) < _GOOD_HZ]
    if slow:
        reason += f"; {' and '.join(slow)} resolves fast motion poorly, {_GOOD_HZ:.0f} Hz or more is recommended"
    if survey.rows["air"].count == 0:
        reason += "; no airspeed rows: zero wind assumed"
    return True, reason + assumption


def _check_verify(survey: Survey, unidentified: str, spans: list[TimeInterval]) -> tuple[bool, str]:
    if unidentified:
        return False, unidentified
    t, x = survey.rows["attitude"].rows()
    selected = x[inside(t, spans)]
    columns = [name for name, _ in COLUMNS["attitude"]]
    std = {name: float(selected[:, columns.index(name)].std()) for name in MIN_EXCITATION}
    phi, theta, q = np.degrees(list(std.values()))
    variation = f"bank varies by {phi:.1f} deg, pitch by {theta:.1f} deg, pitch rate by {q:.1f} deg/s"
    if all(std[name] < limit for name, limit in MIN_EXCITATION.items()):
        phi, theta, q = np.degrees(list(MIN_EXCITATION.values()))
        required = f"{phi:.1f} deg, {theta:.1f} deg or {q:.1f} deg/s are required"
        return False, f"steady flight, too little excitation: {variation}, {required}"
    return True, variation


def _check_route(survey: Survey, unidentified: str, in_air: list[TimeInterval]) -> tuple[bool, str]:
    """Check route prediction with an identified model, else with the kinematic model of the vehicle type."""
    if unidentified and not (survey.vehicle_class.has_wings or survey.vehicle_class.can_hover):
        return False, f"{unidentified}, and a vehicle of kind {survey.vehicle} has no kinematic model"
    if missing := [kind for kind in ("attitude", "velocity", "position") if survey.rows[kind].count < 8]:
        return False, f"no {', '.join(missing)} rows in the recording"
    on_route_s = seconds(overlap([span for span, mode in mode_spans(survey) if mode in ROUTE_MODES], in_air))
    if on_route_s < MIN_ROUTE_S:
        modes = ", ".join(dict.fromkeys(mode for _, mode in mode_spans(survey))) or "no mode"
        available = f"{format_below(on_route_s, MIN_ROUTE_S)} s in a mode that follows a mission"
        return False, f"{available}, {MIN_ROUTE_S:.0f} s are required ({modes})"
    autopilot = survey.status.autopilot if survey.status else "unknown"
    if obstacle := _route_obstacle(survey, autopilot):
        return False, obstacle
    reason = f"{on_route_s:.0f} s on the route, {len(survey.items)} mission items"
    reason += "; " if survey.mission and survey.mission.complete else ", not all; "
    if survey.vehicle_class.is_rotorcraft:
        return True, f"{reason}from speed and acceleration limits"
    kinematic = f"kinematic fixed-wing model, since {unidentified}"
    reason += kinematic if unidentified else "take-off and landing not modelled"
    if autopilot not in ("ardupilot", "px4"):
        reason += f"; guidance law of autopilot {autopilot} is identified from its bank commands, if any"
    return True, reason


def _route_obstacle(survey: Survey, autopilot: str) -> str:
    """Return what is missing of the route, or an empty string."""
    origin, first = survey.origin(), FIRST_ITEM.get(autopilot, 1)
    if not survey.items or origin is None:
        remedy = _ITEMS_REMEDY.get(survey.kind, "let the ground station download it while recording")
        return f"no mission list in the recording; {remedy}"
    if not len(unroll_route(survey.items, seq=first, origin=origin, params=survey.values, first=first).legs):
        return f"the mission of {len(survey.items)} items has no legs"
    if not survey.rows["leg"].count:
        return "the current mission item is not in the recording (MISSION_CURRENT)"
    return ""


def _check_turn_rate(survey: Survey, complete: list[TimeInterval]) -> tuple[bool, str]:
    if missing := _missing_fields(survey):
        return False, missing
    long_enough = [span for span in complete if span.seconds >= TURN_RATE_S]
    if not long_enough:
        rates = ", ".join(f"{kind} {survey.rows[kind].rate_hz:.1f} Hz" for kind in REQUIRED_FIELDS)
        return False, f"never {TURN_RATE_S:.0f} s of complete data: {rates}; 2 Hz without gaps is required"
    return True, f"{seconds(long_enough):.0f} s of complete data"


def _check_wind(survey: Survey, in_air: list[TimeInterval]) -> tuple[bool, str]:
    if survey.vehicle_class.is_rotorcraft:
        return _check_wind_from_tilt(survey, in_air)
    missing = [kind for kind in ("velocity", "air", "attitude") if not survey.rows[kind].count]
    if missing:
        return False, f"no {', '.join(missing)} rows in the recording"
    t, fresh = survey.rows["velocity"].rows()[0], []
    air_t, air = survey.rows["air"].rows()
    for kind in ("air", "attitude"):
        rows = survey.rows[kind]
        other = rows.rows()[0]
        previous = np.searchsorted(other, t) - 1
        limit = max(MAX_PAIR_AGE_S, 1.5 * rows.stride / max(rows.rate_hz, 1e-3)) if rows.stride > 1 else MAX_PAIR_AGE_S
        fresh.append((previous >= 0) & (t - other[np.clip(previous, 0, None)] < limit))
    fast = air[np.clip(np.searchsorted(air_t, t) - 1, 0, None), 0] >= MIN_AIRSPEED
    pairs = int((fresh[0] & fresh[1] & fast).sum())
    if pairs < MIN_WIND_TRIANGLES:
        reached = f"airspeed reaches {float(air[:, 0].max()):.1f} m/s"
        return False, f"{pairs} wind triangles, {MIN_WIND_TRIANGLES} are required; {reached}"
    return True, f"{pairs} wind triangles of ground velocity, airspeed and heading"


def _check_wind_from_tilt(survey: Survey, in_air: list[TimeInterval]) -> tuple[bool, str]:
    """Check the wind estimate of a multirotor: its tilt against its acceleration, without an airspeed sensor."""
    if missing := [kind for kind in ("velocity", "attitude") if not survey.rows[kind].count]:
        return False, f"no {', '.join(missing)} rows in the recording"
    t, v = survey.rows["velocity"].rows()
    selected = v[inside(t, in_air), :2]
    if seconds(in_air) < MIN_TILT_S or not len(selected):
        return False, f"{format_below(seconds(in_air), MIN_TILT_S)} s in flight, {MIN_TILT_S:.0f} s are required"
    return True, f"from tilt and acceleration in {seconds(in_air):.0f} s of flight"


def _check_diagnose(survey: Survey, in_air: list[TimeInterval]) -> tuple[bool, str]:
    if survey.vehicle_class.is_rotorcraft:
        return False, f"no diagnosis of a {survey.vehicle}: the reference simulation is a fixed wing"
    if sparse := [kind for kind in REQUIRED_FIELDS if survey.rows[kind].count < MIN_DIAGNOSE_ROWS]:
        return False, f"fewer than {MIN_DIAGNOSE_ROWS} {', '.join(sparse)} rows in the recording"
    gap_free_s = seconds(_gap_free_spans(survey, in_air))
    if gap_free_s < MIN_DIAGNOSE_S:
        available = format_below(gap_free_s, MIN_DIAGNOSE_S)
        return False, f"{available} s in flight without gaps, {MIN_DIAGNOSE_S:.0f} s are required"
    has_past = gap_free_s >= MIN_OWN_PAST_S
    reason = f"{gap_free_s:.0f} s in flight without gaps, compared with a model of `fleet calibrate`"
    reason += " or earlier flight data" if has_past else f"; {MIN_OWN_PAST_S:.0f} s for earlier flight data"
    missing = [] if survey.rows["imu"].rate_hz >= GUST_SENSING_HZ else [f"accelerometer at {GUST_SENSING_HZ:.0f} Hz"]
    missing += [label for kind, label in (("air", "airspeed"), ("pressure", "pressure")) if not survey.rows[kind].count]
    return True, reason + (f"; reduced sensitivity without {', '.join(missing)}" if missing else "")


def _gap_free_spans(survey: Survey, in_air: list[TimeInterval]) -> list[TimeInterval]:
    """Return the flight intervals without gaps in required fields, start and end of the rows excluded."""
    starts, stops = np.transpose([survey.rows[kind].rows()[0][[0, -1]] for kind in REQUIRED_FIELDS]).tolist()
    parts = overlap(in_air, [TimeInterval(max(starts) + _SKIP_BEGIN_S, min(stops) - _SKIP_END_S)])
    for kind in REQUIRED_FIELDS:
        gaps = survey.rows[kind].gaps()
        starts, stops = [-np.inf, *(gap.stop for gap in gaps)], [*(gap.start for gap in gaps), np.inf]
        parts = overlap(parts, [TimeInterval(a, b) for a, b in zip(starts, stops, strict=True)])
    return parts
