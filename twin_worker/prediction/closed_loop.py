"""Closed-loop prediction: synchronise the controller twin with telemetry, then simulate the route.

Source: Huang 2021, section 3.4 (identical controller, same route, identified model in the loop).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fleet.autopilots import arduplane, laws
from fleet.autopilots.shadow import replay_controller
from fleet.contract import Item
from fleet.frames import Origin, wrap
from fleet.mission import FIRST_ITEM, KIND, LAND, P_D, P_N, SPEED, TAKEOFF
from fleet.physics.simulate import N_STATE, simulate
from fleet.process.sanitise import format_below
from fleet.window import Window
from twin_worker.estimation.airspeed_setpoint import apply_setpoint, inferred_setpoint, reported_setpoint
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.plant import Plant, actuator_state, bias_corrected
from twin_worker.numerics.interpolation import interpolate_rows, zero_order_hold
from twin_worker.prediction.autopilot_parameters import (
    CRUISE_OF,
    ControllerTwin,
    RouteOverride,
    fixed_wing_controller,
    transfer_controller,
)
from twin_worker.prediction.route_cache import cached_route
from twin_worker.telemetry.history import TelemetryHistory

MIN_ROLLOUT_S = 60.0  # shortest valid rollout [s]
SHADOW_S = 60.0  # telemetry for the synchronisation of the controller twin [s]
_WIND_MAX_AGE_S = 10.0  # maximum age of the autopilot's wind estimate [s]
_ITEM_DELAY_S = 2.0  # between the mission and the telemetry that report the same item, at most [s]
_SHADOW_STEP = 2  # window rows per shadow step
JumpCounts = tuple[float, int, dict[int, int]]
"""Time [s since 1970], the item that became current, and the jumps taken until then at each jump."""
_NOT_MODELLED = {TAKEOFF: "take-off", LAND: "landing"}


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
class InitialCondition:
    """Start of rollouts of any model.

    Attributes:
        window: flight on the present route
        synchronised: synchronised state, parameters and legs of the controller twin
        state: state, current commands and inputs, and air, as for `fleet.physics.simulate`
        seq: current mission item
        sentence: limitations, or empty
        controller: the controller twin
    """

    window: Window
    synchronised: tuple[np.ndarray, np.ndarray, np.ndarray]
    state: tuple[np.ndarray, np.ndarray, np.ndarray]
    seq: int
    sentence: str
    controller: ControllerTwin


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
        legs, start_point: route from the first current item, and the point before
        rows: t p v euler rates Va phi_c theta_c delta, as for `shadow`
        seq: current mission item of each row
        altitude_m: final height above mean sea level [m]
        sentence: problems of the route, or empty
    """

    window: Window
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
    """

    window: Window
    history: TelemetryHistory
    onboard: AutopilotConfig
    wind_filter: WindFilter
    origin: Origin


def _reported(history: TelemetryHistory, name: str, query_t: np.ndarray, max_age: float) -> np.ndarray:
    """Return the last reported row at each time, nan after `max_age` seconds, (len(query_t), k)."""
    return zero_order_hold(*history.rows_since(name, query_t[0] - max_age - 1.0), query_t, max_age)


def fly_ahead(context: PredictionContext, plant: Plant, ahead: np.ndarray) -> Rollout:
    """Predict with the identified model and the controller twin in closed loop.

    Args:
        context: inputs; the prediction starts at the end of its window
        plant: derivatives model, or longitudinal and lateral linear axes
        ahead: requested look-ahead times, rising, (k,) [s]
    """
    initial = synchronise_controller(context)
    return initial if isinstance(initial, Rollout) else fly_from(initial, plant, ahead)


def replay_inputs(context: PredictionContext) -> ReplayWindow | Rollout:
    """Return the replay data of the present route, or the reason why there are none."""
    window = _window_on_route(context.window, context.onboard.changed_t)
    if len(window) < 5.0 / window.dt:
        return Rollout(None, -1, f"{format_below(window.seconds, 5.0)} s on this route, 5 s are needed; wait")
    stride = slice((len(window) - 1) % _SHADOW_STEP, None, _SHADOW_STEP)
    times = window.t[stride]
    seq = _reported(context.history, "leg", times, 15.0)[:, 0]
    if not np.isfinite(seq[-1]):
        return Rollout(None, -1, "the current mission item is not reported (MISSION_CURRENT)")
    seq = np.where(np.isfinite(seq), seq, seq[np.isfinite(seq)][0]).astype(np.int64)
    onboard = context.onboard
    first = FIRST_ITEM.get(onboard.autopilot, 1)
    jumps = onboard.jumps_taken(float(times[0]), int(seq[0]))
    mission_route = cached_route(onboard.items, int(seq[0]), context.origin, onboard.params, first, jumps=jumps)
    problem = mission_route.summary
    if not len(mission_route.legs):
        return Rollout(None, int(seq[-1]), problem or "the mission has no legs to fly")
    start_point = mission_route.start if np.isfinite(mission_route.start).all() else window.p[0]
    altitude = context.origin.alt_mm * 1e-3 - float(window.p[-1, 2])
    return ReplayWindow(
        window, mission_route.legs, start_point, _replay_rows(window, stride, context.history), seq, altitude, problem
    )


def autopilot_wind(context: PredictionContext, window: Window) -> tuple[float, float]:
    """Return the wind estimate of the autopilot if reported, else of the twin, NED [m/s]."""
    reported = _reported(context.history, "wind", window.t[-1:], _WIND_MAX_AGE_S)[0]
    w_n, w_e = reported if np.isfinite(reported).all() else context.wind_filter.wind[:2]
    return float(w_n), float(w_e)


def synchronise_controller(context: PredictionContext) -> InitialCondition | Rollout:
    """Synchronise the controller twin with telemetry; return the start of rollouts, or why there is none."""
    replay, onboard = replay_inputs(context), context.onboard
    if isinstance(replay, Rollout):
        return replay
    seq = int(replay.seq[-1])
    if not onboard.law:
        return Rollout(None, seq, onboard.law_reason or "the control law is not known yet")
    controller = fixed_wing_controller(onboard.params, onboard.identified, law=onboard.law)
    par = laws.with_wind(controller.par(replay.altitude_m), *autopilot_wind(context, replay.window))
    setpoint = _airspeed_setpoint(context, float(replay.window.t[-1]), float(controller.values[CRUISE_OF[onboard.law]]))
    legs = apply_setpoint(replay.legs, float(seq), float(controller.values[CRUISE_OF[onboard.law]]), setpoint)
    ctl, _ = replay_controller(par, legs, replay.start_point, *replay.rows, replay.seq)  # type: ignore[call-arg]
    sentence = " ".join(filter(None, (onboard.law_reason, replay.sentence)))
    initial = InitialCondition(
        replay.window, (ctl, par, legs), _simulation_state(context, replay.window), seq, sentence, controller
    )
    if onboard.override is not None:
        initial = _apply_override(context, initial, onboard.override, setpoint)
    return _not_modelled(initial) or replace(
        initial, sentence=" ".join(filter(None, (initial.sentence, _default_warning(initial.controller))))
    )


def _airspeed_setpoint(context: PredictionContext, t: float, cruise: float) -> float:
    """Return the airspeed set-point: reported, else the flown one of the mission speeds; nan if unknown [m/s]."""
    setpoint = reported_setpoint(context.history, t)
    if np.isfinite(setpoint):
        return setpoint
    mission_speeds = {
        item.param2 for item in context.onboard.items if item.command == SPEED and 0 < item.param2 < np.inf
    }
    return (
        inferred_setpoint(context.history, t, np.array(sorted(mission_speeds | {cruise})))
        if mission_speeds
        else setpoint
    )


def _altitude(context: PredictionContext, window: Window) -> float:
    return context.origin.alt_mm * 1e-3 - float(window.p[-1, 2])


def _apply_override(
    context: PredictionContext, initial: InitialCondition, override: RouteOverride, setpoint: float
) -> InitialCondition:
    """Transfer the synchronised controller to a what-if query; `setpoint`: airspeed set-point so far [m/s]."""
    law_name = context.onboard.law
    controller, cruise = (
        fixed_wing_controller(context.onboard.params, context.onboard.identified, override.parameters, law_name),
        CRUISE_OF[law_name],
    )
    new_route = override.to_route(context.origin, context.onboard.params)
    par = laws.with_wind(controller.par(_altitude(context, initial.window)), *autopilot_wind(context, initial.window))
    legs, (ctl, _, old_legs) = new_route.legs, initial.synchronised
    if len(legs):
        new_setpoint = np.nan if cruise in override.parameters else setpoint
        legs = apply_setpoint(legs, float(override.seq), float(controller.values[cruise]), new_setpoint)
        ctl = transfer_controller(ctl, old_legs, par, legs, (override.restart_leg, initial.window.p[-1]))
    state = initial.state[0].copy()
    state[3:6] = override.scale_to_speed(state[3:6])
    sentence = new_route.summary
    initial = replace(initial, state=(state, *initial.state[1:]), synchronised=(ctl, par, legs))
    return replace(initial, seq=override.seq, sentence=sentence, controller=controller)


def _not_modelled(initial: InitialCondition) -> Rollout | None:
    """Return the reason why the current leg is not modelled; None if it is."""
    ctl, _, legs = initial.synchronised
    if not len(legs):
        return Rollout(None, initial.seq, initial.sentence or "the mission has no legs to fly")
    kind = int(legs[int(ctl[arduplane.LEG]), KIND])
    if kind not in _NOT_MODELLED:
        return None
    return Rollout(None, initial.seq, f"{_NOT_MODELLED[kind]} is not modelled: no route-aware prediction")


def _default_warning(controller: ControllerTwin) -> str:
    """Describe the parameters that are assumed at their defaults; empty if there are none."""
    absent = controller.default_names
    examples = f"({', '.join(absent[:3])} …)"
    return f"{len(absent)} autopilot parameters not received, defaults assumed {examples}" if absent else ""


def fly_from(initial: InitialCondition, plant: Plant, ahead: np.ndarray) -> Rollout:
    """Simulate one model from the start; arguments as for `fly_ahead`. The path is nan beyond the envelope."""
    ctl, par, legs = initial.synchronised
    dt = initial.window.dt
    out = np.empty((int(ahead[-1] / dt) + 2, N_STATE))
    ctl = ctl.copy()
    n_rows = simulate(ctl, par, legs, bias_corrected(plant, initial.window), *initial.state, dt, out)
    return sample_rollout(out[:n_rows, :3], dt, initial, ctl, ahead)


def sample_rollout(
    p: np.ndarray, step: float, initial: InitialCondition, ctl: np.ndarray, ahead: np.ndarray
) -> Rollout:
    """Sample a rollout at the look-ahead times: nan beyond its end, constant position after touchdown.

    Args:
        p: positions every `step` [s] until the twin left its envelope, NED, (n, 3) [m], changed in place
        initial: start of the rollout
        ctl: final controller state
        ahead: requested look-ahead times, rising, (k,) [s]
    """
    landed = _hold_after_touchdown(p, ctl, initial.synchronised[2])
    if not landed and len(p) <= min(ahead[-1], ahead[0] + MIN_ROLLOUT_S) / step:
        return Rollout(None, initial.seq, f"the twin leaves its envelope {len(p) * step:.0f} s ahead", True)
    t, after_end = step * np.arange(len(p)), None if landed else np.nan
    path = interpolate_rows(ahead, t, p, after_end)
    return Rollout(path, initial.seq, initial.sentence, controller=initial.controller)


def _hold_after_touchdown(p: np.ndarray, ctl: np.ndarray, legs: np.ndarray) -> bool:
    """Fix positions, NED (n, 3) [m], after touchdown at the end of the route; return whether it is reached."""
    leg = int(ctl[arduplane.LEG])
    if not len(p) or int(legs[leg, KIND]) != LAND:
        return False
    leg_start = ctl[arduplane.FROM][:2]
    line = legs[leg, P_N:P_D] - leg_start
    before_end = np.flatnonzero((p[:, :2] - leg_start) @ line < line @ line)
    touchdown_row = int(before_end[-1]) + 1 if len(before_end) else 0
    p[touchdown_row:] = p[min(touchdown_row, len(p) - 1)]
    return touchdown_row < len(p)


def _window_on_route(window: Window, changed_t: float) -> Window:
    """Return the gap-free flight on the present route, at most `SHADOW_S`."""
    start = max(int(np.searchsorted(window.t, changed_t)), len(window) - int(SHADOW_S / window.dt))
    invalid_rows = np.flatnonzero(~window.ok)
    start = max(start, int(invalid_rows[-1]) + 1 if len(invalid_rows) else 0)
    return window.part(min(start, len(window) - 2), len(window))


def _replay_rows(window: Window, stride: slice, history: TelemetryHistory) -> tuple[np.ndarray, ...]:
    """Return the synchronisation data at some rows: t p v euler rates Va phi_c theta_c delta."""
    times = window.t[stride]
    command, Va = _reported(history, "command", times, 1.0), _reported(history, "air", times, 1.0)[:, 0]
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


def _simulation_state(context: PredictionContext, window: Window) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return state (12,), current commands and inputs (6,) and air (4,) at the end of the window."""
    state = np.concatenate([window.p[-1], window.x[-3:, :6].mean(axis=0), window.x[-1, 6:]])
    command = _reported(context.history, "command", window.t[-1:], 1.0)[0, :2]
    command = np.where(np.isfinite(command), command, window.x[-1, 6:8])
    command = np.concatenate([command, actuator_state(window)])
    return state, command, np.array([*context.wind_filter.wind[:2], context.wind_filter.scale, _gust(context, window)])


def _gust(context: PredictionContext, window: Window) -> float:
    """Return the airspeed minus the airspeed by mean wind [m/s]; 0 without an airspeed sensor."""
    t, air = context.history.rows_since("air", window.t[-1] - 1.0)
    recent = air[t <= window.t[-1], 0]
    if not len(recent) or recent.min() < 3.0:
        return 0.0
    n = int(1.0 / window.dt)
    return float(recent.mean() * context.wind_filter.scale - np.linalg.norm(window.x[-n:, :3], axis=1).mean())
