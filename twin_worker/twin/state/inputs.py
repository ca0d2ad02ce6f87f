"""Received state of one aircraft: telemetry, what the autopilot reports, and what is estimated of the environment."""

from collections import deque
from typing import NamedTuple

import msgspec
import numpy as np

from fleet.airframes.airframe import ASSUMED, ServoMap, servo_map
from fleet.airframes.servo_learning import MIN_ROWS, learn_servo_map
from fleet.autopilots.modes import ModeEntry
from fleet.contract import BatteryForecast, Item, Mission, Params, Sample, Status, WindField
from fleet.frames import Origin
from fleet.mission_jumps import JUMPS, count_jumps, next_repeated_jump, repetitions, resets_counters
from twin_worker.estimation.battery import BatteryModel
from twin_worker.estimation.wind_filter import WindFilter, update_from_history
from twin_worker.prediction.autopilot_identification import AutopilotEstimate
from twin_worker.prediction.replay_window import ControllerMemory, JumpCounts
from twin_worker.telemetry.history import ArrivalDelay, TelemetryHistory
from twin_worker.telemetry.resample import Resampler
from twin_worker.twin.state.budget import Timer
from twin_worker.twin.state.flight_phase import FlightPhase

_MODE_CHANGES = 64  # stored changes of the mode
_ITEM_CHANGES = 64  # stored changes of the current item
_MAX_ALTITUDE_OFFSET_M = 200.0  # largest plausible difference of a position's and the receiver's altitude [m]
_FIX_WAIT_S = 10.0  # telemetry after which a position is used in spite of such a difference [s]
_TICK_S = 1.0  # between updates of the wind filter [s]
_LEARN_FROM = ("servo", "attitude", "command", "air", "velocity")
_LEARN_S, _LEARN_PERIOD_S = 160.0, 20.0  # flight time that the servo map is learnt from, and between two attempts [s]
_FLYING_AIRSPEED = 8.0  # or ground speed [m/s]
_WIND_MAX_AGE_S = 10.0  # maximum age of the autopilot's wind estimate, and of the airspeed that replaces it [s]
_MIN_VELOCITIES = 2  # for the velocity at a row of the battery
_LATE_S = 10.0  # velocities older than this come too late for the wind [s]


class Telemetry(msgspec.Struct):
    """Telemetry rows, the local frame, and the times of the loop.

    Attributes:
        history: rows of the last minutes
        resampler: the same, equally spaced
        origin: of the local frame; None before the first position
        servo_map: servo outputs to control inputs
        delay: of telemetry behind the gateway's clock
        data_t: newest time in any message, on the time axis of telemetry [s since 1970]
        last_step_t: data time of the last step of the loop [s since 1970]
        link_lost: no telemetry arrives
        link_restored_t: when it last arrived again [s since 1970]
        rejected_rows: rows left out, because they were implausible
        servos_learned_t: when the servo map was learnt from flight; -inf: it was not [s since 1970]
        servos_tried_t: when that was last tried [s since 1970]
        frozen_airspeed: reading that the airspeed sensor repeats, treated as no airspeed; nan: it varies [m/s]
        airspeed_checked_t: when the airspeed was last checked for that [s since 1970]
    """

    history: TelemetryHistory = msgspec.field(default_factory=TelemetryHistory)
    resampler: Resampler = msgspec.field(default_factory=Resampler)
    origin: Origin | None = None
    servo_map: ServoMap = msgspec.field(default_factory=lambda: servo_map({}))
    delay: ArrivalDelay = msgspec.field(default_factory=ArrivalDelay)
    data_t: float = -np.inf
    last_step_t: float = -np.inf
    link_lost: bool = False
    link_restored_t: float = -np.inf
    rejected_rows: int = 0
    servos_learned_t: float = -np.inf
    servos_tried_t: float = -np.inf
    frozen_airspeed: float = np.nan
    airspeed_checked_t: float = -np.inf

    def add(self, sample: Sample) -> None:
        """Append the rows of a sample; the first position of a valid fix is the origin."""
        self.rejected_rows += self.history.add(sample)
        if self.origin is None and sample.position is not None:
            self.origin = _first_position(self.history)
        due = self.history.newest - self.airspeed_checked_t >= _TICK_S
        if sample.air is not None and (due or np.isfinite(self.frozen_airspeed)):
            self.airspeed_checked_t = self.history.newest
            self.frozen_airspeed = self.history.blank_frozen("air", self.frozen_airspeed)

    def advance(self, t: float, *, back: bool = False) -> None:
        """Advance data time to `t` [s since 1970]; only with `back` it may decrease."""
        self.data_t = t if back else max(self.data_t, t)

    def step(self, now: float) -> None:
        """Record a step of the loop at `now`."""
        self.last_step_t = now

    def set_link(self, lost: bool, now: float) -> None:
        """Record that the link was lost or restored at `now`."""
        self.link_lost = lost
        self.link_restored_t = self.link_restored_t if lost else now

    def set_origin(self, origin: Origin) -> None:
        """Move the local frame."""
        self.origin = origin

    def set_servo_map(self, values: dict[str, float]) -> None:
        """Derive the servo map from autopilot parameters; one learnt from flight stays where they contain none."""
        from_params = servo_map(values)
        if not (from_params.sentence.startswith(ASSUMED) and np.isfinite(self.servos_learned_t)):
            self.servo_map, self.servos_learned_t = from_params, -np.inf

    def learn_servo_map(self) -> None:
        """Learn the servo map from the last minutes of flight, where no parameter tells it; at most every 20 s."""
        newest = self.history.newest
        if not self.servo_map.sentence.startswith(ASSUMED) or newest - self.servos_tried_t < _LEARN_PERIOD_S:
            return
        self.servos_tried_t = newest
        series = {name: self.history.rows_since(name, newest - _LEARN_S) for name in _LEARN_FROM}
        t, pulses = series["servo"]
        if min(len(rows) for rows, _ in series.values()) < MIN_ROWS:
            return
        attitude, command, air, velocity = (_at(t, *series[name]) for name in _LEARN_FROM[1:])
        flying = np.fmax(air[:, 0], np.hypot(velocity[:, 0], velocity[:, 1])) > _FLYING_AIRSPEED
        learned = learn_servo_map(
            pulses[flying], (command[:, :2] - attitude[:, :2])[flying], attitude[flying, 3:5], air[flying, 1]
        )
        if learned is not None:
            self.servo_map, self.servos_learned_t = learned, newest

    def reset_clock(self) -> None:
        """Forget all rows: the new time may be earlier than the old one."""
        self.history.clear()
        self.resampler.clear()
        self.data_t = self.last_step_t = self.link_restored_t = self.servos_tried_t = -np.inf
        self.airspeed_checked_t, self.frozen_airspeed = -np.inf, np.nan
        self.delay = ArrivalDelay(self.delay.gateway_t)

    def shift_clock(self, step: float) -> None:
        """Date all rows `step` later [s]: the gateway re-anchored the aircraft's clock."""
        newest = self.history.newest
        arrived = self.delay.gateway_t - newest < 0.5 * step  # the first sample with new times came before the status
        self.history.shift_times(newest - 0.5 * step if arrived else np.inf, step)
        self.resampler.clear()
        self.link_restored_t += step


def _at(t: np.ndarray, source_t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate rows to times `t`, nan outside, (n, k)."""
    inside = (t >= source_t[0]) & (t <= source_t[-1])
    return np.where(inside[:, None], np.column_stack([np.interp(t, source_t, c) for c in values.T]), np.nan)


def _first_position(history: TelemetryHistory) -> Origin | None:
    """Return the first position on earth; None before any.

    Between its fix and its alignment an autopilot reports latitude and longitude with an altitude near zero: such a
    position is left out while the receiver's altitude differs from it.
    """
    t, positions = history.rows("position")
    _, gnss = history.rows("gnss")
    for t_k, (lat, lon, alt) in zip(t, positions, strict=True):
        on_earth = abs(lat) <= 9e8 and abs(lon) <= 1.8e9 and abs(alt) <= 1e8 and (lat != 0 or lon != 0)
        aligned = not len(gnss) or abs(alt - gnss[-1, 0]) * 1e-3 <= _MAX_ALTITUDE_OFFSET_M
        if on_earth and (aligned or t_k - t[0] > _FIX_WAIT_S):
            return Origin(int(lat), int(lon), int(alt))
    return None


def _perhaps_taken(mission: Mission, first: int) -> frozenset[int]:
    """Return the jumps that may have been taken before, unless the mission is at its first item."""
    begun = mission.seq > min((item.seq for item in mission.items if item.seq >= first), default=mission.seq)
    return frozenset(item.seq for item in mission.items if item.command in JUMPS) if begun else frozenset()


def _is_completed(jump: int, before: dict[int, int], taken: dict[int, int]) -> bool:
    """Return whether a jump was passed without being taken, by the jumps taken before and after."""
    return jump in taken and taken[jump] not in (before.get(jump, -1), before.get(jump, 0) + 1)


class SkippedJump(NamedTuple):
    """The case that a jump ahead is not taken again.

    Attributes:
        seq: number of the jump
        probability: of this case [-]
        jumps: jumps taken in this case, as of `OnboardState`
    """

    seq: int
    probability: float
    jumps: tuple[JumpCounts, ...]


class OnboardState(msgspec.Struct):
    """What the autopilot reports of itself.

    Attributes:
        status: the newest
        mission: the newest
        params: the newest
        mode_changes: (time [s since 1970], mode), oldest first
        plan_changed_t: last change of mode, mission or parameters [s since 1970]
        controller_memory: of the controller just before that change
        received_items: items of the newest mission as received, before home was completed
        jumps: jumps taken at each jump after each change of the current item, oldest first
        uncounted: jumps that were perhaps taken before the first report
        entry: where the present mode was entered; None: before telemetry began
        target: newest guidance target in a mode that flies to it, latitude, longitude, height [1e-7 deg, mm]; None:
            none reported in this mode
    """

    status: Status | None = None
    mission: Mission | None = None
    params: Params | None = None
    mode_changes: deque[tuple[float, str]] = msgspec.field(default_factory=lambda: deque(maxlen=_MODE_CHANGES))
    plan_changed_t: float = -np.inf
    controller_memory: ControllerMemory = ("", ())
    received_items: tuple[Item, ...] = ()
    jumps: deque[JumpCounts] = msgspec.field(default_factory=lambda: deque(maxlen=_ITEM_CHANGES))
    uncounted: frozenset[int] = frozenset()
    entry: ModeEntry | None = None
    target: tuple[float, float, float] | None = None

    def set_status(self, status: Status, *, record: bool = True) -> None:
        """Store a status; with `record` also its mode, where that is new."""
        if record and (self.status is None or status.mode != self.status.mode):
            self.mode_changes.append((status.t, status.mode))
        self.status = status

    def enter_mode(self, entry: ModeEntry | None) -> None:
        """Store where a mode was entered; its target is not reported yet."""
        self.entry, self.target = entry, None

    def set_target(self, target: tuple[float, float, float]) -> None:
        """Store the guidance target of the present mode."""
        self.target = target

    def set_mission(self, mission: Mission, first: int) -> None:
        """Store a mission as received, and count its jumps; `first`: number of its first item to fly."""
        same = self.received_items[first:] == mission.items[first:]
        previous = self.mission.seq if self.mission is not None and same else -1
        if not same:
            self.uncounted = frozenset() if self.received_items else _perhaps_taken(mission, first)
            self.jumps.clear()
        self.mission, self.received_items = mission, mission.items
        if previous == mission.seq or not any(item.command in JUMPS for item in mission.items):
            return
        taken = self.jumps[-1][2] if self.jumps else {}
        items = {item.seq: item for item in mission.items}
        resets = resets_counters(self.params.values if self.params else {}, first)
        if previous >= first:
            before, taken = taken, count_jumps(items, taken, (previous, mission.seq), first=first, resets=resets)
            if not taken and not _perhaps_taken(mission, first):  # the mission has restarted
                self.uncounted = frozenset()
            self.uncounted = frozenset(jump for jump in self.uncounted if not _is_completed(jump, before, taken))
        self.jumps.append((mission.t, mission.seq, taken))

    @property
    def jumps_taken(self) -> dict[int, int]:
        """Return the jumps taken so far at each jump of the mission."""
        return self.jumps[-1][2] if self.jumps else {}

    def skipped_jump(self) -> SkippedJump | None:
        """Return the case that the next jump is not taken again; None if its repetitions are known.

        Each number of repetitions before the first report is equally likely.
        """
        if self.mission is None:
            return None
        jump = next_repeated_jump({item.seq: item for item in self.mission.items}, self.mission.seq)
        if jump is None or jump.seq not in self.uncounted:
            return None
        left = int(repetitions(jump)) - self.jumps_taken.get(jump.seq, 0)
        if left <= 0:
            return None
        jumps = ((t, seq, taken | {jump.seq: taken.get(jump.seq, 0) + left}) for t, seq, taken in self.jumps)
        before = (-np.inf, -1, {jump.seq: left})  # before the first report
        return SkippedJump(jump.seq, 1.0 / (left + 1), (before, *jumps))

    def complete_mission(self, items: tuple[Item, ...]) -> None:
        """Replace the items of the mission by those with home completed."""
        assert self.mission is not None
        self.mission = msgspec.structs.replace(self.mission, items=items)

    def set_params(self, params: Params) -> None:
        """Store parameters."""
        self.params = params

    def plan_changed(self, t: float, memory: ControllerMemory = ("", ())) -> None:
        """Record a change of mode, mission or parameters at `t` [s since 1970]; `memory`: of the controller before."""
        self.plan_changed_t, self.controller_memory = t, memory

    def shift_clock(self, step: float, plan_changed_t: float) -> None:
        """Shift all changes by `step` [s]; the newest was at `plan_changed_t` by the new clock [s since 1970]."""
        self.mode_changes = deque(((t + step, mode) for t, mode in self.mode_changes), maxlen=_MODE_CHANGES)
        self.plan_changed_t = plan_changed_t
        self.jumps = deque(((t + step, seq, taken) for t, seq, taken in self.jumps), maxlen=_ITEM_CHANGES)
        if self.entry is not None:
            self.entry = msgspec.structs.replace(self.entry, t=self.entry.t + step)


class Environment(msgspec.Struct):
    """What is estimated beside the model: wind, flight phase, and the autopilot's law.

    Attributes:
        wind: the wind filter
        wind_t: time of the newest row it has used [s since 1970]
        reported_wind_t: when it last took the wind that the autopilot reports, without airspeed [s since 1970]
        flight_phase: flying, landed, landing
        autopilot: law and parameters identified from flight
        wind_field: newest wind field of all aircraft; None: not known
        battery: power and charge, of a multirotor
        battery_forecast: newest; None: not known
        battery_timer: of forecasts
    """

    wind: WindFilter = msgspec.field(default_factory=WindFilter)
    wind_t: float = -np.inf
    reported_wind_t: float = -np.inf
    flight_phase: FlightPhase = msgspec.field(default_factory=FlightPhase)
    autopilot: AutopilotEstimate = msgspec.field(default_factory=AutopilotEstimate)
    wind_field: WindField | None = None
    battery: BatteryModel = msgspec.field(default_factory=BatteryModel)
    battery_forecast: BatteryForecast | None = None
    battery_timer: Timer = msgspec.field(default_factory=Timer)

    def set_wind_field(self, wind_field: WindField | None) -> None:
        """Store the wind field for the next predictions; it must be valid, see `SharedWind`."""
        self.wind_field = wind_field

    def has_own_wind(self, now: float) -> bool:
        """Return whether recent airspeeds feed the wind filter at `now` [s since 1970]."""
        return self.wind.t != self.reported_wind_t and abs(now - self.wind.t) < _WIND_MAX_AGE_S

    def update_wind(self, history: TelemetryHistory) -> None:
        """Update the wind filter with new rows, once a second."""
        if history.newest - self.wind_t >= _TICK_S:
            since = max(self.wind_t, history.newest - _LATE_S)
            self.wind_t = update_from_history(self.wind, history, self.wind_t, since)
            self._use_reported_wind(history)

    def _use_reported_wind(self, history: TelemetryHistory) -> None:
        """Take the wind of the autopilot's own estimator while no airspeed feeds the filter."""
        is_fed = self.wind.t != self.reported_wind_t and history.newest - self.wind.t < _WIND_MAX_AGE_S
        t, reported = history.rows_since("wind", history.newest - _WIND_MAX_AGE_S)
        if not is_fed and len(t):
            self.wind.reset_wind(float(t[-1]), np.append(reported[-1], 0.0))
            self.reported_wind_t = self.wind.t

    def update_battery(self, history: TelemetryHistory, wind: tuple[float, float]) -> None:
        """Update the battery model with new rows; `wind`: north and east [m/s]."""
        t, rows = history.rows_since("battery", max(self.battery.t, history.newest - _LATE_S))
        times, v = history.rows_since("velocity", history.newest - _LATE_S)
        if not len(t) or len(times) < _MIN_VELOCITIES:
            return
        at = np.column_stack([np.interp(t, times, column, left=np.nan) for column in v.T])
        self.battery.update(t, rows, at, np.array(wind))

    def store_battery_forecast(self, forecast: BatteryForecast | None, t: float) -> None:
        """Store the forecast of `t` [s since 1970]."""
        self.battery_forecast = forecast
        self.battery_timer.restart(t)

    def set_wind(self, wind: WindFilter, t: float) -> None:
        """Replace the wind filter by one that has used the rows up to `t` [s since 1970]."""
        self.wind, self.wind_t = wind, t

    def reset_clock(self) -> None:
        """Forget times: the new time may be earlier than the old one."""
        self.wind.t = self.wind_t = self.reported_wind_t = -np.inf
        self.wind_field = None
        self.flight_phase = FlightPhase()
        self.battery.t = -np.inf
        self.battery_timer.expire()

    def shift_clock(self, step: float) -> None:
        """Date the wind `step` later [s]."""
        self.wind.t, self.wind_t = self.wind.t + step, self.wind_t + step
        self.reported_wind_t += step
        self.battery.t += step
