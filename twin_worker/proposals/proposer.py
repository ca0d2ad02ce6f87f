"""Proposals against the alerts of the aircraft of one worker: computed, renewed while the alert lasts, withdrawn."""

import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from math import inf

import msgspec

from fleet.bus.codec import digest_of
from fleet.contract import Alert, AlertKey, AlertKind, Execution, ExecutionState, Option, Proposal, ProposedPath
from fleet.frames import Origin
from twin_worker.alerts.conflict_probability import Separation
from twin_worker.alerts.gaussian_forecast import GaussianForecast
from twin_worker.alerts.hysteresis import RULES
from twin_worker.proposals.assessment import Comparison
from twin_worker.proposals.candidates import Candidate, Plan, candidates
from twin_worker.proposals.experiment import LIMITS, PlanExperiment, deficit, present, run, run_change
from twin_worker.proposals.options import to_option, to_path
from twin_worker.proposals.resolution import Airspace, Problem, Solution, pareto, solve
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.kinematic_prediction import is_hovering

PROPOSED = (AlertKind.CONFLICT, *LIMITS)
"""Alerts that are answered with a proposal."""
RENEW_S = 5.0
"""Time after which a proposal is renewed while its alert lasts [s]."""
_RENEW_WITHOUT_MODEL_S = 2.0  # the same while an aircraft is predicted without a model, which may come at any time [s]
VALID_S = 15.0
"""Time for which a version of a proposal may be approved; the upload takes the rest of `DECISION_S` [s]."""
_EARLY_S = 2.0  # the earliest start of a change: approved at once [s]
_EXECUTION_S, _AFTER_EXECUTION_S = 60.0, 10.0  # without proposals during an execution, and after it [s]
_MAX_OFFERED = 1_000  # options whose execution is recognised
_MAX_CHANGED = 3  # aircraft of a cluster whose plans may be changed: each costs about 20 experiments
_EVENTS = {
    AlertKind.CONFLICT: "a conflict",
    AlertKind.GROUND: "a descent below the minimum height",
    AlertKind.GEOFENCE: "a geofence breach",
    AlertKind.NOT_ACHIEVABLE: "a leg that is not achievable",
    AlertKind.BATTERY: "an empty battery",
}


@dataclass(frozen=True)
class AvoidedEvent:
    """What a proposal avoids.

    Attributes:
        uav: aircraft of the alert
        kind: of the alert
        other: the other aircraft of a conflict, -1 none
        place: where it happens; None: no single position
        requested: by a person, without an alert
    """

    uav: int
    kind: AlertKind
    other: int = -1
    place: Origin | None = None
    requested: bool = False

    @classmethod
    def of(cls, alert: Alert) -> "AvoidedEvent":
        """Return the event of an alert."""
        place = None
        if alert.lat is not None and alert.lon is not None and alert.alt is not None:
            place = Origin(alert.lat, alert.lon, alert.alt)
        return cls(alert.uav, alert.kind, alert.other, place)

    @property
    def text(self) -> str:
        """Describe the event."""
        return _EVENTS[self.kind] + (f" with uav-{self.other}" if self.other >= 0 else "")


@dataclass(frozen=True)
class Current:
    """A published proposal, and the changes that its options consist of; `has_models`: of all aircraft concerned."""

    proposal: Proposal
    choices: tuple[tuple[Candidate, ...], ...]
    has_models: bool = True


@dataclass
class Proposer:
    """Proposals of the aircraft of one worker. Uses data time only.

    Attributes:
        separation: separation minima
        copy_of: returns a copy of the twin of an aircraft; None: another worker owns it
        forecasts: returns the recent forecasts of all aircraft at a data time
    """

    separation: Separation
    copy_of: Callable[[int], Twin | None]
    forecasts: Callable[[float], list[GaussianForecast]]

    def __post_init__(self) -> None:
        self._current: dict[tuple[int, AlertKey], Current] = {}
        self._computed_t: dict[tuple[int, AlertKey], float] = {}  # data time of the last attempt [s since 1970]
        self._renew_s: dict[tuple[int, AlertKey], float] = {}  # until the next attempt [s]
        self._offered: OrderedDict[tuple[str, str], Option] = OrderedDict()  # by id of the proposal and digest
        self._executing: dict[int, float] = {}  # data time until which a change is executed, by UAV [s since 1970]

    def current(self, uav: int) -> list[Proposal]:
        """Return the proposals of one aircraft that are in force."""
        return [one.proposal for (owner, _), one in tuple(self._current.items()) if owner == uav]

    def discard(self, uav: int) -> None:
        """Forget the proposals of an aircraft that is no longer owned."""
        for stored in (self._current, self._computed_t, self._renew_s):
            for key in [key for key in tuple(stored) if key[0] == uav]:
                stored.pop(key, None)  # type: ignore[attr-defined]

    def withdraw(self, uav: int, active: Iterable[Alert], now: float) -> list[Proposal]:
        """Withdraw the proposals of one aircraft whose alert was cleared, at data time `now` [s since 1970]."""
        raised, withdrawn = {alert.about for alert in active}, []
        for key in [key for key in self._computed_t if key[0] == uav and key[1] not in raised]:
            del self._computed_t[key]
            self._renew_s.pop(key, None)
        for key in [key for key in self._current if key[0] == uav and key[1] not in raised]:
            before = self._current.pop(key).proposal
            withdrawn.append(_without_options(before, now, "no longer predicted: the alert was cleared"))
        return withdrawn

    def due(self, alert: Alert, now: float) -> bool:
        """Return whether the proposal against an active alert is to be computed at data time `now` [s since 1970]."""
        if max(self._executing.get(uav, -inf) for uav in (alert.uav, alert.other)) > now:
            return False
        renew_s = self._renew_s.get((alert.uav, alert.about), RENEW_S)
        return alert.kind in PROPOSED and not 0.0 <= now - self.computed_t(alert) < renew_s

    def computed_t(self, alert: Alert) -> float:
        """Return when the proposal against an alert was last computed [s since 1970]; -inf: never."""
        return self._computed_t.get((alert.uav, alert.about), -inf)

    def update(self, alert: Alert, now: float) -> Proposal | None:
        """Compute or renew the proposal against an active alert; None if there is no twin, or again no option.

        A proposal keeps its id while its alert lasts and nothing is executed. Options that still avoid the event are
        retained; new ones are computed when none does.
        """
        key = (alert.uav, alert.about)
        previous, self._computed_t[key] = self._current.get(key), now
        computed = self.compute(AvoidedEvent.of(alert), now, () if previous is None else previous.choices)
        if computed is None:
            return None
        self._renew_s[key] = RENEW_S if computed.has_models else _RENEW_WITHOUT_MODEL_S
        if previous is not None:
            computed = replace(computed, proposal=msgspec.structs.replace(computed.proposal, id=previous.proposal.id))
        self._current[key] = computed
        for option in computed.proposal.options:
            self._offered[computed.proposal.id, digest_of(option)] = option
        while len(self._offered) > _MAX_OFFERED:
            self._offered.popitem(last=False)
        is_news = bool(computed.choices) or previous is None or bool(previous.choices)
        return computed.proposal if is_news else None

    def on_execution(self, execution: Execution, now: float) -> bool:
        """Note the state of an execution at data time `now` [s since 1970]; return whether its paths are due.

        While a proposal is executed, its aircraft get no other one; afterwards a proposal has another id.
        """
        option = self._offered.get((execution.proposal, execution.digest))
        if option is None or execution.undo or execution.dry_run:
            return False
        uavs = {execution.uav, *(change.uav for change in option.changes)}
        is_done = execution.state is ExecutionState.ACCEPTED and execution.follows is None  # later ones compare
        if execution.state in (ExecutionState.APPROVED, ExecutionState.SENDING) or is_done:
            until = now + (_AFTER_EXECUTION_S if is_done else _EXECUTION_S)
            self._executing.update(dict.fromkeys(uavs, until))
            for key in [key for key, one in self._current.items() if one.proposal.id == execution.proposal]:
                del self._current[key]
        elif execution.state is ExecutionState.FAILED:
            for uav in uavs:
                self._executing.pop(uav, None)
        return is_done

    def executed(self, execution: Execution) -> Proposal | None:
        """Return the proposal with the paths of its executed option from now on; None where none is predicted."""
        option = self._offered.get((execution.proposal, execution.digest))
        if option is None:
            return None
        experiments: list[PlanExperiment] = []
        for change in option.changes:
            plan, _ = self._present(change.uav)
            experiment = None if plan is None else run_change(plan, None, change, after_s=0.0)
            if experiment is None:
                return None
            experiments.append(experiment)
        t = experiments[0].prediction.t
        paths: tuple[ProposedPath, ...] = tuple(to_path(experiment, t) for experiment in experiments)
        return Proposal(
            uav=execution.uav,
            t=t,
            id=execution.proposal,
            options=(msgspec.structs.replace(option, paths=paths),),
            valid_until=t,
            sentence=f"uav-{execution.uav}: paths of the executed option from its execution on",
        )

    def on_request(self, uav: int, now: float) -> Proposal | None:
        """Compute a proposal against the most probable event of an aircraft; None without its twin."""
        plan, experiment = self._present(uav)
        if plan is None:
            return None
        t = plan.twin.telemetry.history.newest if experiment is None else experiment.prediction.t
        if experiment is None:
            return _empty(uav, t, "no route is predicted: no change of plan can be tried")
        airspace = self._airspace(now)
        airspace.set_present(experiment)
        events = [
            (p, AvoidedEvent(uav, AlertKind.CONFLICT, other)) for other, p in airspace.present_conflicts(uav).items()
        ]
        events += [(p, AvoidedEvent(uav, kind)) for kind, p in experiment.hazards.items()]
        likely = [(p, event) for p, event in events if p >= RULES[event.kind].raise_at]
        if not likely:
            return _empty(uav, t, "nothing is predicted that a change of plan would avoid")
        _, event = max(likely, key=lambda one: one[0])
        computed = self.compute(replace(event, requested=True), now)
        return None if computed is None else computed.proposal

    def compute(
        self, event: AvoidedEvent, now: float, previous: tuple[tuple[Candidate, ...], ...] = ()
    ) -> Current | None:
        """Compute the options that avoid an event; None without the twin of its aircraft.

        Args:
            event: what is avoided
            now: data time [s since 1970]
            previous: changes of each option so far, which are kept where they still avoid the event
        """
        problem, plans = self._problem(event, now)
        if problem is None or event.uav not in plans:
            return self._no_plan(event, now)
        t = problem.present[event.uav].prediction.t
        probability = problem.probability()
        if probability < RULES[event.kind].clear_below:
            return Current(_proposal(event, t, (), probability, "not predicted with the present plan"), ())
        retained = _retained(problem, plans, previous)
        experiments: dict[int, list[PlanExperiment]] = {}

        def experiments_of(uav: int) -> list[PlanExperiment]:
            if uav not in experiments:
                short = deficit(plans[uav], problem.present[uav], event.kind)
                place = event.place if uav == event.uav else None
                vertical = self.separation.vertical
                experiments[uav] = run(plans[uav], candidates(plans[uav], event.kind, vertical, place, short))
            return experiments[uav]

        chosen = retained or _timely(problem, plans, solve(problem, experiments_of))
        options = tuple(to_option(problem, solution, advantage, plans, t) for solution, advantage in chosen)
        choices = tuple(_choice(solution) for solution, _ in chosen)
        text = f"{_count(len(options))} it" if options else "no change that was tried avoids it"
        if without := [uav for uav in plans if not _has_model(plans[uav].twin)]:
            text += f"; uav-{without[0]} has no model yet and is predicted from its route alone"
        proposal = _proposal(event, t, options, probability, text)
        changed = sorted({change.uav for option in options for change in option.changes})
        paths = tuple(to_path(problem.present[uav], t) for uav in changed)
        return Current(msgspec.structs.replace(proposal, present=paths), choices, not without)

    # --- inputs ------------------------------------------------------------------------------------------------------

    def _present(self, uav: int) -> tuple[Plan | None, PlanExperiment | None]:
        """Return the present plan of an aircraft and its prediction."""
        twin = self.copy_of(uav)
        if twin is None or twin.telemetry.origin is None or twin.telemetry.link_lost:
            return None, None
        experiment = present(twin)
        latest = experiment.prediction if experiment is not None else twin.prediction.latest
        return (None, None) if latest is None else (Plan.of(twin, latest), experiment)

    def _airspace(self, now: float) -> Airspace:
        return Airspace({one.prediction.uav: one for one in self.forecasts(now)}, now, self.separation)

    def _problem(self, event: AvoidedEvent, now: float) -> tuple[Problem | None, dict[int, Plan]]:
        """Return the problem and the plans that can be changed: the aircraft of the event first."""
        airspace, plans = self._airspace(now), dict[int, Plan]()
        present_plans: dict[int, PlanExperiment] = {}
        cluster = {event.uav} if event.other < 0 else {event.uav, event.other}

        def add(uav: int) -> None:
            plan, experiment = self._present(uav)
            if plan is not None and experiment is not None:
                plans[uav], present_plans[uav] = plan, experiment
                airspace.set_present(experiment)

        for uav in (event.uav, event.other):
            if uav >= 0:
                add(uav)
        if event.other >= 0:
            cluster = airspace.cluster((event.uav, event.other))
            for uav in sorted(cluster - {event.uav, event.other})[: _MAX_CHANGED - 2]:
                add(uav)
        if event.uav not in present_plans or not cluster <= airspace.forecasts.keys():
            return None, plans
        comparisons = {
            uav: Comparison(
                one.prediction, plans[uav].twin.environment.wind.wind, plans[uav].twin.vehicle_class.has_wings
            )
            for uav, one in present_plans.items()
        }
        problem = Problem(event.kind, event.uav, event.other, airspace, present_plans, comparisons, cluster)
        return problem, plans

    def _no_plan(self, event: AvoidedEvent, now: float) -> Current | None:
        """Return a proposal without options for an aircraft that is owned but follows no predicted route."""
        twin = self.copy_of(event.uav)
        if twin is None:
            return None
        reason = "link lost: no change can be sent" if twin.telemetry.link_lost else "no route is predicted"
        return Current(_proposal(event, now, (), None, reason), ())


def _retained(
    problem: Problem, plans: dict[int, Plan], previous: tuple[tuple[Candidate, ...], ...]
) -> list[tuple[Solution, str]]:
    """Return the options so far that still avoid the event with the same changes."""
    retained: list[tuple[Solution, str]] = []
    for choice in previous:
        repeated = tuple(one for c in choice if c.uav in plans for one in run(plans[c.uav], (c,)))
        if len(repeated) < len(choice) or not all(problem.is_admissible(one) for one in repeated):
            continue
        remaining = problem.conflicts_after(repeated)
        solution = None if remaining is None else problem.solution(repeated, remaining)
        if solution is not None:
            retained.append((solution, ""))
    ranked = {id(solution): advantage for solution, advantage in pareto([solution for solution, _ in retained])}
    return [(solution, ranked.get(id(solution), "")) for solution, _ in retained]


def _has_model(twin: Twin) -> bool:
    """Return whether a twin predicts with a model of its aircraft; the model of rotors is kinematic."""
    return is_hovering(twin) or twin.models.has_model


def _timely(problem: Problem, plans: dict[int, Plan], solutions: list[Solution]) -> list[tuple[Solution, str]]:
    """Return the best solutions that avoid the event also when they begin at once."""
    timely: dict[int, bool] = {}
    while True:
        front = pareto([one for one in solutions if timely.get(id(one), True)])
        unchecked = [one for one, _ in front if id(one) not in timely]
        if not unchecked:
            return front
        timely.update({id(one): _avoids_early(problem, plans, one) for one in unchecked})


def _avoids_early(problem: Problem, plans: dict[int, Plan], solution: Solution) -> bool:
    early = []
    for experiment in solution.experiments:
        assert experiment.change is not None
        begun = run_change(plans[experiment.uav], experiment.candidate, experiment.change, after_s=_EARLY_S)
        if begun is None or not problem.is_admissible(begun):
            return False
        early.append(begun)
    remaining = problem.conflicts_after(tuple(early))
    return remaining is not None and problem.solution(tuple(early), remaining) is not None


def _choice(solution: Solution) -> tuple[Candidate, ...]:
    return tuple(one.candidate for one in solution.experiments if one.candidate is not None)


def _count(n: int) -> str:
    return "one option avoids" if n == 1 else f"{n} options avoid"


def _proposal(
    event: AvoidedEvent, t: float, options: tuple[Option, ...], probability: float | None, text: str
) -> Proposal:
    chance = "" if probability is None else f"{probability:.0%} chance of "
    return Proposal(
        uav=event.uav,
        t=t,
        id=secrets.token_hex(8),
        kind=None if event.requested else event.kind,
        other=event.other,
        options=options,
        probability=None if probability is None else round(probability, 3),
        valid_until=t + VALID_S if options else t,
        sentence=f"uav-{event.uav}: {chance}{event.text}; {text}",
    )


def _empty(uav: int, t: float, text: str) -> Proposal:
    return Proposal(uav=uav, t=t, id=secrets.token_hex(8), valid_until=t, sentence=f"uav-{uav}: {text}")


def _without_options(proposal: Proposal, t: float, text: str) -> Proposal:
    kind = _EVENTS[proposal.kind] if proposal.kind is not None else "the event"
    sentence = f"uav-{proposal.uav}: {kind} is {text}"
    return msgspec.structs.replace(proposal, t=t, options=(), valid_until=t, probability=None, sentence=sentence)
