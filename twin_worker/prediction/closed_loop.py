"""Closed-loop prediction: synchronise the controller twin with telemetry, then simulate the route.

Source: Huang 2021, section 3.4 (identical controller, same route, identified model in the loop).
"""

from dataclasses import dataclass, replace

import numpy as np

from fleet.autopilots import arduplane, laws
from fleet.autopilots.arduplane.params import EAS2TAS
from fleet.autopilots.control_law import SWITCH_LEG, SWITCH_S, V_DEM
from fleet.autopilots.shadow import NO_MEMORY, replay_controller
from fleet.mission import KIND, LAND, P_D, P_N, SPEED, TAKEOFF, VA_C
from fleet.physics.simulate import N_STATE, simulate
from fleet.window import Window
from twin_worker.estimation.airspeed_setpoint import (
    MIN_DIFFERENCE,
    STEADY_S,
    apply_setpoint,
    inferred_setpoint,
    reported_demand,
    reported_setpoint,
)
from twin_worker.identification.fixed_wing.plant import Plant, actuator_state, bias_corrected
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.prediction.autopilot_parameters import (
    CRUISE_OF,
    ControllerTwin,
    RouteOverride,
    fixed_wing_controller,
    transfer_controller,
)
from twin_worker.prediction.replay_window import (
    AutopilotConfig,
    PredictionContext,
    ReplayWindow,
    Rollout,
    replay_inputs,
    reported,
    route_error,
)

MIN_ROLLOUT_S = 60.0  # shortest valid rollout [s]
_REPORT_DELAY_S = 0.5  # reports sooner after a mode change may be older than it [s]
_AT_CHANGE_S = 0.5  # a replay that begins this near to a change of the route continues the state before it [s]
_RESET_S = 10.0  # without reports, the set-point is that of the mode change for so long [s]
_WIND_MAX_AGE_S = 10.0  # maximum age of the autopilot's wind estimate [s]
_NOT_MODELLED = {TAKEOFF: "take-off", LAND: "landing"}


@dataclass(frozen=True)
class InitialCondition:
    """Start of rollouts of any model.

    Attributes:
        window: newest flight without gaps
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


def fly_ahead(context: PredictionContext, plant: Plant, ahead: np.ndarray) -> Rollout:
    """Predict with the identified model and the controller twin in closed loop.

    Args:
        context: inputs; the prediction starts at the end of its window
        plant: derivatives model, or longitudinal and lateral linear axes
        ahead: requested look-ahead times, rising, (k,) [s]
    """
    initial = synchronise_controller(context)
    return initial if isinstance(initial, Rollout) else fly_from(initial, plant, ahead)


def autopilot_wind(context: PredictionContext, window: Window) -> tuple[float, float]:
    """Return the wind estimate of the autopilot if reported, else of the twin, NED [m/s]."""
    latest = reported(context.history, "wind", window.t[-1:], _WIND_MAX_AGE_S)[0]
    w_n, w_e = latest if np.isfinite(latest).all() else context.wind_filter.wind[:2]
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
    ctl, rms = replay_controller(par, legs, replay.start_point, *replay.rows, replay.seq, _memory(onboard, replay))  # type: ignore[call-arg]
    if error := route_error(onboard.mode_route, float(rms), replay.phi_c, replay.window.seconds):
        return Rollout(None, seq, error)
    if onboard.law == "arduplane":
        _align_speed_demand(ctl, par, reported_demand(context.history, float(replay.window.t[-1])))
    sentence = " ".join(filter(None, (onboard.law_reason, replay.sentence)))
    initial = InitialCondition(
        replay.flight, (ctl, par, legs), _simulation_state(context, replay.flight), seq, sentence, controller
    )
    if onboard.override is not None:
        initial = _apply_override(context, initial, onboard.override, setpoint)
    return _not_modelled(initial) or replace(
        initial, sentence=" ".join(filter(None, (initial.sentence, _default_warning(initial.controller))))
    )


def _memory(onboard: AutopilotConfig, replay: ReplayWindow) -> np.ndarray:
    """Return the state of the controller before the route changed, if the replay begins there."""
    law, values = onboard.memory
    begins_there = abs(float(replay.window.t[0]) - onboard.changed_t) < _AT_CHANGE_S
    return np.array(values) if begins_there and values and law == onboard.law else NO_MEMORY


def _align_speed_demand(ctl: np.ndarray, par: np.ndarray, demand: float) -> None:
    """Set the speed demand of ArduPlane to the reported equivalent airspeed [m/s], where it is on its way elsewhere."""
    V = demand * par[EAS2TAS]
    if abs(V - ctl[V_DEM]) > MIN_DIFFERENCE:  # false for nan
        ctl[V_DEM] = V


def _airspeed_setpoint(context: PredictionContext, t: float, cruise: float) -> float:
    """Return the airspeed set-point: reported, else the flown one of the mission speeds; nan if unknown [m/s].

    A mode change resets the set-point of ArduPlane to cruise. With others the speed flown before it tells nothing: PX4
    flies a mode without mission at cruise, and commands the speed of the mission again when it returns to it.
    """
    entry = context.onboard.entry
    entered_t = -np.inf if entry is None else entry.t
    setpoint = reported_setpoint(context.history, t, entered_t + _REPORT_DELAY_S)
    if np.isfinite(setpoint):
        return setpoint
    if context.onboard.law == "arduplane" and t < entered_t + _RESET_S:
        return cruise
    if context.onboard.law != "arduplane" and t < entered_t + STEADY_S:
        return float("nan")
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
        if override.after_s > 0.0 and len(old_legs):
            if cruise in override.parameters:  # the parameter itself would act at once
                legs = legs.copy()
                legs[legs[:, VA_C] <= 0.0, VA_C] = override.parameters[cruise]
            return _schedule_route(initial, legs, override.after_s)
        ctl = transfer_controller(ctl, old_legs, par, legs, (override.restart_leg, initial.window.p[-1]))
    state = initial.state[0].copy()
    state[3:6] = override.scale_to_speed(state[3:6])
    sentence = new_route.summary
    initial = replace(initial, state=(state, *initial.state[1:]), synchronised=(ctl, par, legs))
    return replace(initial, seq=override.seq, sentence=sentence, controller=controller)


def _schedule_route(initial: InitialCondition, legs: np.ndarray, after_s: float) -> InitialCondition:
    """Append a route that begins after a time [s], at the position reached then."""
    ctl, par, present = initial.synchronised
    ctl = ctl.copy()
    # the separator keeps the new route from being a continuation of the last leg
    ctl[SWITCH_S], ctl[SWITCH_LEG] = after_s, len(present) + 1
    return replace(initial, synchronised=(ctl, par, np.vstack([present, present[-1:], legs])))


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


def _simulation_state(context: PredictionContext, window: Window) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return state (12,), current commands and inputs (6,) and air (4,) at the end of the window."""
    state = np.concatenate([window.p[-1], window.x[-3:, :6].mean(axis=0), window.x[-1, 6:]])
    command = reported(context.history, "command", window.t[-1:], 1.0)[0, :2]
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
