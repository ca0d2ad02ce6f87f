"""Telemetry on the present route, prepared for the replay of a control law."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import radians

import numpy as np

from fleet.autopilots.modes import NO_ITEM, ModeEntry
from fleet.contract import Item
from fleet.frames import Origin, wrap
from fleet.mission import FIRST_ITEM, Route
from fleet.process.sanitise import format_below
from fleet.window import Window
from twin_worker.estimation.wind_field import SharedWind
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.numerics.interpolation import zero_order_hold
from twin_worker.prediction.autopilot_parameters import ControllerTwin, RouteOverride
from twin_worker.prediction.failsafe_route import FailsafePlan
from twin_worker.prediction.route_cache import cached_route
from twin_worker.telemetry.history import TelemetryHistory

MAX_BANK_ERROR = radians(6.0)  # largest error to the commanded banks of an accepted law [rad]
_MIN_COMPARED_S = 10.0  # shortest flight in which banks are compared [s]
SHADOW_S = 60.0  # telemetry for the synchronisation of the controller twin [s]
MIN_FLIGHT_S = 5.0  # shortest telemetry without gaps before a rollout [s]
MAX_EARLY_S = 1.0  # a route that changed at most this long after the newest telemetry is flown from there [s]
_AIRSPEED_MAX_AGE_S = 1.5  # reports of 1 Hz, with jitter [s]
_MIN_AIRSPEED = 3.0  # a lower reading in flight is no airspeed [m/s]
_ITEM_REPORT_S = 2.0  # longest period of reports of the current mission item [s]
_ITEM_DELAY_S = 2.0  # between the mission and the telemetry that report the same item, at most [s]
_SHADOW_STEP = 2  # window rows per shadow step
ControllerMemory = tuple[str, tuple[float, ...]]
"""Law, and state of its controller as from `laws.remember`; empty: unknown."""
JumpCounts = tuple[float, int, dict[int, int]]
"""Time [s since 1970], the item that became current, and the jumps taken until then at each jump."""


@dataclass(frozen=True)
class Rollout:
    """Simulated flight ahead, or the reason why there is none.

    Attributes:
        path: position at each requested look-ahead time, NED, (k, 3) [m]; None without a prediction
        seq: mission item at the start
        sentence: limitations or reason, or empty
        diverged: the twin left its flight envelope
        controller: the controller twin
    """

    path: np.ndarray | None
    seq: int
    sentence: str
    diverged: bool = False
    controller: ControllerTwin | None = None


@dataclass(frozen=True)
class AutopilotConfig:
    """Route and parameters of the autopilot."""

    items: tuple[Item, ...]
    params: Mapping[str, float]  # received
    changed_t: float  # when route, mode and parameters last changed [s since 1970]
    identified: Mapping[str, float] = field(default_factory=dict)  # from flight; used if not received
    override: RouteOverride | None = None  # what-if query, from the start on
    autopilot: str = "ardupilot"  # reported type
    law: str = "arduplane"  # name in `laws.LAWS`; empty: unknown
    law_reason: str = ""  # how the law was selected, or why none is
    entry: ModeEntry | None = None  # where the mode was entered; None: before the first status
    mode_route: Route | None = None  # of a mode without mission, which replaces the items
    failsafe: FailsafePlan | None = None  # after a link loss
    memory: ControllerMemory = ("", ())  # before the change at `changed_t`
    jumps: tuple[JumpCounts, ...] = ()  # jumps taken after each change of the current item, oldest first

    def jumps_taken(self, t: float, seq: int) -> dict[int, int]:
        """Return the jumps taken at each jump when item `seq` was current at `t` [s since 1970]."""
        known = [record for record in self.jumps if record[0] <= t + _ITEM_DELAY_S]
        return next((counts for _, item, counts in reversed(known) if item == seq), known[-1][2] if known else {})


@dataclass(frozen=True)
class ReplayWindow:
    """Telemetry on the present route for the replay of a control law.

    Attributes:
        window: telemetry without gaps
        flight: the same, with the flight before the present route
        legs, start_point: route from the first current item, and the point before
        rows: t p v euler rates Va phi_c theta_c delta, as for `shadow`
        seq: current mission item of each row
        altitude_m: final height above mean sea level [m]
        sentence: problems of the route, or empty
    """

    window: Window
    flight: Window
    legs: np.ndarray
    start_point: np.ndarray
    rows: tuple[np.ndarray, ...]
    seq: np.ndarray
    altitude_m: float
    sentence: str

    @property
    def t(self) -> np.ndarray:
        """Return times since the first row, (n,) [s]."""
        return self.rows[0]

    @property
    def p(self) -> np.ndarray:
        """Return positions, NED, (n, 3) [m]."""
        return self.rows[1]

    @property
    def Va(self) -> np.ndarray:
        """Return reported airspeeds, (n,) [m/s]."""
        return self.rows[5]

    @property
    def phi_c(self) -> np.ndarray:
        """Return the commanded banks, (n,) [rad]."""
        return self.rows[6]


@dataclass(frozen=True)
class PredictionContext:
    """Inputs of a prediction.

    Attributes:
        window: newest resampled telemetry, at least `SHADOW_S` if available
        history: telemetry as received
        onboard: active route and parameters
        wind_filter: current wind filter
        origin: origin of the twin's NED frame
        uav: id of the aircraft
        shared_wind: wind field of all aircraft; None: not known
    """

    window: Window
    history: TelemetryHistory
    onboard: AutopilotConfig
    wind_filter: WindFilter
    origin: Origin
    uav: int = -1
    shared_wind: SharedWind | None = None


def reported(history: TelemetryHistory, name: str, query_t: np.ndarray, max_age: float) -> np.ndarray:
    """Return the last reported row at each time, nan after `max_age` seconds, (len(query_t), k)."""
    return zero_order_hold(*history.rows_since(name, query_t[0] - max_age - 1.0), query_t, max_age)


def replay_inputs(context: PredictionContext) -> ReplayWindow | Rollout:
    """Return the replay data of the present route, or the reason why there are none."""
    onboard, flight = context.onboard, _gap_free(context.window)
    if flight.seconds < MIN_FLIGHT_S:
        reason = f"{format_below(flight.seconds, MIN_FLIGHT_S)} s without gaps, {MIN_FLIGHT_S:.0f} s are needed; wait"
        return Rollout(None, -1, reason)
    if flight.t[-1] < onboard.changed_t - MAX_EARLY_S:
        return Rollout(None, -1, "the route changed after this telemetry")
    first_row = min(int(np.searchsorted(flight.t, onboard.changed_t)), len(flight) - 2)
    window = flight.part(first_row, len(flight))
    stride = slice((len(window) - 1) % _SHADOW_STEP, None, _SHADOW_STEP)
    times = window.t[stride]
    if onboard.mode_route is None:
        seq = reported(context.history, "leg", times, 15.0)[:, 0]
        if not np.isfinite(seq[-1]):
            return Rollout(None, -1, "the current mission item is not reported (MISSION_CURRENT)")
        seq = np.where(np.isfinite(seq), seq, seq[np.isfinite(seq)][0])
        seq = items_since_entry(seq, times, onboard.entry, context.history).astype(np.int64)
        first = FIRST_ITEM.get(onboard.autopilot, 1)
        jumps = onboard.jumps_taken(float(times[0]), int(seq[0]))
        route = cached_route(onboard.items, int(seq[0]), context.origin, onboard.params, first, jumps=jumps)
    else:
        seq, route = np.full(len(times), int(NO_ITEM)), onboard.mode_route
    if not len(route.legs):
        return Rollout(None, int(seq[-1]), route.summary or "the mission has no legs to fly")
    altitude = context.origin.alt_mm * 1e-3 - float(window.p[-1, 2])
    rows = _replay_rows(window, stride, context.history)
    at = int(seq[0]), float(window.t[0]), window.p[0]
    start_point = (
        route.start if onboard.mode_route is not None else leg_start(route, onboard.entry, context.history, at)
    )
    return ReplayWindow(window, flight, route.legs, start_point, rows, seq, altitude, route.summary)


def route_error(mode_route: Route | None, rms: float, banks: np.ndarray, seconds: float) -> str:
    """Describe why the flight does not follow the assumed route of a mode; empty if it does, and in a mission.

    The banks that the law demands on the route must be nearer to the flight than straight flight is.

    Args:
        mode_route: route of the mode
        rms: of demanded minus commanded or flown banks; nan: unknown [rad]
        banks: commanded or flown banks, (n,) [rad]
        seconds: flight on the route [s]
    """
    finite = banks[np.isfinite(banks)]
    if mode_route is None or seconds < _MIN_COMPARED_S or not len(finite):
        return ""
    if not rms > max(MAX_BANK_ERROR, float(np.sqrt(np.mean(finite**2)))):
        return ""
    return f"the flight does not follow the route of its mode: bank error {np.degrees(rms):.0f} deg"


def items_since_entry(
    seq: np.ndarray, t: np.ndarray, entry: ModeEntry | None, history: TelemetryHistory | None
) -> np.ndarray:
    """Return the items at times `t`, with the first one reported after a mode change from that change on, (n,).

    A mode change may jump to another item, which is reported up to a second later.
    """
    if entry is None or history is None or not len(t) or t[-1] < entry.t or t[0] > entry.t + _ITEM_REPORT_S:
        return seq
    t_leg, items = history.rows_since("leg", entry.t)
    if not len(t_leg) or t_leg[0] > entry.t + _ITEM_REPORT_S:
        return seq
    return np.where((t >= entry.t) & (t < t_leg[0]), items[0, 0], seq)


def leg_start(
    route: Route, entry: ModeEntry | None, history: TelemetryHistory | None, at: tuple[int, float, np.ndarray]
) -> np.ndarray:
    """Return the point where the line of the first leg of a mission starts, NED, (3,) [m]; inf: there is no line.

    After a mode change no line is followed until the first item is complete.

    Args:
        route: from the current item on
        entry: of the present mode
        history: reported items
        at: item, time and position at the start
    """
    seq, t, p = at
    if entry is not None and history is not None and _is_first_item(history, entry.t, t, seq):
        return np.full(3, np.inf)
    return route.start if np.isfinite(route.start).all() else p


def _is_first_item(history: TelemetryHistory, entry_t: float, until: float, seq: int) -> bool:
    """Return whether `seq` has been the current item from a mode change on until a time [s since 1970]."""
    t, items = history.rows_since("leg", entry_t - _ITEM_REPORT_S)
    if not len(t) or t[0] > entry_t + _ITEM_REPORT_S:  # not known any more
        return False
    return bool((items[(t > entry_t) & (t <= until), 0] == seq).all())


def _gap_free(window: Window) -> Window:
    """Return the gap-free flight up to the end, at most `SHADOW_S`."""
    start = max(0, len(window) - int(SHADOW_S / window.dt))
    invalid_rows = np.flatnonzero(~window.ok)
    start = max(start, int(invalid_rows[-1]) + 1 if len(invalid_rows) else 0)
    return window.part(min(start, len(window) - 2), len(window))


def _replay_rows(window: Window, stride: slice, history: TelemetryHistory) -> tuple[np.ndarray, ...]:
    """Return the synchronisation data at some rows: t p v euler rates Va phi_c theta_c delta."""
    times = window.t[stride]
    command, Va = reported(history, "command", times, 1.0), reported(history, "air", times, _AIRSPEED_MAX_AGE_S)[:, 0]
    Va = np.where(Va < _MIN_AIRSPEED, np.nan, Va)
    euler, rates = window.x[stride, 6:9].copy(), window.x[stride, 3:6]
    euler[:, 2] = wrap(euler[:, 2])
    rows = (
        times - times[0],
        window.p[stride],
        window.v[stride],
        euler,
        rates,
        Va,
        command[:, 0],
        command[:, 1],
        window.u[stride],
    )
    return tuple(np.ascontiguousarray(row) for row in rows)
