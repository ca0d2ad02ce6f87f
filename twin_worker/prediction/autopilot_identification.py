"""Identification of the control law and of missing autopilot parameters by replay of the flight.

A known autopilot has a known law; the guidance of PX4 depends on its release, which the received parameters tell, and
without them the replay. For any other autopilot the law with the smallest error to the commanded banks is
selected. Turn parameters are estimated by a search over several values, scored over all replays. Bank limit, airspeed
and waypoint radius are read from the flight. Parameters that cannot be identified keep their default and are reported
as defaults.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import atan2, degrees, isfinite, pi, radians

import numpy as np

from fleet.autopilots import laws
from fleet.autopilots.shadow import NO_MEMORY, replay_controller
from fleet.frames import wrap
from fleet.mission import P_D, P_N, SEQ, VA_C, WAYPOINT
from twin_worker.estimation.airspeed_setpoint import reported_setpoint
from twin_worker.prediction.autopilot_parameters import CRUISE_OF, fixed_wing_controller
from twin_worker.prediction.closed_loop import autopilot_wind
from twin_worker.prediction.replay_window import MAX_BANK_ERROR, PredictionContext, ReplayWindow, replay_inputs

LAW_OF_AUTOPILOT = {"ardupilot": "arduplane", "px4": "px4"}  # in current releases
_RELEASES = {"px4": ("px4", "px4_l1")}  # laws of an autopilot by release, newest first
_ANY = ("arduplane", "px4", "textbook")  # laws tried for any other autopilot
REPLAY_INTERVAL_S = 10.0  # interval of replays [s]
_MIN_REPLAY_S = 5.0  # shortest flight on the present route that is replayed [s]
_MIN_TURN_BANK = radians(12.0)  # smaller banks do not distinguish laws [rad]
_SMOOTHING = 0.15  # smoothing weight of the newest replay
_LIMIT_BAND = radians(0.3), 8  # band below the steepest bank, and minimum reports in it, that indicate a limit [rad]
_SPEED_RANGE = (0.7, 1.4)  # default minimum and maximum airspeed over cruise [-]
_MIN_SWITCH_TURN = radians(35.0)  # minimum turn that determines the switch distance [rad]
_TURN_PARAMETERS: dict[str, dict[str, tuple[float, ...]]] = {  # turn parameters, tried if not received
    "arduplane": {
        "NAVL1_PERIOD": (8.0, 10.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0, 20.0, 22.0, 25.0, 30.0),
        "NAVL1_DAMPING": (0.65, 0.7, 0.75, 0.8, 0.85, 0.95),
    },
    "px4": {"NPFG_PERIOD": (6.0, 8.0, 10.0, 12.0, 14.0, 17.0, 20.0, 25.0)},
    "px4_l1": {
        "FW_L1_PERIOD": (10.0, 12.0, 14.0, 15.0, 16.0, 17.0, 18.0, 20.0, 22.0, 25.0, 30.0),
        "FW_L1_DAMPING": (0.65, 0.7, 0.75, 0.8, 0.85, 0.95),
    },
    "textbook": {"k_path": (0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08)},
}
_BANK_LIMIT = {
    "arduplane": ("ROLL_LIMIT_DEG", 1.0),
    "px4": ("FW_R_LIM", 1.0),
    "px4_l1": ("FW_R_LIM", 1.0),
    "textbook": ("phi_max", radians(1.0)),
}
_SPEED_LIMITS: dict[str, tuple[str, ...]] = {
    "arduplane": ("AIRSPEED_MIN", "AIRSPEED_MAX"),
    "px4": ("FW_AIRSPD_MIN", "FW_AIRSPD_MAX"),
    "px4_l1": ("FW_AIRSPD_MIN", "FW_AIRSPD_MAX"),
    "textbook": (),
}


@dataclass
class AutopilotEstimate:
    """Identified law and parameters of one autopilot.

    Attributes:
        law: name in `laws.LAWS`; empty while unknown
        values: identified parameters of that law, in autopilot units
        reason: how the law was selected, or why none is; empty for a known autopilot
        steepest_banks: steepest commanded banks so far [rad]
        switch_radii: waypoint radii from switches so far [m]
        cost: smoothed bank error of each tried value [rad], by law, parameter and value
        bank_error: smoothed bank error of each law [rad]
        replay_t: last replay [s since 1970]
    """

    law: str = ""
    values: dict[str, float] = field(default_factory=dict)
    reason: str = ""
    steepest_banks: np.ndarray = field(default_factory=lambda: np.empty(0))
    switch_radii: dict[int, float] = field(default_factory=dict)
    cost: dict[tuple[str, str, float], float] = field(default_factory=dict)
    bank_error: dict[str, float] = field(default_factory=dict)
    replay_t: float = -np.inf


def identify_autopilot(estimate: AutopilotEstimate, autopilot: str, context: PredictionContext) -> None:
    """Replay the flight to identify unknown law and parameters; update `estimate` in place.

    Args:
        estimate: earlier estimate
        autopilot: reported autopilot type
        context: newest telemetry; its law and values are ignored
    """
    own_law = _received_law(autopilot, context.onboard.params)
    candidates = (own_law,) if own_law else _RELEASES.get(autopilot, _ANY)
    missing = {law: laws.parameters(law, context.onboard.params)[1] for law in candidates}
    if own_law:
        estimate.law, estimate.reason = own_law, ""
    if own_law and not any(missing.values()):
        estimate.values = {}
        return
    replay = replay_inputs(context)
    if not isinstance(replay, ReplayWindow) or replay.window.seconds < _MIN_REPLAY_S:
        return
    estimate.replay_t = float(replay.window.t[-1])
    _update_banks(estimate, replay.phi_c)
    has_turns = bool((np.abs(replay.phi_c) > _MIN_TURN_BANK).any())
    values = {law: _read_values(estimate, law, absent, context, replay) for law, absent in missing.items()}
    if has_turns:
        for law, absent in missing.items():
            _fit_turn_parameters(estimate, law, absent, (context, replay), values[law])
    if not own_law:
        received = [law for law, absent in missing.items() if next(iter(_TURN_PARAMETERS[law])) not in absent]
        _select_law(estimate, autopilot, received)
    if estimate.law:
        estimate.values = values[estimate.law]


def law_in_force(autopilot: str, params: Mapping[str, float], identified: str) -> str:
    """Return the law of an autopilot: by received parameters, else identified, else of its current release."""
    newest = LAW_OF_AUTOPILOT.get(autopilot, identified)
    released = identified if identified in _RELEASES.get(autopilot, ()) else newest
    return _received_law(autopilot, params) or released


def _received_law(autopilot: str, params: Mapping[str, float]) -> str:
    """Return the law of an autopilot, by received parameters where it depends on the release; empty if unknown."""
    releases = _RELEASES.get(autopilot)
    if releases is None:
        return LAW_OF_AUTOPILOT.get(autopilot, "")
    if params.get("FW_USE_NPFG") == 0.0:  # PX4 1.13 has both
        return "px4_l1"
    return next((law for law in releases if next(iter(_TURN_PARAMETERS[law])) in params), "")


def _update_banks(estimate: AutopilotEstimate, phi_c: np.ndarray) -> None:
    """Store the steepest commanded banks."""
    banks = np.concatenate([estimate.steepest_banks, np.abs(phi_c[np.isfinite(phi_c)])])
    estimate.steepest_banks = np.sort(banks)[-200:]


def _read_values(
    estimate: AutopilotEstimate, law: str, absent: tuple[str, ...], context: PredictionContext, replay: ReplayWindow
) -> dict[str, float]:
    """Read the parameters that need no replay from the flight."""
    values: dict[str, float] = {}
    name, unit = _BANK_LIMIT[law]
    if name in absent and len(estimate.steepest_banks):
        top = float(estimate.steepest_banks[-1])
        if (estimate.steepest_banks > top - _LIMIT_BAND[0]).sum() >= _LIMIT_BAND[1] and top > _MIN_TURN_BANK:
            values[name] = degrees(top) * unit
    cruise = CRUISE_OF[law]
    if cruise in absent:
        values[cruise] = _cruise_airspeed(estimate, context, replay, cruise)
        values |= dict(zip(_SPEED_LIMITS[law], (ratio * values[cruise] for ratio in _SPEED_RANGE), strict=False))
    if law == "arduplane" and "WP_RADIUS" in absent:
        estimate.switch_radii.update(_switch_radii(replay))
        if estimate.switch_radii:
            values["WP_RADIUS"] = float(np.median(list(estimate.switch_radii.values())))
    return {name: value for name, value in values.items() if name in absent}


def _cruise_airspeed(estimate: AutopilotEstimate, context: PredictionContext, replay: ReplayWindow, name: str) -> float:
    """Return the set-point on a leg without commanded speed, else the identified or the flown airspeed [m/s]."""
    leg_rows = np.flatnonzero(replay.legs[:, SEQ] == replay.seq[-1])
    setpoint = reported_setpoint(context.history, estimate.replay_t)
    if len(leg_rows) and replay.legs[leg_rows[0], VA_C] <= 0 and isfinite(setpoint):
        return setpoint
    airspeeds = replay.Va[np.isfinite(replay.Va) & (replay.Va > 3.0)]
    return estimate.values.get(name, float(np.median(airspeeds)) if len(airspeeds) else 15.0)


def _switch_radii(replay: ReplayWindow) -> dict[int, float]:
    """Return the waypoint radius of each switch between two lines [m], by time: distance over turn fraction."""
    radii: dict[int, float] = {}
    dt = float(replay.t[1] - replay.t[0])
    for k in np.flatnonzero(np.diff(replay.seq)).tolist():
        i = np.flatnonzero(replay.legs[:, SEQ] == replay.seq[k])
        if not len(i) or not 0 < i[0] < len(replay.legs) - 1 or (replay.legs[i[0] - 1 : i[0] + 2, 0] != WAYPOINT).any():
            continue
        a, b, c = replay.legs[i[0] - 1 : i[0] + 2, P_N:P_D]
        turn = abs(wrap(atan2(c[1] - b[1], c[0] - b[0]) - atan2(b[1] - a[1], b[0] - a[0])))
        delay_rows = min(int(0.5 / dt), k)  # mean delay of a report once a second
        if turn > _MIN_SWITCH_TURN:
            distance = float(np.hypot(*(replay.p[k - delay_rows, :2] - b)))
            radii[round(float(replay.window.t[0] + replay.t[k]))] = distance / (min(turn, pi / 2) / (pi / 2))
    return radii


def _fit_turn_parameters(
    estimate: AutopilotEstimate,
    law: str,
    absent: tuple[str, ...],
    replay_data: tuple[PredictionContext, ReplayWindow],
    values: dict[str, float],
) -> None:
    """Try the values of the turn parameters one after the other; set the best in `values`."""
    for name, trials in _TURN_PARAMETERS[law].items():
        if name not in absent:
            continue
        for value in trials:
            rms = _bank_rms(law, replay_data, {**values, name: value})
            key = law, name, value
            previous = estimate.cost.get(key, rms)
            estimate.cost[key] = previous + _SMOOTHING * (rms - previous)
        values[name] = _parabola_minimum([(value, estimate.cost[law, name, value]) for value in trials])
    rms = _bank_rms(law, replay_data, values)
    previous = estimate.bank_error.get(law, rms)
    estimate.bank_error[law] = previous + _SMOOTHING * (rms - previous)


def _parabola_minimum(costs: list[tuple[float, float]]) -> float:
    """Return the minimum of the parabola through the value of least cost and its neighbours."""
    x, y = (np.array(column) for column in zip(*costs, strict=True))
    k = int(np.argmin(y))
    if not 0 < k < len(x) - 1:
        return float(x[k])
    a, b, _ = np.polyfit(x[k - 1 : k + 2] - x[k], y[k - 1 : k + 2], 2)
    return float(x[k] + np.clip(-b / (2 * a), x[k - 1] - x[k], x[k + 1] - x[k])) if a > 0 else float(x[k])


def _bank_rms(law: str, replay_data: tuple[PredictionContext, ReplayWindow], values: Mapping[str, float]) -> float:
    """Replay the flight; return the RMS error of the law to the commanded banks [rad]."""
    context, replay = replay_data
    controller = fixed_wing_controller(context.onboard.params, values, law=law)
    par = laws.with_wind(controller.par(replay.altitude_m), *autopilot_wind(context, replay.window))
    _, rms = replay_controller(par, replay.legs, replay.start_point, *replay.rows, replay.seq, NO_MEMORY)  # type: ignore[call-arg]
    return float(rms) if isfinite(rms) else np.inf


def _select_law(estimate: AutopilotEstimate, autopilot: str, received: Sequence[str]) -> None:
    """Select the law with the smallest bank error if it is below the limit; first of those whose parameters came."""
    newest = LAW_OF_AUTOPILOT.get(autopilot, "")
    if not estimate.bank_error:
        unknown = f"autopilot {autopilot}: no commanded bank received in a turn yet, control law unknown"
        estimate.law, estimate.reason = newest, "" if newest else unknown
        return
    matching = {law: error for law, error in estimate.bank_error.items() if error < MAX_BANK_ERROR}
    own = {law: error for law, error in matching.items() if law in received}
    law, error = min((own or matching or estimate.bank_error).items(), key=lambda pair: pair[1])
    within = f"the commanded banks within {degrees(error):.1f} deg"
    if error < MAX_BANK_ERROR:
        estimate.law = law
        estimate.reason = f"autopilot {autopilot}: control law {laws.LAWS[law].description} matches {within}"
    else:
        estimate.law = newest
        estimate.reason = f"autopilot {autopilot}: no known control law matches {within}"
