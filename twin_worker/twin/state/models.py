"""Identified state of one aircraft: newest identification, models that may predict, checkpoints of them."""

from collections import deque
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass
from datetime import UTC, datetime

import msgspec
import numpy as np

from fleet.contract import Model, Outcome, SiblingType, TwinState, Verdict
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.identification.fixed_wing.point_mass_model import PointMassModel
from twin_worker.identification.multirotor.rotor_model import RotorModel
from twin_worker.prediction.kinematic import KinematicModel
from twin_worker.prediction.multirotor.rollout import MultirotorModel
from twin_worker.twin.state.budget import Timer
from twin_worker.twin.state.rotor_models import RotorModels
from twin_worker.validation.forecast_shrinkage import Shrinkage

CHECKPOINT_PERIOD_S = 10.0  # between checkpoints [s]
MAX_CHECKPOINTS = 15  # number of checkpoints kept; covers the telemetry history


@dataclass(frozen=True)
class Checkpoint:
    """State of one twin at one instant.

    Attributes:
        t: time [s since 1970]
        wind_filter: copy of the wind filter
        derivatives_model: verified stability-and-control model; None before the first
        point_mass: verified point-mass model; None before the first
    """

    t: float
    wind_filter: WindFilter
    derivatives_model: DerivativesModel | None
    point_mass: PointMassModel | None


@dataclass(frozen=True)
class ActiveEffects:
    """Fault effects added to the active model: their names, and the onset [s since 1970]."""

    names: str
    onset: float

    def __str__(self) -> str:
        return f"{self.names} since {datetime.fromtimestamp(self.onset, UTC):%H:%M:%S} UTC"


def create_checkpoint(
    t: float, wind_filter: WindFilter, models: tuple[Plant | None, ...], point_mass: PointMassModel | None
) -> Checkpoint:
    """Create a checkpoint with the first stability-and-control model among `models`."""
    derivatives_model = next((model for model in models if isinstance(model, DerivativesModel)), None)
    return Checkpoint(t, deepcopy(wind_filter), derivatives_model, point_mass)


def latest_before(checkpoints: Iterable[Checkpoint], t: float) -> Checkpoint | None:
    """Return the newest checkpoint before time t [s since 1970]; None if there is none."""
    return max((checkpoint for checkpoint in checkpoints if checkpoint.t < t), key=lambda one: one.t, default=None)


_NEWEST_WEIGHT = 0.3  # of the newest rollout in a model's error [-]


class Identification(msgspec.Struct):
    """The newest identification.

    Attributes:
        verdict: on the newest model
        warm_start: newest model, verified or not: the next search begins there
        prior_model: newest verified model: the prior of the next
        siblings: what aircraft of its type share; None: not known
        message: newest model published
        shrinkage: weights of model and persistence, by look-ahead
        data_from: telemetry before is not used [s since 1970]
        tries: identifications since the last conclusive verdict
        moments: mean, and sum of squares about it, of the states and inputs of the last window, (2, k); None: none
        information: what telemetry since then adds to these sums, the largest share of a state or input [-]
        timer: of identifications
        fresh_start: of searches that do not begin at `warm_start`
        published: of messages that repeat a verdict
    """

    verdict: Verdict
    warm_start: DerivativesModel | None = None
    prior_model: DerivativesModel | None = None
    siblings: SiblingType | None = None
    message: Model | None = None
    shrinkage: Shrinkage = msgspec.field(default_factory=Shrinkage)
    data_from: float = -np.inf
    tries: int = 0
    moments: np.ndarray | None = None
    information: float = np.inf
    timer: Timer = msgspec.field(default_factory=Timer)
    fresh_start: Timer = msgspec.field(default_factory=Timer)
    published: Timer = msgspec.field(default_factory=Timer)

    def conclude(self, verdict: Verdict) -> None:
        """Store the verdict on the newest model, or why there is none."""
        self.verdict = verdict
        if verdict.outcome.is_accepted or verdict.outcome in (Outcome.WORSE_THAN_LAST, Outcome.NOT_IDENTIFIABLE):
            self.tries = 0

    def count_try(self) -> None:
        """Count a try that begins elsewhere than the one before."""
        self.tries += 1

    def store(self, model: DerivativesModel) -> None:
        """Store the newest model."""
        self.warm_start = model

    def used(self, data: np.ndarray) -> None:
        """Store the moments of the states and inputs, (n, k), of the window used."""
        mean = data.mean(axis=0)
        self.moments, self.information = np.array([mean, ((data - mean) ** 2).sum(axis=0)]), 0.0

    def expect_news(self) -> None:
        """Make an identification due after its period."""
        self.information = np.inf

    def add_data(self, data: np.ndarray) -> None:
        """Compare telemetry since the last window, (n, k), with that window."""
        if self.moments is not None:
            mean, squares = self.moments
            self.information = float((((data - mean) ** 2).sum(axis=0) / np.maximum(squares, 1e-12)).max())

    def set_siblings(self, siblings: SiblingType | None) -> None:
        """Store what aircraft of its type share, for the first models; it must be valid, see `type_defect`."""
        self.siblings = siblings

    def store_prior(self, model: DerivativesModel | None) -> None:
        """Store the newest verified model."""
        self.prior_model = model

    def publish(self, message: Model, t: float) -> None:
        """Store the message of `t` [s since 1970]."""
        self.message = message
        self.published.restart(t)

    def restore(self, message: Model, verdict: Verdict, model: DerivativesModel | None = None) -> None:
        """Store a verified model that another worker published; None: a rotor model, which is stored elsewhere."""
        self.message, self.verdict, self.prior_model = message, verdict, model

    def restart(self, data_from: float, prior_model: DerivativesModel | None) -> None:
        """Use telemetry from `data_from` on only [s since 1970], with another prior."""
        self.data_from, self.prior_model, self.warm_start = data_from, prior_model, None
        self.moments, self.information = None, np.inf
        self.published.expire()

    def reset_clock(self) -> None:
        """Forget models and times: the new time may be earlier than the old one."""
        self.restart(-np.inf, None)
        self.timer.expire()

    def shift_clock(self, step: float) -> None:
        """Date the data `step` later [s]."""
        self.data_from += step


class VerifiedModel(msgspec.Struct):
    """A plausible or verified model, and its error in closed loop over the newest held-out data.

    Attributes:
        plant: the model
        verdict: the one that verified it
        t: end of the data it was verified on [s since 1970]
        closed_loop_error: mean on the route, smoothed over the identifications [m]; nan before any route, inf where it
            diverged
    """

    plant: Plant
    verdict: Verdict
    t: float
    closed_loop_error: float

    def update_error(self, error: float) -> None:
        """Include the error of one more rollout [m]; nan, where there was no route, changes nothing."""
        if not np.isnan(error):
            before, w = self.closed_loop_error, _NEWEST_WEIGHT
            self.closed_loop_error = error if np.isnan(before) else (1 - w) * before + w * error

    def sort_key(self) -> tuple[bool, float]:
        """Return the key that sorts by error; models that never flew a route come last, the newest of them first."""
        error = self.closed_loop_error
        return (True, -self.t) if np.isnan(error) else (False, error)


def _smoothed(before: float, error: float) -> float:
    if not np.isfinite(error):
        return before
    return before + _NEWEST_WEIGHT * (error - before) if np.isfinite(before) else error


class ModelBank(msgspec.Struct):
    """Every model that may predict.

    Attributes:
        active_model: the identified model that predicts; None before any was verified
        active_verdict: the one that verified it
        verified_models: candidates, best first
        scored: timer of rollouts of the candidates
        point_mass: verified point-mass model; None before any
        point_mass_warm_start: newest, verified or not
        point_mass_holdout_error: end error over held-out flight, of the path length [-]
        active_holdout_error: the same of the active model, where the point mass was above the limit [-]
        newest_holdout_errors: of the newest rollouts of the point mass and of the active model [-]
        kinematic_timer: of the fit of the kinematic models
        point_mass_timer: of its identification
        holdout_timer: of rollouts over held-out flight
        active_effect: missing physics that was added to the models
        checkpoints: of the last minutes
        multirotor, kinematic: models that need no identification
        rotors: identified models of a multirotor
    """

    active_model: Plant | None = None
    active_verdict: Verdict | None = None
    verified_models: list[VerifiedModel] = msgspec.field(default_factory=list)
    scored: Timer = msgspec.field(default_factory=Timer)
    point_mass: PointMassModel | None = None
    point_mass_warm_start: PointMassModel | None = None
    point_mass_holdout_error: float = float("nan")
    newest_holdout_errors: tuple[float, float] = (float("nan"), float("nan"))
    active_holdout_error: float = float("nan")
    kinematic_timer: Timer = msgspec.field(default_factory=Timer)
    point_mass_timer: Timer = msgspec.field(default_factory=Timer)
    holdout_timer: Timer = msgspec.field(default_factory=Timer)
    active_effect: ActiveEffects | None = None
    checkpoints: deque[Checkpoint] = msgspec.field(default_factory=lambda: deque(maxlen=MAX_CHECKPOINTS))
    multirotor: MultirotorModel = msgspec.field(default_factory=MultirotorModel)
    kinematic: KinematicModel = msgspec.field(default_factory=KinematicModel)
    rotors: RotorModels = msgspec.field(default_factory=RotorModels)

    @property
    def state(self) -> TwinState:
        """Return the state of a twin that has these models and no path: waiting without an active model."""
        if not self.is_identified:
            return TwinState.WAITING
        plausible = self.active_verdict is not None and self.active_verdict.outcome is Outcome.PLAUSIBLE
        return TwinState.PLAUSIBLE if plausible else TwinState.VERIFIED

    @property
    def is_identified(self) -> bool:
        """Return whether an identified model of its dynamics was accepted."""
        return self.active_model is not None or self.rotors.active is not None

    @property
    def is_compared(self) -> bool:
        """Return whether a model of this aircraft was compared with its flight."""
        return self.has_model or self.multirotor.n_comparisons > 0

    @property
    def has_model(self) -> bool:
        """Return whether an identified model or a point mass can predict."""
        return self.active_model is not None or self.point_mass is not None

    def add(self, candidate: VerifiedModel) -> None:
        """Add a candidate."""
        self.verified_models.append(candidate)

    def select(self, most: int) -> VerifiedModel | None:
        """Sort the candidates by error, keep `most` of those that did not diverge, and activate the best."""
        finite = [one for one in self.verified_models if not np.isinf(one.closed_loop_error)]
        self.verified_models = sorted(finite, key=VerifiedModel.sort_key)[:most]
        if not self.verified_models:
            return None
        best = self.verified_models[0]
        self.active_model, self.active_verdict = best.plant, best.verdict
        return best

    def update_verdict(self, verdict: Verdict) -> None:
        """Store a newer verdict on the active model, the best of the candidates."""
        self.active_verdict = verdict
        if self.verified_models:
            self.verified_models[0].verdict = verdict

    def activate(self, candidate: VerifiedModel) -> None:
        """Make a verified model the only candidate and the active one."""
        self.active_model, self.active_verdict = candidate.plant, candidate.verdict
        self.verified_models = [candidate]

    def adopt(self, other: "ModelBank", effect: ActiveEffects) -> None:
        """Use the fixed-wing models of `other`, which contain `effect`."""
        self.active_model, self.active_verdict = other.active_model, other.active_verdict
        self.verified_models = other.verified_models
        self.point_mass, self.point_mass_warm_start = other.point_mass, other.point_mass_warm_start
        self.active_effect = effect

    def update_holdout_errors(self, point_mass: float, active: float) -> None:
        """Include the errors of one more rollout of the point mass and of the active model [-]; nan changes nothing."""
        self.newest_holdout_errors = point_mass, active
        self.point_mass_holdout_error = _smoothed(self.point_mass_holdout_error, point_mass)
        self.active_holdout_error = _smoothed(self.active_holdout_error, active)

    def point_mass_is_better_than(self, limit: float) -> bool:
        """Return whether the hold-out error of the point mass, mean or newest, is below a limit or the active model's.

        The newest counts alone too: a bad first rollout, in a manoeuvre, stays in the mean for a minute.
        """
        pairs = ((self.point_mass_holdout_error, self.active_holdout_error), self.newest_holdout_errors)
        return any(error < max(limit, np.nan_to_num(active)) for error, active in pairs)

    @property
    def average_is_better(self) -> bool:
        """Return whether the mean of both models has a smaller error than the point mass; true where unknown.

        The mean of two independent errors, squares e1 and e2, is (e1 + e2) / 4: smaller than e1 where e2 < 3 e1.
        Source: Bates & Granger 1969, "The combination of forecasts".
        """
        return not self.active_holdout_error**2 > 3.0 * self.point_mass_holdout_error**2

    def store_point_mass(self, model: PointMassModel, *, verified: bool) -> None:
        """Store the newest point-mass model; it predicts where it is verified."""
        self.point_mass_warm_start = model
        self.point_mass = model if verified else None

    def store_multirotor(self, model: MultirotorModel) -> None:
        """Store the newest multirotor model."""
        self.multirotor = model

    def activate_rotors(self, model: RotorModel, verdict: Verdict) -> None:
        """Make an accepted rotor model the active one."""
        self.rotors.activate(model)
        self.active_verdict = verdict

    def store_kinematic(self, model: KinematicModel) -> None:
        """Store the newest kinematic model."""
        self.kinematic = model

    def set_effect(self, effect: ActiveEffects | None) -> None:
        """Store which missing physics is in the models."""
        self.active_effect = effect

    def checkpoint(self, t: float, wind: WindFilter, prior_model: DerivativesModel | None) -> None:
        """Store a checkpoint of time `t` [s since 1970], where the last one is older than the period."""
        last = self.checkpoints[-1].t if self.checkpoints else -np.inf
        if np.isfinite(t) and not last <= t < last + CHECKPOINT_PERIOD_S:
            self.checkpoints.append(create_checkpoint(t, wind, (prior_model, self.active_model), self.point_mass))

    def reset_clock(self) -> None:
        """Forget checkpoints and times: the new time may be earlier than the old one."""
        for timer in (self.scored, self.kinematic_timer, self.point_mass_timer, self.holdout_timer):
            timer.expire()
        self.active_effect = None
        self.checkpoints.clear()

    def shift_clock(self, step: float) -> None:
        """Date the candidates `step` later [s]; checkpoints of the old time are useless."""
        self.verified_models = [msgspec.structs.replace(one, t=one.t + step) for one in self.verified_models]
        self.checkpoints.clear()
