"""Compare the data of a recording with the requirements of each function of the twin.

The limits equal those of the twin; a test compares both.
"""

from typing import NamedTuple

import numpy as np

from fleet.airframes.airframe import ServoMap, servo_map
from fleet.contract import COLUMNS
from fleet.mission import FIRST_ITEM, unroll_route
from fleet.process.sanitise import format_below
from fleet.telemetry.inspection.survey import (
    AIRBORNE_SPEED,
    MAX_INTERVAL_S,
    ROTOR_AIRBORNE_SPEED,
    Survey,
    airborne,
    mode_spans,
)
from fleet.telemetry.inspection.thinned import TimeInterval, inside, overlap, seconds
from fleet.window import INPUTS

REQUIRED_FIELDS = tuple(MAX_INTERVAL_S)
MIN_IDENTIFY_S = 30.0  # minimum data for an identification [s]
MAX_IDENTIFY_S = 140.0  # window of one identification [s]
MIN_STRETCH_S = 4.0  # shortest continuous stretch for model verification [s]
TURN_RATE_S = 2.0  # recent data that a turn-rate prediction requires [s]
MIN_ROUTE_S = 5.0  # time on a route that a route prediction requires [s]
MIN_EXCITATION = {"phi": 0.04, "theta": 0.04, "q": 0.05}  # standard deviations [rad, rad, rad/s]
MIN_AIRSPEED, MAX_PAIR_AGE_S = 3.0, 0.5  # airspeed [m/s], age of rows paired with a ground velocity [s]
MIN_WIND_TRIANGLES = 50  # wind triangles that a wind estimate requires
ROUTE_MODES = ("AUTO", "MISSION", "AUTO.MISSION")
MIN_DIAGNOSE_S, MIN_DIAGNOSE_ROWS = 25.0, 50  # gap-free flight, and rows of each required field, for a diagnosis
MIN_OWN_PAST_S = 50.0  # gap-free flight for a comparison with earlier flight data [s]
GUST_SENSING_HZ = 18.0  # accelerometer rate for gust estimation [Hz]
_SKIP_BEGIN_S, _SKIP_END_S = 5.0, 1.5  # start and end of a recording excluded from a diagnosis [s]
_ITEMS_REMEDY = {  # how to record mission items, by kind of recording
    "ULog": "PX4 logs no mission items; record telemetry instead (.tlog), with the mission downloaded while recording",
    "DataFlash log": "the autopilot logs them as CMD messages (ArduPilot); keep the log from its beginning",
    "DataFlash text log": "the autopilot logs them as CMD messages (ArduPilot); keep the log from its beginning",
    "fleet recording": "the gateway downloads it unless --listen-only is set; record with it connected",
}
_GOOD_HZ = 10.0  # below this rate fast motion is poorly resolved [Hz]
_MIN_INPUT_STD = 0.005  # standard deviation below which an input is constant, fraction of its range [-]
_SURFACE_NAME = {"delta_a": "aileron", "delta_e": "elevator", "delta_r": "rudder", "delta_t": "throttle"}


class AbilityCheck(NamedTuple):
    """One function of the twin, whether this recording supports it, and the reason with values found and required."""

    name: str
    can: bool
    why: str


def abilities(survey: Survey) -> list[AbilityCheck]:
    """Check all functions of the twin in processing order."""
    in_air = airborne(survey)
    complete = complete_spans(survey)
    obstacle = _model_obstacle(survey) or _data_obstacle(survey, in_air, complete)
    input_std = input_variation(survey, overlap(complete, in_air))
    axes = (
        _identify_axis("identify longitudinal", survey, obstacle, input_std, ("delta_e", "delta_t")),
        _identify_axis("identify lateral", survey, obstacle, input_std, ("delta_a", "delta_r")),
    )
    unidentified = _unidentified(axes)
    verified = _check_verify(survey, unidentified, overlap(complete, in_air))
    wind = _check_wind(survey)
    return [
        *axes,
        verified,
        _check_route(survey, unidentified, in_air),
        _check_turn_rate(survey, complete),
        wind,
        _check_diagnose(survey, in_air),
    ]


def _unidentified(axes: tuple[AbilityCheck, AbilityCheck]) -> str:
    """Return which axis cannot be identified, or an empty string."""
    failed = [axis.name.split()[-1] for axis in axes if not axis.can]
    if not failed:
        return ""
    return "neither axis can be identified" if len(failed) == 2 else f"the {failed[0]} axis cannot be identified"


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
    best = 0.0
    for last in spans:
        start = last.stop - window_s
        best = max(best, seconds(overlap(spans, [TimeInterval(start, last.stop)])))
    return best


def _model_obstacle(survey: Survey) -> str:
    return (
        f"a {survey.vehicle} is not modelled, turn-rate prediction only" if survey.vehicle_class.is_rotorcraft else ""
    )


def _data_obstacle(survey: Survey, in_air: list[TimeInterval], complete: list[TimeInterval]) -> str:
    """Return what prevents an identification, or an empty string."""
    if missing := _missing_fields(survey):
        return missing
    if not in_air:
        fast = ROTOR_AIRBORNE_SPEED if survey.vehicle_class.can_hover else AIRBORNE_SPEED
        return f"never in flight: no 5 s faster than {fast:.0f} m/s"
    for name in REQUIRED_FIELDS:
        covered = seconds(overlap(survey.rows[name].stretches(), in_air))
        if covered < 0.5 * seconds(in_air):
            return (
                f"{name} at {survey.rows[name].rate_hz:.1f} Hz is continuous for {covered:.0f} of {seconds(in_air):.0f}"
                f" s in flight; required: no interval over {MAX_INTERVAL_S[name]:g} s, recommended: {_GOOD_HZ:.0f} Hz"
            )
    parts = overlap(complete, in_air)
    available_s = max_coverage(parts, MAX_IDENTIFY_S)
    if available_s < MIN_IDENTIFY_S:
        return (
            f"{format_below(available_s, MIN_IDENTIFY_S)} s of complete data in flight, {MIN_IDENTIFY_S:.0f} s "
            "are required"
        )
    longest = max(part.seconds for part in parts)
    if longest < MIN_STRETCH_S:
        return f"the longest continuous stretch is {longest:.1f} s, {MIN_STRETCH_S:.0f} s are required"
    return ""


def _missing_fields(survey: Survey) -> str:
    """Return which required fields have no rows, or an empty string."""
    missing = [name for name in REQUIRED_FIELDS if survey.rows[name].count < 8]
    return f"no {', '.join(missing)} rows in the recording" if missing else ""


def _identify_axis(
    name: str, survey: Survey, obstacle: str, input_std: dict[str, float], inputs: tuple[str, ...]
) -> AbilityCheck:
    if obstacle:
        return AbilityCheck(name, False, obstacle)
    constant = [_SURFACE_NAME[channel] for channel in inputs if input_std[channel] < _MIN_INPUT_STD]
    servos = servo_map(survey.values)
    if len(constant) == len(inputs):
        return AbilityCheck(name, False, f"{' and '.join(constant)} constant in flight{_assumption_note(servos)}")
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
    return AbilityCheck(name, True, reason + _assumption_note(servos))


def _assumption_note(servos: ServoMap) -> str:
    return " (servo map assumed)" if servos.sentence else ""


def _check_verify(survey: Survey, unidentified: str, spans: list[TimeInterval]) -> AbilityCheck:
    if unidentified:
        return AbilityCheck("verify", False, unidentified)
    t, x = survey.rows["attitude"].rows()
    selected = x[inside(t, spans)]
    columns = [name for name, _ in COLUMNS["attitude"]]
    std = {name: float(selected[:, columns.index(name)].std()) for name in MIN_EXCITATION}
    phi, theta, q = np.degrees(list(std.values()))
    variation = f"bank varies by {phi:.1f} deg, pitch by {theta:.1f} deg, pitch rate by {q:.1f} deg/s"
    if all(std[name] < limit for name, limit in MIN_EXCITATION.items()):
        required = "{:.1f} deg, {:.1f} deg or {:.1f} deg/s are required".format(
            *np.degrees(list(MIN_EXCITATION.values()))
        )
        return AbilityCheck("verify", False, f"steady flight, too little excitation: {variation}, {required}")
    return AbilityCheck("verify", True, variation)


def _check_route(survey: Survey, unidentified: str, in_air: list[TimeInterval]) -> AbilityCheck:
    """Check route prediction with an identified model, else with the kinematic model of the vehicle type."""
    name = "predict on the route"
    if unidentified and not (survey.vehicle_class.has_wings or survey.vehicle_class.can_hover):
        return AbilityCheck(
            name, False, f"{unidentified}, and a vehicle of kind {survey.vehicle} has no kinematic model"
        )
    if missing := [kind for kind in ("attitude", "velocity", "position") if survey.rows[kind].count < 8]:
        return AbilityCheck(name, False, f"no {', '.join(missing)} rows in the recording")
    following = overlap([span for span, mode in mode_spans(survey) if mode in ROUTE_MODES], in_air)
    on_route_s = seconds(following)
    if on_route_s < MIN_ROUTE_S:
        modes = ", ".join(dict.fromkeys(mode for _, mode in mode_spans(survey))) or "no mode"
        return AbilityCheck(
            name,
            False,
            f"{format_below(on_route_s, MIN_ROUTE_S)} s in a mode that follows a mission, {MIN_ROUTE_S:.0f} s "
            f"are required ({modes})",
        )
    origin = survey.origin()
    if not survey.items or origin is None:
        remedy = _ITEMS_REMEDY.get(survey.kind, "let the ground station download it while recording")
        return AbilityCheck(name, False, f"no mission list in the recording; {remedy}")
    autopilot = survey.status.autopilot if survey.status else "unknown"
    first = FIRST_ITEM.get(autopilot, 1)
    if not len(unroll_route(survey.items, seq=first, origin=origin, params=survey.values, first=first).legs):
        return AbilityCheck(name, False, f"the mission of {len(survey.items)} items has no legs")
    if not survey.rows["leg"].count:
        return AbilityCheck(name, False, "the current mission item is not in the recording (MISSION_CURRENT)")
    supported = autopilot in ("ardupilot", "px4")
    law_note = (
        "" if supported else f"; guidance law of autopilot {autopilot} is identified from its bank commands, if any"
    )
    items = f"{len(survey.items)} mission items" + ("" if survey.mission and survey.mission.complete else ", not all")
    if survey.vehicle_class.is_rotorcraft:
        return AbilityCheck(name, True, f"{on_route_s:.0f} s on the route, {items}; from speed and acceleration limits")
    method = (
        f"kinematic fixed-wing model, since {unidentified}" if unidentified else "take-off and landing not modelled"
    )
    return AbilityCheck(name, True, f"{on_route_s:.0f} s on the route, {items}; {method}{law_note}")


def _check_turn_rate(survey: Survey, complete: list[TimeInterval]) -> AbilityCheck:
    name = "predict by turn rate"
    if missing := _missing_fields(survey):
        return AbilityCheck(name, False, missing)
    longest = max((span.seconds for span in complete), default=0.0)
    if longest < TURN_RATE_S:
        rates = ", ".join(f"{kind} {survey.rows[kind].rate_hz:.1f} Hz" for kind in REQUIRED_FIELDS)
        return AbilityCheck(
            name, False, f"never {TURN_RATE_S:.0f} s of complete data: {rates}; 2 Hz without gaps is required"
        )
    return AbilityCheck(
        name,
        True,
        f"{seconds([stretch for stretch in complete if stretch.seconds >= TURN_RATE_S]):.0f} s of complete data",
    )


def _check_wind(survey: Survey) -> AbilityCheck:
    name = "estimate wind"
    missing = [kind for kind in ("velocity", "air", "attitude") if not survey.rows[kind].count]
    if missing:
        return AbilityCheck(name, False, f"no {', '.join(missing)} rows in the recording")
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
        max_airspeed = float(air[:, 0].max())
        return AbilityCheck(
            name,
            False,
            f"{pairs} wind triangles, {MIN_WIND_TRIANGLES} are required; airspeed reaches {max_airspeed:.1f} m/s",
        )
    return AbilityCheck(name, True, f"{pairs} wind triangles of ground velocity, airspeed and heading")


def _check_diagnose(survey: Survey, in_air: list[TimeInterval]) -> AbilityCheck:
    """Check the requirements of `fleet diagnose`."""
    name = "diagnose"
    if survey.vehicle_class.is_rotorcraft:
        return AbilityCheck(
            name, False, f"no diagnosis of a {survey.vehicle}: the reference simulation is a fixed wing"
        )
    if sparse := [kind for kind in REQUIRED_FIELDS if survey.rows[kind].count < MIN_DIAGNOSE_ROWS]:
        return AbilityCheck(name, False, f"fewer than {MIN_DIAGNOSE_ROWS} {', '.join(sparse)} rows in the recording")
    gap_free_s = seconds(_gap_free_spans(survey, in_air))
    if gap_free_s < MIN_DIAGNOSE_S:
        available = format_below(gap_free_s, MIN_DIAGNOSE_S)
        return AbilityCheck(name, False, f"{available} s in flight without gaps, {MIN_DIAGNOSE_S:.0f} s are required")
    reason = f"{gap_free_s:.0f} s in flight without gaps, compared with a model of `fleet calibrate`"
    reason += (
        " or earlier flight data"
        if gap_free_s >= MIN_OWN_PAST_S
        else f"; {MIN_OWN_PAST_S:.0f} s for earlier flight data"
    )
    missing = [] if survey.rows["imu"].rate_hz >= GUST_SENSING_HZ else [f"accelerometer at {GUST_SENSING_HZ:.0f} Hz"]
    missing += [label for kind, label in (("air", "airspeed"), ("pressure", "pressure")) if not survey.rows[kind].count]
    return AbilityCheck(name, True, reason + (f"; reduced sensitivity without {', '.join(missing)}" if missing else ""))


def _gap_free_spans(survey: Survey, in_air: list[TimeInterval]) -> list[TimeInterval]:
    """Return the flight intervals without gaps in required fields, start and end of the rows excluded."""
    ends = [survey.rows[kind].rows()[0][[0, -1]] for kind in REQUIRED_FIELDS]
    parts = overlap(
        in_air,
        [TimeInterval(max(start for start, _ in ends) + _SKIP_BEGIN_S, min(stop for _, stop in ends) - _SKIP_END_S)],
    )
    for kind in REQUIRED_FIELDS:
        gaps = survey.rows[kind].gaps()
        starts, stops = [-np.inf, *(gap.stop for gap in gaps)], [*(gap.start for gap in gaps), np.inf]
        parts = overlap(parts, [TimeInterval(a, b) for a, b in zip(starts, stops, strict=True)])
    return parts
