"""Answer a what-if query with a prediction of a modified copy of the twin; twin and aircraft are not affected."""

from collections.abc import Iterator
from dataclasses import replace
from math import degrees

import msgspec
import numpy as np

from fleet.contract import Item, Mission, Prediction, Status, WhatIf
from fleet.frames import Origin, to_ned
from fleet.mission import FIRST
from twin_worker.prediction.autopilot_parameters import CRUISES
from twin_worker.prediction.kinematic import air_of
from twin_worker.prediction.route_override import Instead
from twin_worker.twin.state.state import ROUTE_MODES, Twin
from twin_worker.twin.state.vehicle_class import NO_WINGS, seen
from twin_worker.twin.steps.predict_step import foresee
from twin_worker.whatif.move_history import Motion, moved

_FAR_M = 50_000.0  # a start farther away than this gets its own local frame [m]
_BACK_S = 6.0  # flight on which the controller is synchronised if the aircraft is on another route [s]
_SPEED = 178  # MAV_CMD: DO_CHANGE_SPEED


def answer(twin: Twin, asked: WhatIf) -> Prediction:
    """Predict under the conditions of a query.

    Args:
        twin: a copy, which is changed
        query: validated by `query.read_query`
    Raises:
        ValueError: when start or route are missing; the message names what is missing.
    """
    if twin.origin is None or not np.isfinite(twin.history.newest):
        raise ValueError(f"what if: {twin.name} has sent no position yet, expected one; wait for its telemetry")
    if asked.seq is not None and asked.items is None:
        _check_seq(twin, asked.seq)
    said = list(_words(twin, asked))
    follows = not twin.why_no_route() and bool(len(twin.history.rows("leg")[0]))
    if asked.start is not None or asked.wind is not None:
        _move(twin, asked)
    if asked.items is not None or asked.seq is not None or asked.start is not None:
        said += _into_auto(twin)
    if asked != WhatIf(wind=asked.wind):
        twin.instead = _instead(twin, asked)
        if not follows or asked.start is not None:
            _as_if_on_it(twin, twin.instead)
    twin.prediction, twin.over = None, False  # the answer begins at the last good state, however old
    twin.control_t = -np.inf  # the answer always contains control law and parameters
    made = [m for m in foresee(twin, twin.history.newest) if isinstance(m, Prediction)]
    if not made:
        raise ValueError(f"what if: {twin.name} has sent too few recent positions, expected 2 s of them; wait")
    return msgspec.structs.replace(made[0], sentence=f"what if {', '.join(said)}: {made[0].sentence}".rstrip(": "))


def _check_seq(twin: Twin, seq: int) -> None:
    have = {item.seq for item in twin.mission.items} if twin.mission else set()
    if seq not in have:
        span = f"one of {min(have)}..{max(have)}" if have else "a mission on board"
        raise ValueError(f"what if: found seq {seq} for {twin.name}, expected {span}; choose one, or give items")


def _words(twin: Twin, asked: WhatIf) -> Iterator[str]:
    """Yield descriptions of what the query changes."""
    if asked.items is not None:
        yield f"it flew a mission of {len(asked.items)} items"
    if asked.seq is not None:
        yield f"it flew to item {asked.seq}"
    if asked.speed is not None:
        yield f"it flew at {asked.speed:g} m/s"
    if asked.start is not None:
        place = f"{asked.start.lat_e7 * 1e-7:.5f}, {asked.start.lon_e7 * 1e-7:.5f} at {asked.start.alt_mm * 1e-3:.0f} m"
        heading = "" if asked.start.heading is None else f" heading {degrees(asked.start.heading) % 360:.0f} deg"
        speed = "" if asked.start.speed is None else f" with {asked.start.speed:g} m/s"
        yield f"it were at {place}{heading}{speed}"
    if asked.wind is not None:
        yield f"the wind blew {asked.wind[0]:g} m/s north and {asked.wind[1]:g} east"
    for name, value in list(asked.params.items())[:5]:
        was = twin.received.get(name)
        yield f"{name[:20]} were {value:g}" + (f" instead of {was:g}" if was is not None else "")
    if len(asked.params) > 5:
        yield f"and {len(asked.params) - 5} more parameters were changed"
    if asked == WhatIf():
        yield "nothing were changed"


def _move(twin: Twin, asked: WhatIf) -> None:
    """Transform the flight so far to the start and wind of the query."""
    assert twin.origin is not None
    told = twin.wind.wind
    if not np.isfinite(twin.wind.t):
        flown = seen(twin)
        told = np.append(air_of(flown, None)[0], 0.0) if flown is not None and flown.ok.any() else np.zeros(3)
    then = told if asked.wind is None else np.array([*asked.wind, 0.0])
    winds = (np.zeros(3), np.zeros(3)) if twin.vehicle in NO_WINGS else (told, then)
    if (start := asked.start) is None:
        moved(twin.history, twin.origin, Motion(None, None, *winds))
    else:
        to = Origin(start.lat_e7, start.lon_e7, start.alt_mm)
        moved(twin.history, twin.origin, Motion(to, start.heading, *winds))
        far = to_ned(twin.origin, *(np.array([x]) for x in to))[0]
        twin.origin = to if float(np.linalg.norm(far)) > _FAR_M else twin.origin
    if asked.wind is not None:
        twin.wind.blow(twin.history.newest, then)
        twin.history.put("wind", np.array([twin.history.newest]), then[None, :2])  # the autopilot's estimate, too
        twin.rotor = replace(twin.rotor, wind=(float(then[0]), float(then[1])))
    twin.grid.clear()


def _into_auto(twin: Twin) -> Iterator[str]:
    """Set the status to armed and a route mode; yield a description if the mode changes."""
    status = twin.status or Status(uav=twin.uav, t=twin.history.newest)
    if status.mode not in ROUTE_MODES:
        yield f"its mode were {ROUTE_MODES[0]}"
        status = msgspec.structs.replace(status, mode=ROUTE_MODES[0])
    twin.status = msgspec.structs.replace(status, armed=True)


def _instead(twin: Twin, asked: WhatIf) -> Instead:
    """Build the route override from route and parameters of the query."""
    on_board = twin.mission.items if twin.mission else ()
    items = on_board if asked.items is None else asked.items
    params = dict(asked.params)
    if asked.speed is not None:
        params = dict.fromkeys(CRUISES, asked.speed) | params
        items = tuple(_at_speed(item, asked.speed) for item in items)
    seq = asked.seq
    if seq is None:
        seq = _first(items, twin) if asked.items is not None else _in_force(twin)
    anew = (asked.seq is not None and asked.seq != _in_force(twin)) or asked.start is not None
    return Instead(items, seq, params, anew, asked.start.speed if asked.start else None, twin.first_item)


def _at_speed(item: Item, speed: float) -> Item:
    return msgspec.structs.replace(item, param2=speed) if item.command == _SPEED else item


def _first(items: tuple[Item, ...], twin: Twin) -> int:
    """Return the sequence number of the first item to fly."""
    first = twin.first_item
    return min((item.seq for item in items if item.seq >= first), default=first)


def _in_force(twin: Twin) -> int:
    _, leg = twin.history.rows("leg")
    told = int(leg[-1, 0]) if len(leg) else twin.mission.seq if twin.mission else -1
    return told if told >= 0 else FIRST.get(twin.autopilot, 1)


def _as_if_on_it(twin: Twin, instead: Instead) -> None:
    """Record the last seconds as flown on the queried route, if the aircraft was on none or on another."""
    now = twin.history.newest
    twin.since = now - _BACK_S
    twin.mission = Mission(uav=twin.uav, t=now, items=instead.items, seq=instead.seq, complete=True)
    t = np.arange(now - 2 * _BACK_S, now + 0.5, 1.0)
    twin.history.put("leg", t, np.full((len(t), 1), float(instead.seq)))
