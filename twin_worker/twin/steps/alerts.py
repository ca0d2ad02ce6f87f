"""Alerts of a single aircraft: link, ground, geofence, short horizon, infeasible mission."""

import numpy as np

from fleet.contract import Alert, AlertKind, Prediction
from fleet.frames import Origin, to_ned
from twin_worker.alerts.feasibility import Now, ability, achievable
from twin_worker.alerts.gaussian_forecast import Forecast, forecast
from twin_worker.alerts.geofence import fence, leaves
from twin_worker.alerts.ground_clearance import ROTORS_M, WINGS_M, above, sinks
from twin_worker.alerts.hysteresis import Finding
from twin_worker.confidence.table_files import GUESSED
from twin_worker.prediction.closed_loop import unrolled
from twin_worker.prediction.multirotor.rollout import RETURN_MODES
from twin_worker.twin.state.state import Twin
from twin_worker.twin.state.vehicle_class import WINGS, hangs

_SHORT_S, _LONG_S = 10.0, 12.0  # an alert is raised below the first confidence horizon and cleared above the second [s]
_TOLD = 30  # minimum number of scored predictions; below it, the 90 % horizon comes from the prior table [-]
_TURNING_S = 15.0  # ground and geofence look-ahead of turn-rate predictions [s]
_REACH_S = 90.0  # maximum look-ahead; beyond it, the tube is wider than usual geofence margins [s]
_GUESSED_S = 30.0  # look-ahead for an uncalibrated tube [s]
_BETTER_S = 20.0  # on a mission, turn-rate predictions raise alerts only after this time without a better method [s]
_ACHIEVABLE_EVERY_S = 5.0
_LANDING = (21, 85, 189)  # MAV_CMD: NAV_LAND, NAV_VTOL_LAND, DO_LAND_START
_RETURN, _LAST_NAV = 20, 95  # MAV_CMD
_ABOUT_TO = 3  # navigation items, the active one included, in which a landing suppresses ground alerts [-]


def link(twin: Twin, now: float, silent: float) -> list[Alert]:
    """Raise or clear the link alert according to `twin.lost`; `silence_s` since the newest sample [s]."""
    said = f"no sample for {silent:.1f} s; the twin predicts without telemetry"
    return twin.ledger.judge(twin.uav, now, Finding(AlertKind.LINK_LOST, float(twin.lost), said, "link back"))


def watch(twin: Twin, now: float, made: Prediction | None) -> list[Alert]:
    """Evaluate all alerts for the newest prediction at data time `now`; None if there is no prediction."""
    flight = forecast(made) if made is not None else None
    _remember_ground(twin)
    if flight is None or flight.made.method != "imm" or not now >= twin.turning_t:
        twin.turning_t = now
    findings = [_unknown(kind) for kind in (AlertKind.GROUND, AlertKind.GEOFENCE)]
    if flight is not None:
        guess = flight.made.method == "imm" and not twin.why_no_route() and now - twin.turning_t < _BETTER_S
        findings = [] if guess else _dangers(twin, flight)
    if not twin.lost:
        findings.append(_trust(made))
        if not twin.achievable_t <= now < twin.achievable_t + _ACHIEVABLE_EVERY_S:
            twin.achievable_t = now
            findings.append(_mission(twin, now))
    return [alert for finding in findings for alert in twin.ledger.judge(twin.uav, now, finding)]


def _unknown(kind: AlertKind) -> Finding:
    return Finding(kind, 0.0, "", "no longer predicted")


def _remember_ground(twin: Twin) -> None:
    """Store the disarmed position as a fallback for home, and reset the maximum height."""
    if twin.status is None or twin.status.armed:
        return
    twin.peak = -np.inf
    _, position = twin.history.look("position", twin.history.newest - 2.0)
    if len(position):
        twin.stood = Origin(*map(int, position[-1]))


def home(twin: Twin) -> Origin | None:
    """Return home: item 0 of an ArduPilot mission, else the last disarmed position; None if unknown."""
    items = twin.mission.items if twin.mission is not None else ()
    first = next((item for item in items if item.seq == 0), None)
    ardupilot = twin.status is not None and twin.status.autopilot == "ardupilot"
    if first is None or not ardupilot or not (first.lat_e7 or first.lon_e7) or not abs(first.alt_m) < 1e5:
        return twin.stood
    return Origin(first.lat_e7, first.lon_e7, round(first.alt_m * 1e3))


def _dangers(twin: Twin, flight: Forecast) -> list[Finding]:
    """Evaluate ground clearance and geofence; neither without a home position."""
    base, rotors = home(twin), hangs(twin)
    if base is None:
        return [_unknown(AlertKind.GROUND), _unknown(AlertKind.GEOFENCE)]
    margin = ROTORS_M if rotors else WINGS_M
    twin.peak = max(twin.peak, float(above(flight, base)[0]))
    until = flight.made.t + _reach_s(flight.made)
    found = [_unknown(AlertKind.GROUND)]
    low = twin.peak <= margin or _lands(twin, rotors)  # still taking off, possibly on rotors
    if not low:
        found = [sinks(flight, base, margin, until)]
    limit = fence(_params(twin))
    if low:
        limit = limit._replace(floor=-np.inf)
    return [*found, leaves(flight, limit, base, until) if limit.limits() else _unknown(AlertKind.GEOFENCE)]


def _reach_s(made: Prediction) -> float:
    """Return the look-ahead up to which a prediction is used for ground and geofence alerts [s]."""
    if made.method == "imm":
        return _TURNING_S
    return _GUESSED_S if made.calibration.startswith(GUESSED) else _REACH_S


def _lands(twin: Twin, rotors: bool) -> bool:
    """Return whether the aircraft is landing, or is about to by its mode or mission."""
    mode = twin.status.mode if twin.status is not None else ""
    if "LAND" in mode or (rotors and mode in RETURN_MODES):
        return True
    if twin.why_no_route() or twin.mission is None:
        return False
    items = sorted(twin.mission.items, key=lambda item: item.seq)
    ahead = [item.command for item in items if item.seq >= twin.mission.seq]
    flown = [command for command in ahead if command < _LAST_NAV or command in _LANDING][:_ABOUT_TO]
    return any(command in _LANDING or (rotors and command == _RETURN) for command in flown)


def _trust(made: Prediction | None) -> Finding:
    """Evaluate the confidence horizon of a route prediction, once enough past predictions are scored."""
    short = 0.0
    if made is not None and made.method != "imm" and made.held_n >= _TOLD and not made.horizon_open:
        short = 1.0 if made.horizon_s < _SHORT_S else 0.5 if made.horizon_s < _LONG_S else 0.0
    said = f"predictions stay within 10 % for only {made.horizon_s if made else 0.0:.0f} s"
    return Finding(AlertKind.SHORT_HORIZON, short, said, "confidence horizon recovered")


def _mission(twin: Twin, now: float) -> Finding:
    """Evaluate the feasibility of the legs ahead for a fixed wing that follows its mission."""
    nothing = Finding(AlertKind.NOT_ACHIEVABLE, 0.0, "", "the mission is achievable")
    _, position = twin.history.look("position", twin.history.newest - 3.0)
    if twin.vehicle not in WINGS or twin.why_no_route() or hangs(twin) or not len(position):
        return nothing
    assert twin.origin is not None and twin.mission is not None
    if twin.mission.seq < twin.first_item:
        return nothing
    p = to_ned(twin.origin, *position[-1:].T)[0]
    way = unrolled(twin.mission.items, twin.mission.seq, twin.origin, _params(twin), twin.first_item)
    wind = np.array([*twin.wind.wind[:2], twin.wind.sigma])
    return achievable(Now(now, p, twin.origin, wind, way), ability(_params(twin), position[-1, 2] * 1e-3))


def _params(twin: Twin) -> dict[str, float]:
    return twin.params.values if twin.params else {}
