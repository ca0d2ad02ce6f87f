"""Search changes that avoid an event: of one aircraft, or jointly of several aircraft in a cluster of conflicts.

A cluster is all aircraft that are connected by predicted conflicts. A solution changes the plans of some of them such
that every conflict of the cluster falls below the probability at which its alert is cleared, and that no conflict,
ground or geofence event appears that the present plans do not have. Single changes are tried first. Where none is
enough, changes of further aircraft are added greedily: each time of the pair that is most probably in conflict, the
change that leaves the least probability of conflict in the cluster.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain

from fleet.contract import AlertKind
from twin_worker.alerts.conflict_probability import Separation
from twin_worker.alerts.gaussian_forecast import GaussianForecast
from twin_worker.alerts.hysteresis import RULES
from twin_worker.alerts.traffic import TrafficPicture
from twin_worker.proposals.assessment import Comparison, Cost
from twin_worker.proposals.candidates import INTERRUPTING, Kind
from twin_worker.proposals.experiment import LIMITS, PlanExperiment

Pair = frozenset[int]
_CONFLICT = RULES[AlertKind.CONFLICT]
_SEEDS = 4  # single changes from which joint solutions are built
_MAX_OPTIONS = 3


@dataclass(frozen=True)
class Solution:
    """Changed plans, and what is predicted with them.

    Attributes:
        experiments: one per changed aircraft
        probability: remaining probability of the event
        costs: of each change
    """

    experiments: tuple[PlanExperiment, ...]
    probability: float
    costs: tuple[Cost, ...]

    @property
    def cost(self) -> Cost:
        """Return the delay and excess energy summed over the aircraft, and the largest deviation."""
        energy = 1.0 + sum(cost.energy - 1.0 for cost in self.costs)
        return Cost(sum(cost.delay_s for cost in self.costs), energy, max(cost.deviation_m for cost in self.costs))

    @property
    def changed(self) -> frozenset[int]:
        """Return the aircraft whose plans change."""
        return frozenset(experiment.uav for experiment in self.experiments)

    @property
    def kinds(self) -> tuple[tuple[int, Kind], ...]:
        """Return aircraft and kind of each change, in the order of the ids."""
        candidates = [experiment.candidate for experiment in self.experiments]
        return tuple(sorted((one.uav, one.kind) for one in candidates if one is not None))


@dataclass
class Airspace:
    """Forecasts of all aircraft, and conflicts of their present plans.

    Attributes:
        forecasts: newest of each aircraft, by id
        now: data time [s since 1970]
        separation: separation minima
    """

    forecasts: dict[int, GaussianForecast]
    now: float
    separation: Separation
    _picture: TrafficPicture = field(init=False)
    _present: dict[int, dict[int, float]] = field(default_factory=dict)  # probability by aircraft and other

    def __post_init__(self) -> None:
        self._picture = TrafficPicture(len(self.forecasts) + 1)
        for forecast in self.forecasts.values():
            self._picture.place(forecast)

    def set_present(self, experiment: PlanExperiment) -> None:
        """Replace the forecast of an aircraft by a newer one of its present plan."""
        self.forecasts[experiment.uav] = experiment.forecast
        self._picture.place(experiment.forecast)
        self._present.clear()

    def present_conflicts(self, uav: int) -> dict[int, float]:
        """Return the probabilities of conflict of an aircraft with the others under the present plans."""
        if uav not in self._present:
            self._present[uav] = self._conflicts(uav)
        return self._present[uav]

    def conflicts(self, experiments: Iterable[PlanExperiment]) -> dict[Pair, float]:
        """Return the probabilities of conflict of the changed aircraft with each other and with all others."""
        changed = tuple(experiments)
        for experiment in changed:
            self._picture.place(experiment.forecast)
        probabilities = {
            frozenset((experiment.uav, other)): probability
            for experiment in changed
            for other, probability in self._conflicts(experiment.uav).items()
        }
        for experiment in changed:
            if experiment.uav in self.forecasts:
                self._picture.place(self.forecasts[experiment.uav])
        return probabilities

    def _conflicts(self, uav: int) -> dict[int, float]:
        return {one.other: one.probability for one in self._picture.encounters(uav, self.now, self.separation)}

    def cluster(self, pair: Iterable[int]) -> set[int]:
        """Return the aircraft connected to a pair by conflicts that are probable enough for an alert."""
        connected, waiting = set[int](), list(pair)
        while waiting:
            uav = waiting.pop()
            connected.add(uav)
            conflicts = self.present_conflicts(uav).items()
            waiting += [other for other, p in conflicts if p >= _CONFLICT.raise_at and other not in connected]
        return connected


@dataclass(frozen=True)
class Problem:
    """One event to avoid.

    Attributes:
        kind: of the alert
        uav, other: of the event; -1: no other aircraft
        airspace: all aircraft
        present: present plans of the aircraft that can be changed, by id
        comparisons: the same, to compare paths with
        cluster: aircraft connected by conflicts; the aircraft alone for other events
    """

    kind: AlertKind
    uav: int
    other: int
    airspace: Airspace
    present: dict[int, PlanExperiment]
    comparisons: dict[int, Comparison]
    cluster: set[int]

    def probability(self) -> float:
        """Return the probability of the event under the present plans."""
        if self.kind is AlertKind.CONFLICT:
            return self.airspace.present_conflicts(self.uav).get(self.other, 0.0)
        return self.present[self.uav].hazards.get(self.kind, 0.0)

    def is_admissible(self, experiment: PlanExperiment) -> bool:
        """Return whether a change avoids the event of the aircraft, and creates no ground or geofence event."""
        before = self.present[experiment.uav].hazards
        for kind in LIMITS:
            probability = experiment.hazards.get(kind, 0.0)
            is_avoided = kind is self.kind and experiment.uav == self.uav
            may_remain = not is_avoided and probability <= before.get(kind, 0.0)  # as with the present plan
            if probability >= RULES[kind].clear_below and not may_remain:
                return False
        return True

    def conflicts_after(self, experiments: tuple[PlanExperiment, ...]) -> dict[Pair, float] | None:
        """Return the conflicts of the cluster with some plans changed; None if they create a conflict."""
        after = self.airspace.conflicts(experiments)
        changed = {experiment.uav for experiment in experiments}
        remaining = {pair: p for pair, p in self._present_pairs().items() if not pair & changed}
        for pair, probability in after.items():
            if pair <= self.cluster and self.kind is AlertKind.CONFLICT:
                remaining[pair] = probability
            elif probability >= _CONFLICT.clear_below and probability > self._before(pair):
                return None
        return remaining

    def _present_pairs(self) -> dict[Pair, float]:
        """Return the conflicts within the cluster under the present plans."""
        if self.kind is not AlertKind.CONFLICT:
            return {}
        return {
            frozenset((uav, other)): p
            for uav in self.cluster
            for other, p in self.airspace.present_conflicts(uav).items()
            if other in self.cluster
        }

    def _before(self, pair: Pair) -> float:
        one, other = sorted(pair)
        return self.airspace.present_conflicts(one).get(other, 0.0)

    def solution(self, experiments: tuple[PlanExperiment, ...], remaining: dict[Pair, float]) -> Solution | None:
        """Return a solution if every conflict of the cluster is avoided."""
        worst = max(remaining.values(), default=0.0)
        if worst >= _CONFLICT.clear_below:
            return None
        if self.kind is not AlertKind.CONFLICT:
            worst = next(one.hazards.get(self.kind, 0.0) for one in experiments if one.uav == self.uav)
        costs = tuple(
            self.comparisons[one.uav].cost(
                one.prediction, interrupts=one.candidate is not None and one.candidate.kind in INTERRUPTING
            )
            for one in experiments
        )
        return Solution(experiments, worst, costs)


def solve(problem: Problem, experiments_of: Callable[[int], list[PlanExperiment]]) -> list[Solution]:
    """Return the solutions of single changes, and joint ones where several conflicts or no single change remain.

    Args:
        problem: the event
        experiments_of: predicts one aircraft under all its candidates
    """
    admissible = {
        uav: [experiment for experiment in experiments_of(uav) if problem.is_admissible(experiment)]
        for uav in problem.present
    }
    solutions: list[Solution] = []
    partial: list[tuple[float, tuple[PlanExperiment, ...], dict[Pair, float]]] = []
    for experiment in chain.from_iterable(admissible.values()):
        remaining = problem.conflicts_after((experiment,))
        if remaining is None:
            continue
        if (solution := problem.solution((experiment,), remaining)) is not None:
            solutions.append(solution)
        elif problem.kind is AlertKind.CONFLICT:
            partial.append((sum(remaining.values()), (experiment,), remaining))
    if all(_interrupts(solution) for solution in solutions):
        partial.sort(key=lambda one: (_is_interruption(one[1][0]), one[0]))
        for _, experiments, remaining in _distinct_seeds(partial):
            joint = _add_changes(problem, admissible, experiments, remaining)
            solutions += [] if joint is None else [joint]
    return solutions


def _interrupts(solution: Solution) -> bool:
    return any(_is_interruption(experiment) for experiment in solution.experiments)


def _lands(solution: Solution) -> bool:
    return any(kind is Kind.LAND for _, kind in solution.kinds)


def _is_interruption(experiment: PlanExperiment) -> bool:
    return experiment.candidate is not None and experiment.candidate.kind in INTERRUPTING


def _preference(option: tuple[float, PlanExperiment, dict[Pair, float]]) -> tuple[bool, bool, float]:
    """Return the order of additional changes: sufficient ones, those that continue the mission, the least conflict."""
    total, experiment, remaining = option
    insufficient = max(remaining.values(), default=0.0) >= _CONFLICT.clear_below
    return insufficient, _is_interruption(experiment), total


def _distinct_seeds(
    partial: list[tuple[float, tuple[PlanExperiment, ...], dict[Pair, float]]],
) -> Iterator[tuple[float, tuple[PlanExperiment, ...], dict[Pair, float]]]:
    """Yield the best partial solutions of different aircraft and kinds."""
    seen = set[tuple[int, Kind]]()
    for one in partial:
        candidate = one[1][0].candidate
        assert candidate is not None
        if (candidate.uav, candidate.kind) not in seen and len(seen) < _SEEDS:
            seen.add((candidate.uav, candidate.kind))
            yield one


def _add_changes(
    problem: Problem,
    admissible: dict[int, list[PlanExperiment]],
    experiments: tuple[PlanExperiment, ...],
    remaining: dict[Pair, float],
) -> Solution | None:
    """Add changes of further aircraft until no conflict of the cluster remains; None if that does not succeed."""
    while (solution := problem.solution(experiments, remaining)) is None:
        changed = {experiment.uav for experiment in experiments}
        worst = max(remaining, key=lambda pair: remaining[pair])
        options = []
        for experiment in chain.from_iterable(admissible.get(uav, []) for uav in sorted(worst - changed)):
            after = problem.conflicts_after((*experiments, experiment))
            if after is not None:
                options.append((sum(after.values()), experiment, after))
        if not options:
            return None
        total, best, after = min(options, key=_preference)
        if total >= sum(remaining.values()):
            return None
        experiments, remaining = (*experiments, best), after
    return solution


def pareto(solutions: list[Solution]) -> list[tuple[Solution, str]]:
    """Return at most three solutions that no other one surpasses, each with its advantage.

    Compared are delay, energy, deviation and remaining probability of changes of the same aircraft. Of each kind of
    change only the one with the smallest deviation is considered, and changes that interrupt the mission only where no
    other avoids the event; a landing only where no hold or return does.
    """
    solutions = (
        [one for one in solutions if not _interrupts(one)]
        or [one for one in solutions if not _lands(one)]
        or (solutions)
    )
    by_kind: dict[tuple[tuple[int, Kind], ...], Solution] = {}
    for solution in solutions:
        known = by_kind.get(solution.kinds)
        if known is None or solution.cost.deviation_m < known.cost.deviation_m:
            by_kind[solution.kinds] = solution
    front = [one for one in by_kind.values() if not any(_surpasses(other, one) for other in by_kind.values())]
    chosen: list[tuple[Solution, str]] = []
    advantages: tuple[tuple[str, Callable[[Solution], tuple[float, float]]], ...] = (
        ("least deviation", lambda one: (round(one.cost.deviation_m), one.cost.delay_s)),
        ("least delay", lambda one: (round(max(one.cost.delay_s, 0.0)), one.cost.deviation_m)),
        ("least energy", lambda one: (round(one.cost.energy, 2), one.cost.deviation_m)),
        ("least remaining risk", lambda one: (round(one.probability, 2), one.cost.deviation_m)),
    )
    for advantage, key in advantages:
        best = min(front, key=key, default=None)
        if best is not None and all(best is not one for one, _ in chosen) and len(chosen) < _MAX_OPTIONS:
            chosen.append((best, advantage))
    for solution in sorted(front, key=lambda one: one.cost.deviation_m):
        if len(chosen) < _MAX_OPTIONS and all(solution.changed != one.changed for one, _ in chosen):
            chosen.append((solution, "other aircraft"))
    return chosen


def _surpasses(one: Solution, other: Solution) -> bool:
    """Return whether a solution of the same aircraft is at least as good in everything, and better in something."""
    if one.changed != other.changed:
        return False
    a, b = _objectives(one), _objectives(other)
    return all(x <= y for x, y in zip(a, b, strict=True)) and a != b


def _objectives(solution: Solution) -> tuple[float, ...]:
    cost = solution.cost
    delay = round(max(cost.delay_s, 0.0))
    return delay, round(cost.energy, 2), round(cost.deviation_m), round(solution.probability, 2)
