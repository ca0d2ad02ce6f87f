"""Predict one path: the route flown by the best available model, else a turn-rate prediction; tube and horizon."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from fleet.contract import SENTENCES, Array, Controller, Event, Message, Prediction, State
from twin_worker.confidence.groups import airframe_class, group_of
from twin_worker.confidence.tube_and_horizon import AHEAD, QUANTILE, Made, Trust
from twin_worker.identification.fixed_wing.plant import DYNAMICS
from twin_worker.prediction.autopilot_parameters import IDENTIFIED, Control
from twin_worker.prediction.closed_loop import LEAST_AHEAD_S
from twin_worker.prediction.turn_rate import turn_on
from twin_worker.telemetry.track import Track
from twin_worker.twin.state.events import note
from twin_worker.twin.state.state import Twin
from twin_worker.twin.state.vehicle_class import Flight, fly_kind, hangs, nothing, seen
from twin_worker.twin.steps.rollouts import BOTH, HYBRID, fly_route, in_force

LOOK_BACK_S = 62.0  # telemetry used for a prediction [s]
_TELL_S = 10.0  # between reports of unchanged law and parameters [s]
_STALE_S = 3.0  # maximum age of positions relative to other telemetry [s]
_MISSED = 2  # maximum number of absent autopilot parameters in the group of known parameters [-]
_LEARNT = (BOTH, HYBRID, DYNAMICS)
_IMM_LAW, _NO_LAW = "none: turn rate only", "none: on the ground"


def foresee(twin: Twin, now: float) -> list[Message]:
    """Predict from the newest telemetry at data time `now`; return nothing if data are insufficient.

    Without positions the prediction coasts: it continues from the last valid state until its confidence horizon ends.
    """
    assert twin.origin is not None
    flown = seen(twin, LOOK_BACK_S, turned=False)
    if flown is None:
        return []
    coast = _coasts(twin, flown, now)
    if coast and (twin.over or _is_over(twin, coast, now)):
        return _close(twin, coast, now)
    twin.over = False
    ahead = AHEAD + round(coast)
    if not flown.ok[-1] or (not coast and twin.history.newest - flown.t[-1] > _STALE_S):
        return []
    made, t0 = _best(twin, flown, ahead)
    n = _whole(made.path)
    if made.path is None or not n:
        return []
    speed = float(np.linalg.norm(flown.v[-1]))
    guess = Made(
        t0,
        made.method,
        _group(twin, made, flown),
        ahead[:n],
        made.path[:n],
        speed,
        in_force(twin, made.method, ahead[:n]),
    )
    trust = twin.record.trust(guess)
    prediction = _trusted(twin, guess, trust)
    twin.prediction = msgspec.structs.replace(
        prediction,
        seq=made.seq,
        sentence=" ".join(filter(None, (_ago(twin, coast), _with(twin, made), made.sentence))),
        coast_s=coast,
        law=made.law,
        controller=_controller(twin, made, now),
        **_event(twin),
    )
    if not coast:
        twin.record.keep(guess, trust)
    return [twin.prediction]


def _coasts(twin: Twin, flown: Track, now: float) -> float:
    """Return the time since the last valid position [s]; 0 with telemetry. A position loss alone is an event."""
    broken = not twin.lost and twin.history.newest - max(float(flown.t[-1]), twin.back_t) > _STALE_S
    if broken != twin.broken and not twin.lost:
        note(twin, Event.TELEMETRY_BROKEN if broken else Event.TELEMETRY_WHOLE, now)
    twin.broken, twin.predict_t = broken, now
    if twin.lost or twin.broken:
        return max(now - (float(flown.t[-1]) if twin.broken else twin.history.newest), 0.0)
    return 0.0


def _is_over(twin: Twin, coast: float, now: float) -> bool:
    """Return whether coasting, once published, exceeds the confidence horizon of the last prediction."""
    last = twin.prediction
    return coast > AHEAD[-1] or (last is not None and last.coast_s > 0 and now >= last.t + last.horizon_s)


def _close(twin: Twin, coast: float, now: float) -> list[Message]:
    """Publish the end of the horizon once; after that nothing until telemetry returns."""
    if twin.over or twin.prediction is None:
        return []
    twin.over = True
    note(twin, Event.HORIZON_OVER, now, f"{_ago(twin, coast)}")
    twin.state, twin.predict_t = _state(twin, twin.state), now
    twin.prediction = msgspec.structs.replace(
        twin.prediction,
        state=twin.state,
        horizon_s=0.0,
        horizon_open=False,
        coast_s=coast,
        sentence=f"{_ago(twin, coast)}: the confidence horizon is over, the current position is unknown",
        **_event(twin),
    )
    return [twin.prediction]


def _ago(twin: Twin, coast: float) -> str:
    return f"{'link lost' if twin.lost else 'positions stopped'} {coast:.0f} s ago" if coast or twin.lost else ""


def _with(twin: Twin, made: Flight) -> str:
    """Describe the fault effects in the model used; empty if there are none."""
    return f"flown with {twin.extended};" if twin.extended is not None and made.method in _LEARNT else ""


def _event(twin: Twin) -> dict[str, Any]:
    """Return the newest event as fields of a prediction."""
    told = twin.noted
    return {} if told is None else {"event": told.event, "event_t": told.t, "event_said": told.said}


def _controller(twin: Twin, made: Flight, now: float) -> Controller | None:
    """Return the active law and parameters if they changed or the last report is old; None otherwise."""
    control = made.control or Control(made.law)
    if control == twin.control and twin.control_t <= now < twin.control_t + _TELL_S:
        return None
    twin.control, twin.control_t = control, now
    return control.wire()


def _best(twin: Twin, flown: Track, ahead: np.ndarray) -> tuple[Flight, float]:
    """Return the forecast of the identified model, else kinematic, else turn rate; and its start."""
    window = twin.window(LOOK_BACK_S)
    whole = window is not None and bool(window.ok[-1])
    why = twin.verdict.sentence
    if twin.ground.landed and twin.instead is None:
        twin.state = _state(twin, State.VERIFIED if twin.plant else State.WAITING)
        still = np.tile(flown.p[-1], (len(ahead), 1))
        return Flight(still, "imm", _NO_LAW, -1, SENTENCES[Event.TOUCH_DOWN]), float(flown.t[-1])
    if (twin.plant is not None or twin.hybrid is not None) and not hangs(twin):
        first = nothing(twin.why_no_route() or "telemetry has gaps: no initial state for the model")
        if window is not None and whole and not twin.why_no_route():
            first = fly_route(twin, window, ahead)
        if _good(first):
            twin.state = _state(twin, State.PREDICTING)
            return first, float(window.t[-1])  # type: ignore[union-attr]
        why = first.sentence
    second = fly_kind(twin, flown.turned(twin.history), ahead)
    if _good(second):
        twin.state = _state(twin, State.PREDICTING)
        said = second.sentence if hangs(twin) else f"{second.sentence}; {why}"
        return replace(second, sentence=said), float(flown.t[-1])
    twin.state = _state(twin, State.VERIFIED if twin.plant else State.IDENTIFYING if whole else State.WAITING)
    parts = dict.fromkeys(part for part in (why, second.sentence, flown.sentence, "turn rate only") if part)
    path = turn_on(flown, ahead)
    return Flight(path, "imm", _IMM_LAW, second.seq if path is None else -1, "; ".join(parts)), float(flown.t[-1])


def _good(flight: Flight) -> bool:
    return _whole(flight.path) > 0


def _whole(path: np.ndarray | None) -> int:
    """Return the number of look-aheads before the first gap; 0 if the path is too short."""
    if path is None:
        return 0
    broken = np.flatnonzero(~np.isfinite(path).all(axis=1))
    n = int(broken[0]) if len(broken) else len(path)
    return n if AHEAD[n - 1] >= LEAST_AHEAD_S else 0


def _group(twin: Twin, flight: Flight, flown: Track) -> str:
    """Return the calibration group of a forecast."""
    control = flight.control
    known = "known"
    if control is not None and len(control.absent) > _MISSED:
        known = "identified" if IDENTIFIED in control.known.values() else "absent"
    return group_of(flight.method, flight.law, airframe_class(twin.vehicle, _usual(flown.v)), known)


def _usual(v: np.ndarray) -> float:
    """Return the median speed of velocities, (n, 3) [m/s]."""
    ranked = np.sort(np.einsum("ij,ij->i", v, v))
    n = len(ranked)
    return 0.5 * float(np.sqrt(ranked[(n - 1) // 2]) + np.sqrt(ranked[n // 2]))


def _state(twin: Twin, otherwise: State) -> State:
    return State.LINK_LOST if twin.lost else otherwise


def _trusted(twin: Twin, made: Made, trust: Trust) -> Prediction:
    """Build the message of a path with its tube and confidence horizon."""
    held, n = twin.record.held
    coverage, coverage_n = twin.record.coverage_renewed
    begin = float(made.ahead[0])
    assert twin.origin is not None
    return Prediction(
        uav=twin.uav,
        t=made.t + begin,
        state=twin.state,
        method=made.method,
        origin=(twin.origin.lat_e7, twin.origin.lon_e7, twin.origin.alt_mm),
        ahead=Array.of(made.ahead - begin),
        path=Array.of(made.path),
        tube=Array.of(trust.tube),
        quantile=QUANTILE,
        axis_quantile=trust.alone,
        horizon_s=max(trust.horizon_s - begin, 0.0),
        horizon_open=trust.horizon_open,
        held=held,
        held_n=n,
        coverage_renewed=coverage,
        coverage_renewed_n=coverage_n,
        calibration=trust.sentence,
    )
