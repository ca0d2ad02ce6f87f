"""What-if queries: parse a query, modify a copy of the twin, predict; twin and aircraft are not affected."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from math import degrees, isfinite, pi

import msgspec
import numpy as np
from scipy.interpolate import CubicSpline

from fleet.contract import MAX_ITEMS, Array, Mission, Prediction, Status, WhatIf, WhatIfStart
from fleet.frames import Origin, to_geodetic, to_ned, wrap
from fleet.mission import FIRST_ITEM
from twin_worker.confidence.tube_and_horizon import AHEAD
from twin_worker.prediction.autopilot_parameters import SPEED_PARAMETERS, RouteOverride, range_error
from twin_worker.prediction.kinematic import wind_and_airspeed
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.twin.state.routes import ROUTE_MODES
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.kinematic_prediction import recent_track
from twin_worker.twin.steps.predict_step import predict


def move_history(
    history: TelemetryHistory,
    origin: Origin,
    *,
    start: Origin | None = None,
    heading: float | None = None,
    wind: np.ndarray,
    new_wind: np.ndarray,
) -> None:
    """Move the telemetry history as a rigid body, in place.

    Args:
        history: the flight so far
        origin: of the local frame
        start: new end position of the flight so far; None: unchanged
        heading: new heading of the nose [rad]; None: unchanged
        wind, new_wind: actual and hypothetical wind, NED, (3,) [m/s]
    """
    t_p, geodetic = history.rows("position")
    t_v, v = history.rows("velocity")
    t_a, attitude = history.rows("attitude")
    if not len(t_p):
        return
    rotation = 0.0 if heading is None else heading - _heading(attitude, v - wind)
    c, s = np.cos(rotation), np.sin(rotation)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    p, relative_t = to_ned(origin, *geodetic.T), (t_p - t_p[-1])[:, None]
    path = (p - p[-1] - wind * relative_t) @ R.T + new_wind * relative_t  # from the last position
    moved_positions = to_geodetic(origin, p[-1] + path) if start is None else to_geodetic(start, path)
    history.replace_rows("position", t_p, moved_positions.astype(float))
    history.replace_rows("velocity", t_v, (v - wind) @ R.T + new_wind)
    if len(t_a):
        attitude[:, 2] = wrap(attitude[:, 2] + rotation)
        history.replace_rows("attitude", t_a, attitude)


def _heading(attitude: np.ndarray, air_velocity: np.ndarray) -> float:
    """Return the heading: as received, else the direction of the air-relative velocity [rad]."""
    if len(attitude):
        return float(attitude[-1, 2])
    return float(np.arctan2(air_velocity[-1, 1], air_velocity[-1, 0])) if len(air_velocity) else 0.0


_NEW_FRAME_M = 50_000.0  # a start farther away than this gets its own local frame [m]
_REPLAY_S = 6.0  # flight on which the controller is synchronised if the aircraft is on another route [s]
_CHANGE_SPEED = 178  # MAV_CMD: DO_CHANGE_SPEED


def answer_query(twin: Twin, query: WhatIf) -> Prediction:
    """Predict under the conditions of a query.

    Args:
        twin: a copy, which is changed
        query: validated by `query.read_query`
    Raises:
        ValueError: when start or route are missing; the message names what is missing.
    """
    if twin.telemetry.origin is None or not np.isfinite(twin.telemetry.history.newest):
        raise ValueError(f"what if: {twin.name} has sent no position yet, expected one; wait for its telemetry")
    if query.seq is not None and query.items is None:
        _check_seq(twin, query.seq)
    changes = list(_describe_changes(twin, query))
    on_route = not twin.no_mission_reason() and bool(len(twin.telemetry.history.rows("leg")[0]))
    if query.start is not None or query.wind is not None:
        _move_flight(twin, query)
    if query.items is not None or query.seq is not None or query.start is not None:
        changes += _engage_route_mode(twin)
    if query != WhatIf(wind=query.wind):
        override = _override(twin, query)
        twin.prediction.set_override(override)
        if not on_route or query.start is not None:
            _fill_leg_history(twin, override)
    twin.prediction.forget_published()  # the answer begins at the last good state, and contains the control law
    predictions = [
        message for message in predict(twin, twin.telemetry.history.newest) if isinstance(message, Prediction)
    ]
    if not predictions:
        raise ValueError(f"what if: {twin.name} has sent too few recent positions, expected 2 s of them; wait")
    return msgspec.structs.replace(
        predictions[0], sentence=f"what if {', '.join(changes)}: {predictions[0].sentence}".rstrip(": ")
    )


def _check_seq(twin: Twin, seq: int) -> None:
    available = {item.seq for item in twin.onboard.mission.items} if twin.onboard.mission else set()
    if seq not in available:
        expected = f"one of {min(available)}..{max(available)}" if available else "a mission on board"
        raise ValueError(f"what if: found seq {seq} for {twin.name}, expected {expected}; choose one, or give items")


def _describe_changes(twin: Twin, query: WhatIf) -> Iterator[str]:
    """Yield descriptions of what the query changes."""
    if query.items is not None:
        yield f"it flew a mission of {len(query.items)} items"
    if query.seq is not None:
        yield f"it flew to item {query.seq}"
    if query.speed is not None:
        yield f"it flew at {query.speed:g} m/s"
    if query.start is not None:
        position = (
            f"{query.start.lat_e7 * 1e-7:.5f}, {query.start.lon_e7 * 1e-7:.5f} at {query.start.alt_mm * 1e-3:.0f} m"
        )
        heading = "" if query.start.heading is None else f" heading {degrees(query.start.heading) % 360:.0f} deg"
        speed = "" if query.start.speed is None else f" with {query.start.speed:g} m/s"
        yield f"it were at {position}{heading}{speed}"
    if query.wind is not None:
        yield f"the wind blew {query.wind[0]:g} m/s north and {query.wind[1]:g} east"
    for name, value in list(query.params.items())[:5]:
        current = twin.received_params.get(name)
        yield f"{name[:20]} were {value:g}" + (f" instead of {current:g}" if current is not None else "")
    if len(query.params) > 5:
        yield f"and {len(query.params) - 5} more parameters were changed"
    if query == WhatIf():
        yield "nothing were changed"


def _move_flight(twin: Twin, query: WhatIf) -> None:
    """Transform the flight so far to the start and wind of the query."""
    assert twin.telemetry.origin is not None
    wind_before = twin.environment.wind.wind
    if not np.isfinite(twin.environment.wind.t):
        track = recent_track(twin)
        wind_before = (
            np.append(wind_and_airspeed(track, None)[0], 0.0) if track is not None and track.ok.any() else np.zeros(3)
        )
    wind_after = wind_before if query.wind is None else np.array([*query.wind, 0.0])
    move = partial(move_history, twin.telemetry.history, twin.telemetry.origin, wind=wind_before, new_wind=wind_after)
    if twin.vehicle_class.is_rotorcraft:
        move = partial(move, wind=np.zeros(3), new_wind=np.zeros(3))
    if (start := query.start) is None:
        move()
    else:
        to = Origin(start.lat_e7, start.lon_e7, start.alt_mm)
        move(start=to, heading=start.heading)
        offset = to_ned(twin.telemetry.origin, *(np.array([x]) for x in to))[0]
        if float(np.linalg.norm(offset)) > _NEW_FRAME_M:
            twin.telemetry.set_origin(to)
    if query.wind is not None:
        twin.environment.set_wind_field(None)
        twin.environment.wind.reset_wind(twin.telemetry.history.newest, wind_after)
        newest = np.array([twin.telemetry.history.newest])
        twin.telemetry.history.replace_rows("wind", newest, wind_after[None, :2])  # the autopilot's estimate, too
        wind = float(wind_after[0]), float(wind_after[1])
        twin.models.store_multirotor(replace(twin.models.multirotor, wind=wind))
    twin.telemetry.resampler.clear()


def _engage_route_mode(twin: Twin) -> Iterator[str]:
    """Set the status to armed and a route mode; yield a description if the mode changes."""
    status = twin.onboard.status or Status(uav=twin.config.uav, t=twin.telemetry.history.newest)
    if status.mode not in ROUTE_MODES:
        yield f"its mode were {ROUTE_MODES[0]}"
        status = msgspec.structs.replace(status, mode=ROUTE_MODES[0])
    twin.onboard.set_status(msgspec.structs.replace(status, armed=True), record=False)


def _override(twin: Twin, query: WhatIf) -> RouteOverride:
    """Build the route override from route and parameters of the query."""
    mission_items = twin.onboard.mission.items if twin.onboard.mission else ()
    items = mission_items if query.items is None else query.items
    params = dict(query.params)
    if query.speed is not None:
        params = dict.fromkeys(SPEED_PARAMETERS, query.speed) | params
        items = tuple(
            msgspec.structs.replace(item, param2=query.speed) if item.command == _CHANGE_SPEED else item
            for item in items
        )
    if query.seq is not None:
        seq = query.seq
    elif query.items is None:
        seq = active_seq(twin)
    else:
        seq = min((item.seq for item in items if item.seq >= twin.first_item), default=twin.first_item)
    restart = (query.seq is not None and query.seq != active_seq(twin)) or query.start is not None
    speed, jumps = query.start.speed if query.start else None, twin.onboard.jumps_taken if query.items is None else {}
    return RouteOverride(items, seq, params, restart, speed, twin.first_item, jumps)


def active_seq(twin: Twin) -> int:
    """Return the current mission item: reported, else of the mission, else the first."""
    _, leg = twin.telemetry.history.rows("leg")
    seq = int(leg[-1, 0]) if len(leg) else twin.onboard.mission.seq if twin.onboard.mission else -1
    return seq if seq >= 0 else FIRST_ITEM.get(twin.autopilot, 1)


def _fill_leg_history(twin: Twin, override: RouteOverride) -> None:
    """Record the last seconds as flown on the queried route, if the aircraft was on none or on another."""
    now = twin.telemetry.history.newest
    twin.onboard.plan_changed(now - _REPLAY_S)
    items = override.items
    known = twin.onboard.mission or Mission(uav=twin.config.uav, t=now)
    mission = msgspec.structs.replace(known, t=now, items=items, seq=override.seq, complete=True)
    twin.onboard.set_mission(mission, twin.first_item)
    t = np.arange(now - 2 * _REPLAY_S, now + 0.5, 1.0)
    twin.telemetry.history.replace_rows("leg", t, np.full((len(t), 1), float(override.seq)))


def read_grid(settings: dict[str, str]) -> np.ndarray | None:
    """Read `?horizon=30;step=0.5` into look-ahead times [s]; None without either.

    Raises:
        ValueError: when they are not numbers or would give more than 1,000 points.
    """
    if not settings.keys() & {"horizon", "step"}:
        return None
    try:
        horizon, step = float(settings.get("horizon", AHEAD[-1])), float(settings.get("step", 1.0))
    except ValueError:
        raise ValueError(
            f"query: found {settings}, expected numbers, e.g. ?horizon=30;step=0.5; correct them"
        ) from None
    if not (0 < horizon <= AHEAD[-1] and 0 < step <= 60 and horizon / step <= 1000):
        raise ValueError(
            f"query: found horizon {horizon}, step {step}, expected at most {AHEAD[-1]:.0f} s and 1,000 points; "
            "correct them"
        )
    return np.arange(0.0, horizon + 1e-9, step)


def resample(prediction: Prediction, grid: np.ndarray | None) -> Prediction:
    """Return the prediction on other look-ahead times, (n,) [s], up to its end; unchanged for None."""
    if grid is None:
        return prediction
    ahead = prediction.ahead.numpy().astype(float)
    grid = grid[grid <= ahead[-1] + 1e-6]
    path = CubicSpline(ahead, prediction.path.numpy())(grid)  # linear over 4 s of a turn has errors of metres
    tube = np.column_stack(
        [np.interp(grid, ahead, column) for column in prediction.prediction_region_half_axes.numpy().T]
    )
    return msgspec.structs.replace(
        prediction, ahead=Array.of(grid), path=Array.of(path), prediction_region_half_axes=Array.of(tube)
    )


MAX_BYTES = 1 << 18  # of a payload
_MAX_PARAMS = 2_000
_MAX_SPEED, _MAX_WIND = 300.0, 100.0  # [m/s]
_MIN_ALTITUDE, _MAX_ALTITUDE = -500_000, 100_000_000  # [mm above mean sea level]
_DECODER = msgspec.msgpack.Decoder(WhatIf)


def read_query(payload: bytes) -> WhatIf:
    """Decode and validate one query.

    Raises:
        ValueError: when it violates the contract or a limit; the message names the correction.
    """
    if len(payload) > MAX_BYTES:
        raise ValueError(f"what if: found {len(payload):,} bytes, expected at most {MAX_BYTES:,}; shorten the mission")
    try:
        query = _DECODER.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        reason = str(error) if isinstance(error, msgspec.ValidationError) else "no msgpack map"
        raise ValueError(f"what if: found an invalid payload ({reason}), expected {_EXPECTED}") from None
    for error_text in _find_errors(query):
        raise ValueError(f"what if: {error_text}")
    return query


_EXPECTED = f"a map of {', '.join(WhatIf.__struct_fields__)}; see `fleet schema prediction`"


def _find_errors(query: WhatIf) -> Iterator[str]:
    """Yield the errors of a query; nan fails every comparison."""
    items = query.items or ()
    if len(items) > MAX_ITEMS:
        yield f"found {len(items):,} mission items, expected at most {MAX_ITEMS:,}; shorten the mission"
    seqs = {item.seq for item in items}
    if len(seqs) < len(items) or any(not 0 <= seq < MAX_ITEMS for seq in seqs):
        yield f"items: found numbers {min(seqs)}..{max(seqs)}, expected each of 0..{MAX_ITEMS - 1} once; renumber them"
    if query.seq is not None and query.items is not None and query.seq not in seqs:
        yield f"seq: found {query.seq}, expected the number of one of the {len(items)} items; choose one of them"
    if query.speed is not None and not 0 < query.speed <= _MAX_SPEED:
        yield f"speed: found {query.speed} m/s, expected above 0 to {_MAX_SPEED:.0f}; correct it"
    if query.wind is not None and not all(abs(w) <= _MAX_WIND for w in query.wind):
        yield f"wind: found {query.wind} m/s, expected north and east within {_MAX_WIND:.0f}; correct it"
    if query.start is not None:
        yield from _find_start_errors(query.start)
    yield from _find_param_errors(query.params)


def _find_start_errors(start: WhatIfStart) -> Iterator[str]:
    if abs(start.lat_e7) > 890_000_000 or abs(start.lon_e7) > 1_800_000_000:
        yield f"start: found {start.lat_e7}, {start.lon_e7} (1e-7 deg), expected within 89 and 180 deg; correct it"
    if not _MIN_ALTITUDE <= start.alt_mm <= _MAX_ALTITUDE:
        yield f"start: found an altitude of {start.alt_mm} mm, expected {_MIN_ALTITUDE} to {_MAX_ALTITUDE}; correct it"
    if start.heading is not None and not abs(start.heading) <= 2 * pi:
        yield f"start: found heading {start.heading} rad, expected within 2 pi; give radians"
    if start.speed is not None and not 0 <= start.speed <= _MAX_SPEED:
        yield f"start: found speed {start.speed} m/s, expected 0 to {_MAX_SPEED:.0f}; correct it"


def _find_param_errors(params: dict[str, float]) -> Iterator[str]:
    if len(params) > _MAX_PARAMS:
        yield f"params: found {len(params):,}, expected at most {_MAX_PARAMS:,}; name only those to change"
    for name, value in params.items():
        if not isfinite(value):
            yield f"params: found {name[:40]} {value}, expected a finite number; correct it"
        if reason := range_error(name, value):
            yield f"params {reason}; correct it"
