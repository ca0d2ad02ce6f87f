"""Published state of one aircraft: predictions, their scores, and alerts."""

from collections import deque

import msgspec
import numpy as np

from fleet.contract import Event, Prediction, TwinState
from fleet.frames import Origin
from twin_worker.alerts.hysteresis import AlertState
from twin_worker.confidence.tube_and_horizon import ConfidenceTracker
from twin_worker.prediction.autopilot_parameters import ControllerTwin, RouteOverride
from twin_worker.prediction.method_selection import MethodSelector
from twin_worker.prediction.replay_window import ControllerMemory
from twin_worker.twin.state.budget import Timer
from twin_worker.twin.state.events import FlightEvent

_STATES = 4  # stored states of the controller
_MAX_STATE_AGE_S = 10.0  # oldest state that a controller continues from after its route changed [s]


class PredictionState(msgspec.Struct):
    """The newest prediction, and what the next one needs.

    Attributes:
        state: of the twin, as published
        latest: newest prediction, extrapolated or not
        last_rollout: newest prediction that is not extrapolated
        is_continued: another worker made that rollout, with the mission and parameters that it knew
        latest_event: what the next prediction reports
        selector: of the method, by past errors
        ensemble_spread: of the newest ensemble, along, cross, vertical, (k, 3) [m]
        deferred_ensemble_t: when an ensemble was due that was deferred for lack of CPU time [s since 1970]
        controller: controller twin of the newest prediction
        controller_states: time [s since 1970], law and state of the controller at the newest rollouts
        override: route or parameters that replace the reported ones in a what-if
        coasting_expired: without telemetry, the confidence horizon is over
        position_lost: telemetry arrives, but no positions
        predict_timer, renew_timer, ensemble_timer: of rollouts, extrapolations, ensembles
        controller_timer: of messages that repeat the controller
    """

    state: TwinState = TwinState.WAITING
    latest: Prediction | None = None
    last_rollout: Prediction | None = None
    is_continued: bool = False
    latest_event: FlightEvent | None = None
    selector: MethodSelector = msgspec.field(default_factory=MethodSelector)
    ensemble_spread: np.ndarray | None = None
    deferred_ensemble_t: float | None = None
    controller: ControllerTwin | None = None
    controller_states: deque[tuple[float, str, tuple[float, ...]]] = msgspec.field(
        default_factory=lambda: deque(maxlen=_STATES)
    )
    override: RouteOverride | None = None
    coasting_expired: bool = False
    position_lost: bool = False
    predict_timer: Timer = msgspec.field(default_factory=Timer)
    renew_timer: Timer = msgspec.field(default_factory=Timer)
    ensemble_timer: Timer = msgspec.field(default_factory=Timer)
    controller_timer: Timer = msgspec.field(default_factory=Timer)

    def set_state(self, state: TwinState) -> None:
        """Store the state to publish."""
        self.state = state

    def set_learning_state(self, state: TwinState) -> None:
        """Store the state of the identification, which is less than a prediction along a route without its model."""
        if self.state in (TwinState.WAITING, TwinState.IDENTIFYING):
            self.state = state

    def publish(self, prediction: Prediction) -> None:
        """Store a prediction."""
        self.latest = prediction

    def set_rollout(self, rollout: Prediction | None, *, is_continued: bool = False) -> None:
        """Store what is extrapolated until the next rollout; None: nothing."""
        self.last_rollout, self.is_continued = rollout, is_continued

    def restart_periods(self, now: float) -> None:
        """Start the periods of rollouts and extrapolations."""
        self.predict_timer.restart(now)
        self.renew_timer.restart(now)

    def expire(self) -> None:
        """Make a rollout and an ensemble due at once."""
        self.deferred_ensemble_t = None
        self.predict_timer.expire()
        self.ensemble_timer.expire()

    def invalidate(self, *, is_first: bool = False) -> None:
        """End the running prediction: mode, mission or parameters changed.

        Args:
            is_first: this twin had none before; the worker whose rollout is continued had it
        """
        if not (is_first and self.is_continued):
            self.set_rollout(None)
        self.expire()

    def add_event(self, event: Event, t: float, message: str) -> None:
        """Store an event, which the next prediction reports."""
        self.latest_event = FlightEvent(event, t if np.isfinite(t) else 0.0, message)

    def set_position_lost(self, lost: bool) -> None:
        """Store whether telemetry arrives without positions."""
        self.position_lost = lost

    def set_coasting_expired(self, expired: bool) -> None:
        """Store whether the confidence horizon without telemetry is over."""
        self.coasting_expired = expired

    def store_ensemble(self, spread: np.ndarray | None, t: float) -> None:
        """Store the spread of the ensemble of `t` [s since 1970]."""
        self.ensemble_spread = spread
        self.ensemble_timer.restart(t)

    def defer_ensemble(self, t: float | None) -> None:
        """Store when an ensemble was due that has to wait; None: none waits."""
        self.deferred_ensemble_t = t

    def store_controller_state(self, t: float, law: str, state: np.ndarray) -> None:
        """Store the synchronised state of the controller at `t` [s since 1970], as from `laws.remember`."""
        self.controller_states.append((t, law, tuple(state.tolist())))

    def controller_memory(self, t: float) -> ControllerMemory:
        """Return the newest state of the controller up to `t` [s since 1970]; empty if there is no recent one."""
        recent = [one for one in self.controller_states if 0.0 <= t - one[0] <= _MAX_STATE_AGE_S]
        return (recent[-1][1], recent[-1][2]) if recent else ("", ())

    def set_controller(self, controller: ControllerTwin, now: float) -> None:
        """Store the controller that is published at `now`."""
        self.controller = controller
        self.controller_timer.restart(now)

    def set_override(self, override: RouteOverride) -> None:
        """Store what a copy flies to answer a what-if."""
        self.override = override

    def forget_published(self) -> None:
        """Prepare a copy for the answer to a what-if: nothing counts as published."""
        self.latest, self.coasting_expired = None, False
        self.controller_timer.expire()


class ConfidenceState(msgspec.Struct):
    """Scores of past predictions.

    Attributes:
        tracker: of errors, regions and horizons
        timer: of scoring
    """

    tracker: ConfidenceTracker = msgspec.field(default_factory=ConfidenceTracker)
    timer: Timer = msgspec.field(default_factory=Timer)

    def reset_clock(self) -> None:
        """Make scoring due: the new time may be earlier than the old one."""
        self.timer.expire()


class AlertingState(msgspec.Struct):
    """Alerts of one aircraft.

    Attributes:
        alarms: raised alerts, with hysteresis
        feasibility_timer: of judging the mission
        turn_rate_only_since: since when predictions are a turn rate alone [s since 1970]; inf: they are not
        home_fallback: where the aircraft last stood disarmed
        max_height_m: above home since it was disarmed
    """

    alarms: AlertState = msgspec.field(default_factory=AlertState)
    feasibility_timer: Timer = msgspec.field(default_factory=Timer)
    turn_rate_only_since: float = np.inf
    home_fallback: Origin | None = None
    max_height_m: float = -np.inf

    def update_turn_rate(self, now: float, *, only: bool) -> None:
        """Record whether the prediction of `now` is a turn rate alone."""
        if not only or not now >= self.turn_rate_only_since:
            self.turn_rate_only_since = now

    def disarmed_at(self, place: Origin | None) -> None:
        """Record that the aircraft stands disarmed, and where if that is known."""
        self.max_height_m = -np.inf
        self.home_fallback = place or self.home_fallback

    def climbed_to(self, height_m: float) -> None:
        """Record a height above home [m]."""
        self.max_height_m = max(self.max_height_m, height_m)
