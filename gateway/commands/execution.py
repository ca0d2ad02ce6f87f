"""One execution: its steps one after the other, the comparison of the flight with the predicted path, and the undo."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from fleet.bus.codec import digest_of
from fleet.contract import Approval, Execution, ExecutionState, ExecutionStep, Option, Proposal, ProposedPath
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from gateway.commands.approval_check import Positions
from gateway.commands.plan_steps import FormerPlan
from gateway.commands.region import Deviation, deviation, read_path
from gateway.commands.steps import CommandStep

PATH_WAIT_S = 10.0  # wait for the path predicted after the execution, before that of the proposal is taken [s]
_RUNNING = (ExecutionState.APPROVED, ExecutionState.SENDING)


@dataclass
class RunningExecution:
    """An approved option or its undo.

    Attributes:
        approval: of the person
        proposal, option: what was approved
        steps: aircraft and step, in order
        former: plan of each aircraft before
        is_dry: nothing is sent
    """

    approval: Approval
    proposal: Proposal
    option: Option
    steps: list[tuple[AircraftLink, CommandStep]]
    former: dict[int, FormerPlan]
    is_dry: bool = False
    state: ExecutionState = ExecutionState.APPROVED
    sentence: str = ""
    follows: bool | None = None
    has_undo: bool = False  # its undo was approved, and is an execution of its own
    compared_t: float = float("-inf")  # time of the last comparison [s since 1970]
    accepted_t: float = float("inf")  # when the last step was acknowledged [s since 1970]
    results_t: list[float] = field(default_factory=list)  # time of each result [s since 1970]
    published: tuple[object, ...] = ()  # what was published last
    predicted: Proposal | None = None  # with the paths from the execution on

    @property
    def is_sending(self) -> bool:
        """Return whether steps are left."""
        return self.state in _RUNNING

    @property
    def uavs(self) -> set[int]:
        """Return the commanded aircraft."""
        return {aircraft.uav for aircraft, _ in self.steps}

    @property
    def current(self) -> tuple[AircraftLink, CommandStep]:
        """Return the step that is being sent, and its aircraft."""
        return self.steps[len(self.results_t)]

    @property
    def can_undo(self) -> bool:
        """Return whether an undo can be approved."""
        plans = [plan for plan in self.former.values() if plan.changed]
        is_possible = bool(plans) and all(plan.is_restorable for plan in plans)
        return is_possible and not (self.is_sending or self.has_undo or self.is_dry or self.approval.undo)

    def messages(self, now: float) -> Iterator[tuple[AircraftLink, Any]]:
        """Yield the messages to send now; advance to the next step where one has ended."""
        self.state = ExecutionState.SENDING
        while self.is_sending:
            aircraft, step = self.current
            yield from ((aircraft, message) for message in step.messages(now))
            if step.result is None:
                return
            self.results_t.append(now)
            self.former[aircraft.uav].final_mode = aircraft.mode
            if not step.result.accepted:
                self.state, self.sentence = ExecutionState.FAILED, f"uav-{aircraft.uav}: {step.result.sentence}"
            elif len(self.results_t) == len(self.steps):
                self.accepted_t = now
                self.state = ExecutionState.UNDONE if self.approval.undo else ExecutionState.ACCEPTED
                self.sentence = "the plan from before is restored" if self.approval.undo else "all steps acknowledged"

    def compare(self, now: float, aircraft: dict[int, AircraftLink], positions: Positions) -> None:
        """Compare the flight with the paths predicted for the option; at their end the execution is done.

        They are those from the actual execution on. Where no worker sends any, they are those of the proposal, which
        assume a later or an earlier start.
        """
        self.compared_t = now
        if self.predicted is None and now - self.accepted_t < PATH_WAIT_S:
            return
        proposal = self.predicted or self.proposal
        option = proposal.options[0] if self.predicted is not None else self.option
        paths = {path.uav: path for path in option.paths if path.uav in self.former}
        deviations = {uav: self._deviation(path, proposal.t, positions) for uav, path in paths.items()}
        compared = {uav: one for uav, one in deviations.items() if one is not None}
        if now - proposal.t > max((float(path.ahead.numpy()[-1]) for path in paths.values()), default=0.0):
            self.state = ExecutionState.DONE
            self.sentence = f"the predicted path has ended; last: {self.sentence}"
            return
        if not compared:
            return
        after = f"after {now - self.accepted_t:.0f} s"
        texts = [f"uav-{uav} is off the path: {one} {after}" for uav, one in compared.items() if not one.is_inside]
        texts += [
            f"uav-{uav} is in mode {aircraft[uav].mode} {after}"
            for uav, plan in self.former.items()
            if uav in aircraft and aircraft[uav].mode != plan.final_mode
        ]
        self.follows = not texts
        self.sentence = f"does not follow: {'; '.join(texts)}" if texts else "follows within its region"

    def _deviation(self, path: ProposedPath, path_t: float, positions: Positions) -> Deviation | None:
        if path.uav not in positions:
            return None
        t, position = positions[path.uav]
        return deviation(path, t - path_t, position)

    def replace_paths(self, proposal: Proposal) -> None:
        """Take the paths that a worker has predicted after the execution of this option; ignore all else."""
        is_later = self.state is ExecutionState.ACCEPTED and proposal.t > self.proposal.t
        is_same = len(proposal.options) == 1 and digest_of(proposal.options[0]) == self.approval.digest
        if is_later and is_same and all(_is_valid(path) for path in proposal.options[0].paths):
            self.predicted = proposal

    def message(self, now: float, index: int) -> Execution:
        """Return the state as a message of the bus; `index`: of the option."""
        steps = tuple(
            ExecutionStep(
                uav=aircraft.uav,
                sentence=step.sentence if step.result is None else step.result.sentence,
                accepted=None if step.result is None else step.result.accepted,
                t=self.results_t[k] if k < len(self.results_t) else None,
            )
            for k, (aircraft, step) in enumerate(self.steps)
        )
        return Execution(
            uav=self.approval.uav,
            t=now,
            proposal=self.approval.proposal,
            option=index,
            state=self.state,
            who=self.approval.who,
            digest=self.approval.digest,
            approved_t=self.approval.t,
            undo=self.approval.undo,
            steps=steps,
            follows=self.follows,
            can_undo=self.can_undo,
            dry_run=self.is_dry,
            sentence=self.sentence,
        )


def _is_valid(path: ProposedPath) -> bool:
    try:
        read_path(path)
    except ValueError:
        return False
    return True
