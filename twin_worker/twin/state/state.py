"""State of one twin: telemetry, active model, past predictions; and the ingestion of messages."""

from collections.abc import Mapping
from math import isfinite, sqrt
from typing import Any

import msgspec
import numpy as np

from fleet.airframes import GENERIC, Airframe, load
from fleet.autopilots import arduplane
from fleet.contract import (
    Event,
    Message,
    Mission,
    Outcome,
    Params,
    Sample,
    Status,
    Verdict,
    WindEstimate,
)
from fleet.frames import Origin
from fleet.mission import FIRST_ITEM, extends, route_items
from fleet.terrain.areas import Area
from fleet.terrain.raster import Raster
from fleet.vehicles import UNKNOWN, VehicleClass, vehicle_class
from fleet.window import Window
from twin_worker.estimation.wind_field import shared_wind
from twin_worker.prediction.autopilot_identification import law_in_force
from twin_worker.prediction.replay_window import AutopilotConfig, PredictionContext
from twin_worker.twin.state.budget import ComputeBudget, Schedule, Work
from twin_worker.twin.state.events import invalidate_prediction
from twin_worker.twin.state.home import complete_home
from twin_worker.twin.state.inputs import Environment, OnboardState, Telemetry
from twin_worker.twin.state.models import Identification, ModelBank
from twin_worker.twin.state.outputs import AlertingState, ConfidenceState, PredictionState
from twin_worker.twin.state.routes import (
    HEARTBEAT_S,
    ROUTE_MODES,
    failsafe_plan,
    lock_course,
    mode_change_time,
    mode_entry,
    present_route,
    update_home,
    update_target,
)
from twin_worker.validation.verify import FIT_THRESHOLD

_CONTROLLER_PREFIXES = ("FW_", "MPC_", "NAV_", "NPFG_", "Q_WP_", "RTL_", "WPNAV_", "WP_")  # not ArduPlane
_ARDUPLANE_NAMES = {name for row in arduplane.TABLE for name in (row.name, *(older for older, _ in row.old_names))}
_POSITION_AGE_S = 2.0  # maximum age of the position of a wind estimate [s]
_MAX_NAMED = 3  # maximum number of changed parameters in the text
AUTO = "auto"  # use the prediction method with the lowest error


def changed_parameters(before: Mapping[str, float], after: Mapping[str, float]) -> list[str]:
    """Return the names of changed controller parameters; parameters received for the first time do not count."""
    relevant = (name for name in after if name in _ARDUPLANE_NAMES or name.startswith(_CONTROLLER_PREFIXES))
    return [name for name in relevant if name in before and before[name] != after[name] and isfinite(after[name])]


def describe_parameters(names: list[str], before: Mapping[str, float], after: Mapping[str, float]) -> str:
    """Describe the changed parameters with new and old values."""
    changes = [f"{name[:20]} is {after[name]:g}, it was {before[name]:g}" for name in names[:_MAX_NAMED]]
    return "; ".join(changes + ([f"and {len(names) - _MAX_NAMED} more"] if len(names) > _MAX_NAMED else []))


def describe_mission(before: Mission | None, after: Mission) -> str:
    """Describe the number of mission items and of changed items."""
    count = f"{len(after.items)} items" if after.items else "none"
    if before is None:
        return count
    if len(before.items) != len(after.items):
        return f"{count}, previously {len(before.items)}"
    n_changed = sum(old != new for old, new in zip(before.items, after.items, strict=True))
    return f"{count}, {n_changed} changed"


def _not_identified() -> Identification:
    return Identification(Verdict(outcome=Outcome.INSUFFICIENT_DATA, sentence="no samples yet"))


class TwinConfig(msgspec.Struct, frozen=True):
    """Configuration of one twin.

    Attributes:
        uav: UAV id
        omega: verification threshold [%]
        method: prediction method, `AUTO` for the one with the lowest error
        airframe: prior of the model; servo map where it has one
        schedule: periods of the recurring work
    """

    uav: int
    omega: float = FIT_THRESHOLD
    method: str = AUTO
    airframe: Airframe = msgspec.field(default_factory=lambda: load(GENERIC))
    schedule: Schedule = msgspec.field(default_factory=Schedule)


class Twin(msgspec.Struct):
    """Digital twin of one aircraft. Each part of its state is written by its own module only.

    Attributes:
        budget: compute budget of the driver; None: unlimited
        terrain: heights of the terrain, of the driver; None: unknown
        areas: to stay in or out of, of the driver
    """

    config: TwinConfig
    telemetry: Telemetry = msgspec.field(default_factory=Telemetry)
    onboard: OnboardState = msgspec.field(default_factory=OnboardState)
    environment: Environment = msgspec.field(default_factory=Environment)
    identification: Identification = msgspec.field(default_factory=_not_identified)
    models: ModelBank = msgspec.field(default_factory=ModelBank)
    prediction: PredictionState = msgspec.field(default_factory=PredictionState)
    confidence: ConfidenceState = msgspec.field(default_factory=ConfidenceState)
    alerts: AlertingState = msgspec.field(default_factory=AlertingState)
    budget: ComputeBudget | None = None
    terrain: Raster | None = None
    areas: tuple[Area, ...] = ()

    def __post_init__(self) -> None:
        """Use the servo map of the airframe file, if it has one, before any parameter arrives."""
        if self.config.airframe.servo_params:
            self.telemetry.set_servo_map(self.config.airframe.servo_params)

    @classmethod
    def of(cls, uav: int, **config: Any) -> "Twin":
        """Create the twin of a UAV id; `config` as of `TwinConfig`."""
        return cls(TwinConfig(uav, **config))

    def budget_allows(self, work: Work) -> bool:
        """Return whether the compute budget allows due heavy work now."""
        return self.budget is None or self.budget.try_acquire(work)

    @property
    def name(self) -> str:
        """Return the name used in texts, e.g. uav-7."""
        return f"uav-{self.config.uav}"

    @property
    def verdict_text(self) -> str:
        """Return the verdict of the active model, and the newest outcome if that model was not accepted."""
        if self.models.active_verdict is None:
            return self.identification.verdict.sentence
        if self.identification.verdict.outcome.is_accepted:
            return self.models.active_verdict.sentence
        return (
            f"{self.models.active_verdict.sentence}; newest identification: "
            f"{self.identification.verdict.outcome.value.replace('_', ' ')}"
        )

    @property
    def first_item(self) -> int:
        """Return the sequence number of the first mission item to fly: 0 if item 0 is not home."""
        return FIRST_ITEM.get(self.autopilot, 1)

    @property
    def autopilot(self) -> str:
        """Return the autopilot type from the heartbeat, e.g. px4."""
        return self.onboard.status.autopilot if self.onboard.status else "unknown"

    @property
    def received_params(self) -> dict[str, float]:
        """Return the received autopilot parameters, in the autopilot's names and units."""
        return self.onboard.params.values if self.onboard.params else {}

    @property
    def vehicle(self) -> str:
        """Return the vehicle type from the heartbeat, e.g. fixed_wing."""
        return self.onboard.status.vehicle if self.onboard.status else UNKNOWN

    @property
    def vehicle_class(self) -> VehicleClass:
        """Return the vehicle class."""
        return vehicle_class(self.vehicle)

    def window(self, seconds: float) -> Window | None:
        """Return the newest `seconds`, equally sampled; None if a required kind of row is missing."""
        assert self.telemetry.origin is not None
        newest = self.telemetry.history.newest
        return self.telemetry.resampler.window(
            self.telemetry.history,
            self.telemetry.origin,
            self.telemetry.servo_map,
            self.environment.wind.wind,
            until=newest,
            seconds=seconds,
        )

    def situation(self, window: Window) -> PredictionContext:
        """Return the initial data of a prediction from the end of `window`."""
        assert self.telemetry.origin is not None
        items = route_items(self.onboard.mission)
        law = law_in_force(self.autopilot, self.received_params, self.environment.autopilot.law)
        autopilot_config = AutopilotConfig(
            items,
            self.received_params,
            self.onboard.plan_changed_t,
            self.environment.autopilot.values,
            self.prediction.override,
            self.autopilot,
            law,
            self.environment.autopilot.reason,
            self.onboard.entry,
            present_route(self),
            failsafe_plan(self),
            self.onboard.controller_memory,
            tuple(self.onboard.jumps),
        )
        return PredictionContext(
            window,
            self.telemetry.history,
            autopilot_config,
            self.environment.wind,
            self.telemetry.origin,
            self.config.uav,
            None if self.environment.wind_field is None else shared_wind(self.environment.wind_field),
        )

    @property
    def wind_estimate(self) -> WindEstimate | None:
        """Return the wind with gusts by the aircraft's own filter; None without recent airspeed, position or home."""
        now, wind = self.telemetry.history.newest, self.environment.wind
        if self.home is None or not self.environment.has_own_wind(now):
            return None
        t, position = self.telemetry.history.rows_since("position", wind.t - _POSITION_AGE_S)
        if not len(t):
            return None
        k = int(np.abs(t - wind.t).argmin())
        lat_e7, lon_e7, alt_mm = (int(x) for x in position[k])
        present, variance = wind.present_wind
        return WindEstimate(
            t=float(wind.t),
            position=(lat_e7, lon_e7, alt_mm),
            height_m=1e-3 * (alt_mm - self.home.alt_mm),
            wind=(float(present[0]), float(present[1])),
            sigma=sqrt(max(variance, 0.0)),
        )

    @property
    def mode(self) -> str:
        """Return the flight mode from the heartbeat, e.g. AUTO; empty: unknown."""
        return self.onboard.status.mode if self.onboard.status else ""

    @property
    def home(self) -> Origin | None:
        """Return home: item 0 of an ArduPilot mission, as reported, or the last disarmed position; None if unknown."""
        items = self.onboard.mission.items if self.onboard.mission is not None else ()
        first = next((item for item in items if item.seq == 0), None)
        ardupilot = self.onboard.status is not None and self.onboard.status.autopilot == "ardupilot"
        if first is not None and ardupilot and (first.lat_e7 or first.lon_e7) and abs(first.alt_m) < 1e5:
            return Origin(first.lat_e7, first.lon_e7, round(first.alt_m * 1e3))
        reported = self.onboard.status.home if self.onboard.status is not None else None
        return self.alerts.home_fallback if reported is None else Origin(*reported)

    def no_route_reason(self) -> str:
        """Return why the aircraft follows no known route; empty if it does."""
        route = None if self.mode in ROUTE_MODES else present_route(self)
        if route is None:
            return self.no_mission_reason()
        return "" if len(route.legs) else f"mode {self.mode}: {route.summary}"

    def no_mission_reason(self) -> str:
        """Return why the aircraft follows no mission; empty if it does."""
        if self.mode not in ROUTE_MODES:
            return f"mode {self.mode or 'unknown'} follows no mission"
        if self.onboard.mission is None or not self.onboard.mission.items:
            return "no mission on board"
        return ""


def ingest(twin: Twin, message: Message) -> None:
    """Ingest one message from the gateway."""
    if isinstance(message, Sample):
        twin.telemetry.add(message)
        lock_course(twin)
        if message.target is not None:
            update_target(twin)
    elif isinstance(message, Status):
        _ingest_status(twin, message)
    elif isinstance(message, Mission):
        first = twin.first_item  # item 0 of a mission that contains home is no change: home moves, e.g. at arming
        if not _is_same_mission(twin.onboard, message, first):
            text, is_first = describe_mission(twin.onboard.mission, message), twin.onboard.mission is None
            invalidate_prediction(twin, Event.MISSION, message.t, text, is_first=is_first)
        twin.onboard.set_mission(message, first)
        complete_home(twin)
    elif isinstance(message, Params):
        names = changed_parameters(twin.received_params, message.values)
        if names or twin.onboard.params is None:
            text = describe_parameters(names, twin.received_params, message.values)
            event = Event.PARAMETERS if names else None
            invalidate_prediction(twin, event, message.t, text, is_first=twin.onboard.params is None)
        twin.onboard.set_params(message)
        twin.telemetry.set_servo_map(twin.config.airframe.servo_params or message.values)


def _is_same_mission(onboard: OnboardState, mission: Mission, first: int) -> bool:
    """Return whether a mission is the known one from item `first` on, or more items of an incomplete one."""
    if onboard.mission is None:
        return False
    known = onboard.received_items[first:]
    return known == mission.items[first:] or (not onboard.mission.complete and extends(mission.items, known))


def _ingest_status(twin: Twin, status: Status) -> None:
    previous = twin.onboard.status
    twin.onboard.set_status(status)
    if previous is None:
        return
    if status.clock_jumps != previous.clock_jumps:
        for part in (twin.telemetry, twin.environment, twin.identification, twin.models, twin.confidence):
            part.reset_clock()
        invalidate_prediction(twin, Event.CLOCK, status.t)
        return
    if 0 < (step := status.clock_advance_s - previous.clock_advance_s) < np.inf:
        _shift_clock(twin, step)
    if status.home != previous.home and status.mode == previous.mode:
        update_home(twin, None if previous.home is None else Origin(*previous.home), status.t)
    if status.mode != previous.mode:
        changed_t = mode_change_time(twin, status.t)
        twin.onboard.enter_mode(mode_entry(twin, changed_t))
        details = f"{status.mode[:20]}, previously {previous.mode[:20]}"
        event = Event.MODE if previous.mode else None
        known_t = changed_t if changed_t < status.t else status.t - HEARTBEAT_S
        invalidate_prediction(twin, event, changed_t, details, known_t=known_t)
        update_target(twin)


def _shift_clock(twin: Twin, step: float) -> None:
    """Shift all stored times forward after the gateway re-anchored the telemetry clock."""
    if not np.isfinite(twin.telemetry.history.newest):
        return
    for part in (twin.telemetry, twin.environment, twin.identification, twin.models):
        part.shift_clock(step)
    plan_changed_t = twin.onboard.plan_changed_t + step
    invalidate_prediction(twin, None, twin.telemetry.history.newest)
    twin.onboard.shift_clock(step, plan_changed_t)
    message = f"telemetry was {step:.1f} s behind its arrival and was re-anchored: earlier predictions are void"
    twin.prediction.add_event(Event.CLOCK, twin.telemetry.history.newest, message)
