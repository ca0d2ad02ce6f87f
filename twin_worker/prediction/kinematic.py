"""Kinematic model of a fixed wing: route guidance and lags, identified from positions alone.

Airspeed and wind come from the wind filter; without an airspeed sensor they come from the change of ground speed with
course. A guidance period that is not received is the one with the smallest error over the last minute.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import atan2

import numpy as np

from fleet.autopilots import arduplane
from fleet.autopilots import greybox as law
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.modes import NO_ITEM, ModeEntry
from fleet.autopilots.shadow import NO_MEMORY, replay_controller
from fleet.contract import Item
from fleet.frames import G, Origin
from fleet.mission import KIND, TAKEOFF, VA_C, Route
from fleet.process.sanitise import format_below
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.prediction.autopilot_parameters import (
    CRUISE_OF,
    ControllerTwin,
    RouteOverride,
    fixed_wing_controller,
    transfer_controller,
)
from twin_worker.prediction.failsafe_route import FailsafePlan, with_failsafe
from twin_worker.prediction.replay_window import MAX_EARLY_S, items_since_entry, leg_start, route_error
from twin_worker.prediction.route_cache import cached_route
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.track import STEP, Track
from twin_worker.telemetry.velocity import present_velocity

MIN_TRACK_S = 5.0  # minimum track without gaps [s]
_SYNC_S = 60.0  # flight for the synchronisation of the guidance [s]
_COMPARE_S, _START_INTERVAL_S, _RUN_S = 80.0, 8.0, 20.0  # compared flight, interval of starts, length of a rollout [s]
_PERIOD_VALUES = (9.0, 12.0, 16.0, 20.0, 26.0)  # NAVL1_PERIOD tried if not received [s]
_LAG_VALUES = (0.4, 0.8, 1.4)  # tried bank lags [s]
_SPEED_S = 20.0  # window of the mean airspeed [s]
_BIAS_S = 20.0  # window of the bank error [s]
_MIN_AIRSPEED = 5.0  # minimum airspeed of fixed-wing flight [m/s]
CRUISE = CRUISE_OF["arduplane"]
_WIND_PRIOR = 5.0  # prior standard deviation of the wind [m/s]


@dataclass(frozen=True)
class KinematicModel:
    """Identified guidance period [s], bank lag [s], mean error over 20 s [m] and its number of starts."""

    period: float = 0.0  # 0: from the parameters
    tau_phi: float = 0.8
    mean_error: float = float("nan")
    n_starts: int = 0

    @property
    def identified(self) -> dict[str, float]:
        """Return the identified parameters by autopilot name."""
        return {"NAVL1_PERIOD": self.period} if self.period > 0 else {}


@dataclass(frozen=True)
class KinematicConfig:
    """Route and parameters of the autopilot, and wind."""

    items: tuple[Item, ...]
    params: dict[str, float]
    changed_t: float
    origin: Origin
    wind: np.ndarray | None  # NED, (3,) [m/s]; None: no airspeed received
    override: RouteOverride | None = None  # what-if query, from the start on
    first_item: int = 1  # number of the first mission item to fly
    entry: ModeEntry | None = None  # where the mode was entered
    mode_route: Route | None = None  # of a mode without mission, which replaces the items
    history: TelemetryHistory | None = None  # reported mission items
    failsafe: FailsafePlan | None = None  # after a link loss
    identified: Mapping[str, float] = field(default_factory=dict)  # turn parameters, used if not received


@dataclass(frozen=True)
class KinematicRollout:
    """Rollout, or the reason why there is none."""

    path: np.ndarray | None
    seq: int
    sentence: str
    controller: ControllerTwin | None = None
    known_s: float = np.inf  # look-ahead at which a failsafe begins whose route is not known [s]


def wind_and_airspeed(track: Track, wind: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Return wind (2,) and mean true airspeed [m/s].

    Without a wind, |v - w|^2 = V^2 is linear in w and V^2 - w^2: |v|^2 = 2 v.w + (V^2 - |w|^2).
    """
    v = track.v[track.ok][-int(120 / STEP) :: 5, :2]
    if wind is not None:
        w = np.asarray(wind[:2], float)
    else:
        A = np.column_stack([2 * v, np.ones(len(v))])
        noise = 2.0 * max(float(np.mean(np.hypot(*v.T))), 5.0)  # a gust of 1 m/s in |v|^2
        penalty = np.diag([(noise / _WIND_PRIOR) ** 2, (noise / _WIND_PRIOR) ** 2, 1e-9])
        prior_mean = np.array([0.0, 0.0, np.mean(np.sum(v * v, axis=1))])
        w = np.linalg.solve(A.T @ A + penalty, A.T @ (np.sum(v * v, axis=1)) + penalty @ prior_mean)[:2]
        w = w * min(1.0, 15.0 / max(float(np.hypot(*w)), 1e-6))
    recent = track.v[track.ok][-int(_SPEED_S / STEP) :]
    return w, float(np.mean(np.linalg.norm(recent - [*w, 0.0], axis=1)))


def fly(
    track: Track, seq: np.ndarray, config: KinematicConfig, model: KinematicModel, ahead: np.ndarray
) -> KinematicRollout:
    """Predict the flight along the route from the end of the track.

    Args:
        track: newest flight
        seq: current mission item of each row, nan if unknown, (n,)
        config, model: configuration of the autopilot, and the identified model
        ahead: requested look-ahead times, (k,) [s]
    """
    invalid_rows = np.flatnonzero(~track.ok)
    flight = track.part(int(invalid_rows[-1]) + 1 if len(invalid_rows) else 0, len(track))
    if len(flight) < MIN_TRACK_S / STEP:
        reason = f"{format_below(len(flight) * STEP, MIN_TRACK_S)} s without gaps, {MIN_TRACK_S:.0f} s are needed; wait"
        return KinematicRollout(None, -1, reason)
    if flight.t[-1] < config.changed_t - MAX_EARLY_S:
        return KinematicRollout(None, -1, "the route changed after this telemetry")
    seq = seq[-len(flight) :] if config.mode_route is None else np.full(len(flight), NO_ITEM)
    if config.mode_route is None:
        seq = items_since_entry(seq, flight.t, config.entry, config.history)
    first = max(int(np.searchsorted(flight.t, config.changed_t)), len(flight) - int(_SYNC_S / STEP))
    unknown_rows = np.flatnonzero(~np.isfinite(seq))
    first = max(min(first, len(flight) - 2), int(unknown_rows[-1]) + 1 if len(unknown_rows) else 0)
    if first >= len(flight):
        return KinematicRollout(None, -1, "the current mission item is not reported (MISSION_CURRENT)")
    return _fly_route(flight, first, seq[first:].astype(np.int64), (config, model), ahead)


def _fly_route(
    flight: Track, first: int, seq: np.ndarray, options: tuple[KinematicConfig, KinematicModel], ahead: np.ndarray
) -> KinematicRollout:
    """Predict from the end of `flight`, which is on the present route from row `first` on, with the items `seq`."""
    config, model = options
    recent = flight.part(first, len(flight))
    controller = fixed_wing_controller(config.params, {**config.identified, **model.identified}, sentence=law.LAW)
    par = controller.par(_altitude(recent, config))
    mission_route = config.mode_route or cached_route(
        config.items, int(seq[0]), config.origin, config.params, config.first_item
    )
    if not len(mission_route.legs):
        return KinematicRollout(None, int(seq[-1]), mission_route.summary or "the mission has no legs to fly")
    w, V = wind_and_airspeed(flight, config.wind)
    if V < _MIN_AIRSPEED or np.linalg.norm(recent.v[-1] - [*w, 0.0]) < _MIN_AIRSPEED:
        return KinematicRollout(None, int(seq[-1]), "too slow to fly on wings")
    start_point = mission_route.start
    if config.mode_route is None:
        at = int(seq[0]), float(recent.t[0]), recent.p[0]
        start_point = leg_start(mission_route, config.entry, config.history, at)
    ctl, rms, banks = _synchronise(recent, seq, (par, mission_route.legs, start_point), w)
    if error := route_error(config.mode_route, rms, banks, STEP * len(recent)):
        return KinematicRollout(None, int(seq[-1]), error)
    lags = _lag_parameters(
        flight, mission_route.legs[int(ctl[arduplane.LEG])], par, controller.default_names, (model, V)
    )
    lags[law.B_PHI] = _bank_error(flight, w)
    guidance = _RouteGuidance(ctl, par, mission_route, lags, controller)
    if config.override is not None:
        guidance = _apply_override(guidance, recent, config, model, config.override)
    if not len(guidance.route.legs):
        return KinematicRollout(None, int(seq[-1]), guidance.route.summary or "the mission has no legs to fly")
    if int(guidance.route.legs[int(guidance.ctl[arduplane.LEG]), KIND]) == TAKEOFF:
        return KinematicRollout(None, int(seq[-1]), "take-off is not modelled: no route-aware prediction")
    state, sentence = _state(flight, w), guidance.route.summary
    if config.override is not None and config.override.speed is not None:
        state[3] = config.override.speed

    def path_of(ctl: np.ndarray, legs: np.ndarray, times: np.ndarray) -> np.ndarray:
        out = np.empty((int(times[-1] / STEP) + 2, 3))
        law.follow(ctl.copy(), guidance.par, legs, guidance.lags, state, w, STEP, out)
        return interpolate_rows(times, STEP * np.arange(len(out)), out)

    ctl, legs, known_s = guidance.ctl, guidance.route.legs, np.inf
    if config.failsafe is not None:
        ctl, legs, failsafe_text, known_s = with_failsafe(ctl, legs, config.failsafe, path_of, float(recent.t[-1]))
        sentence = " ".join(filter(None, (failsafe_text, sentence)))
    path = path_of(ctl, legs, ahead)
    start_seq = int(seq[-1]) if config.override is None else config.override.seq
    return KinematicRollout(path, start_seq, sentence, guidance.controller, known_s)


@dataclass(frozen=True)
class _RouteGuidance:
    """State and parameters of the guidance, route, lags and controller."""

    ctl: np.ndarray
    par: np.ndarray
    route: Route
    lags: np.ndarray
    controller: ControllerTwin


def _altitude(recent: Track, config: KinematicConfig) -> float:
    return config.origin.alt_mm * 1e-3 - float(recent.p[-1, 2])


def _apply_override(
    guidance: _RouteGuidance, recent: Track, config: KinematicConfig, model: KinematicModel, override: RouteOverride
) -> _RouteGuidance:
    """Transfer the synchronised guidance to a what-if query; its lags and speed ratio stay."""
    controller = fixed_wing_controller(
        config.params, {**config.identified, **model.identified}, override.parameters, sentence=law.LAW
    )
    new_route, par, lags = (
        override.to_route(config.origin, config.params),
        controller.par(_altitude(recent, config)),
        guidance.lags.copy(),
    )
    if CRUISE in override.parameters:
        lags[law.CRUISE] = par[P.VA_CRUISE] * lags[law.TAS_RATIO]
    ctl = guidance.ctl
    if len(new_route.legs):
        ctl = transfer_controller(ctl, guidance.route.legs, par, new_route.legs, (override.restart_leg, recent.p[-1]))
    return _RouteGuidance(ctl, par, new_route, lags, controller)


def _synchronise(
    recent: Track, seq: np.ndarray, par_legs_start: tuple[np.ndarray, ...], w: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray]:
    """Synchronise the guidance with the flight; return its state, the RMS error of its bank [rad], and the banks."""
    n = len(recent)
    missing = np.full(n, np.nan)
    air = recent.v - [*w, 0.0]
    psi = np.arctan2(air[:, 1], air[:, 0])
    banks = _banks(recent, air)
    euler = np.column_stack([banks, 0.0 * psi, psi])
    triple, quad = np.full((n, 3), np.nan), np.full((n, 4), np.nan)
    rows = (recent.t - recent.t[0], recent.p, recent.v, euler, triple, missing, banks, missing, quad, seq)
    ctl, rms = replay_controller(*par_legs_start, *(np.ascontiguousarray(row) for row in rows), NO_MEMORY)  # type: ignore[call-arg]
    return ctl, float(rms), banks


def _banks(recent: Track, air: np.ndarray) -> np.ndarray:
    """Return the bank at each row: reported, else from the turn rate of the track [rad]."""
    reported = np.isfinite(recent.euler[:, 0])
    return recent.euler[:, 0] if reported.all() else np.where(reported, recent.euler[:, 0], _turn_banks(air))


def _turn_banks(air: np.ndarray) -> np.ndarray:
    """Return the bank of a coordinated turn at each row, from the air velocity, (n,) [rad]."""
    course = np.unwrap(np.arctan2(air[:, 1], air[:, 0]))
    rate = np.gradient(course, STEP)
    smooth = np.convolve(np.pad(rate, 5, mode="edge"), np.ones(11) / 11, mode="valid")
    return np.arctan(np.clip(smooth * np.linalg.norm(air[:, :2], axis=1) / G, -1.5, 1.5))


def _bank_error(flight: Track, w: np.ndarray) -> float:
    """Return true minus reported bank: the mean difference to the turn rate lately; 0 if unknown [rad]."""
    recent = flight.part(max(len(flight) - int(_BIAS_S / STEP), 0), len(flight))
    error = _turn_banks(recent.v - [*w, 0.0]) - recent.euler[:, 0]
    valid = np.isfinite(error)
    return float(error[valid].mean()) if valid.sum() > int(MIN_TRACK_S / STEP) else 0.0


def _state(recent: Track, w: np.ndarray) -> np.ndarray:
    air = present_velocity(recent.p, recent.v, STEP, 5) - [*w, 0.0]
    phi = float(_banks(recent.part(max(len(recent) - 40, 0), len(recent)), recent.v[-40:] - [*w, 0.0])[-3:].mean())
    return np.array([*recent.p[-1], np.linalg.norm(air), phi, atan2(air[1], air[0]), -air[2]])


def _lag_parameters(
    recent: Track,
    leg: np.ndarray,
    par: np.ndarray,
    absent: tuple[str, ...],
    model_and_speed: tuple[KinematicModel, float],
) -> np.ndarray:
    """Return the parameters of the law: lags and recent speeds."""
    model, V = model_and_speed
    cruise_known = CRUISE not in absent
    commanded = leg[VA_C] if leg[VA_C] > 0 else par[P.VA_CRUISE] if cruise_known else 0.0
    speed_ratio = V / commanded if commanded > 0 and 0.7 < V / commanded < 1.5 else par[P.EAS2TAS]
    cruise = par[P.VA_CRUISE] * speed_ratio if cruise_known else V
    out = np.zeros(law.N_PAR)
    out[law.TAU_PHI], out[law.TAU_V], out[law.TAU_H], out[law.TAU_CLIMB] = model.tau_phi, 4.0, 4.0, 1.5
    out[law.CRUISE], out[law.TAS_RATIO] = (V if not 0.7 < V / cruise < 1.5 else cruise), speed_ratio
    rise = -recent.v[:, 2]
    out[law.CLIMB] = max(float(np.quantile(rise, 0.98)), min(par[P.CLIMB_MAX], 2.5))
    out[law.SINK] = max(float(np.quantile(-rise, 0.98)), min(par[P.SINK_MAX], 2.0))
    return out


def fit_model(track: Track, seq: np.ndarray, config: KinematicConfig, model: KinematicModel) -> KinematicModel:
    """Fit period and lag: minimise the mean rollout error from several starts over the last minute."""
    run_rows = int(_RUN_S / STEP)
    last_row = len(track) - 1 - run_rows
    rows = range(
        last_row, max(len(track) - int(_COMPARE_S / STEP), int(MIN_TRACK_S / STEP)), -int(_START_INTERVAL_S / STEP)
    )
    starts = [k for k in rows if track.t[k] > config.changed_t + MIN_TRACK_S and track.ok[k - 40 : k + run_rows].all()]
    if len(starts) < 3:
        return model

    def error_of(candidate: KinematicModel) -> float:
        errors = [_rollout_error(track, k, seq, config, candidate) for k in starts]
        valid = [x for x in errors if x is not None]
        return float(np.mean(valid)) if len(valid) >= 2 else np.inf

    _, absent = arduplane.parameters(config.params)
    unknown = "NAVL1_PERIOD" in absent and "NAVL1_PERIOD" not in config.identified
    model = model if unknown else replace(model, period=0.0)
    for name, trials in (("period", _PERIOD_VALUES if unknown else ()), ("tau_phi", _LAG_VALUES)):
        options = [replace(model, **{name: value}) for value in dict.fromkeys((getattr(model, name), *trials))]
        model = min(options, key=error_of)
    error = error_of(model)
    return replace(model, mean_error=error, n_starts=len(starts)) if np.isfinite(error) else model


def _rollout_error(
    track: Track, k: int, seq: np.ndarray, config: KinematicConfig, model: KinematicModel
) -> float | None:
    ahead = np.arange(0.0, _RUN_S + 0.5)
    first = max(k - int(30 / STEP), 0)
    rollout = fly(track.part(first, k + 1), seq[first : k + 1], config, model, ahead)
    if rollout.path is None:
        return None
    actual = track.p[k + np.rint(ahead / STEP).astype(int)]
    return float(np.linalg.norm(rollout.path - actual, axis=1).mean())


def describe(model: KinematicModel) -> str:
    """Describe the model and its error."""
    if not model.n_starts:
        return "route flown by guidance and lags, not yet compared with flight"
    period = f"L1 period {model.period:.0f} s, " if model.period else ""
    return f"route flown by guidance and lags: {period}mean error {model.mean_error:.0f} m over {_RUN_S:.0f} s"
