"""Executor of approved proposals: receives proposals and approvals, checks, sends, records, publishes.

Nothing is sent unless an approval has passed every check of `approval_check`. Whatever is sent is on the disk first.
"""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from fleet.bus.bus_protocol import EpochFence, Replies
from fleet.bus.codec import EncodedMessage, Stamp
from fleet.bus.session import Bus
from fleet.contract import Approval, Change, Execution, ExecutionState, Option, Proposal, Sample
from fleet.export.geometry import position_rows
from fleet.process.sanitise import printable
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from gateway.commands.approval_check import (
    MAX_TEXT,
    Fleet,
    ReceivedProposal,
    approval_refusal,
    approved_version,
    change_refusal,
    situation_of,
    situation_refusal,
)
from gateway.commands.audit import APPROVED, UNDO_APPROVED, AuditLog
from gateway.commands.execution import RunningExecution
from gateway.commands.mission_transfer import is_for_us
from gateway.commands.plan_steps import change_steps, former_plan, undo_steps
from gateway.commands.steps import AcknowledgedCommand

MAX_VERSIONS = 8  # earlier versions of a proposal that are stored
MAX_PROPOSALS = 1_000  # newest versions of proposals that are stored
EXPIRED_S = 60.0  # time for which an expired proposal is stored, so that its refusal says so [s]
MAX_EXECUTIONS = 200  # executions that are stored for an undo
COMPARE_S = 1.0  # between two comparisons of a flight with its predicted path [s]
REPORT_S = 5.0  # between two reports of a flight that continues to follow [s]
_ADDRESSED = ("COMMAND_ACK", "MISSION_ACK", "MISSION_COUNT", "MISSION_REQUEST", "MISSION_REQUEST_INT")


class CommandExecutor:
    """Executor of one gateway; `tick` is called on its main thread.

    Args:
        bus: source of proposals and approvals, destination of executions
        aircraft: aircraft of this gateway by UAV id
        is_allowed: whether a UAV may be commanded
        audit: audit of all commands
        dry_run: prints the messages of an approved proposal; None: they are sent
    """

    def __init__(
        self,
        bus: Bus,
        aircraft: Mapping[int, AircraftLink],
        is_allowed: Callable[[int], bool],
        audit: AuditLog,
        dry_run: Callable[[str], None] | None = None,
    ) -> None:
        self._bus, self._aircraft, self._is_allowed = bus, aircraft, is_allowed
        self._audit, self._dry_run = audit, dry_run
        self._received: deque[tuple[Proposal | Approval, Stamp | None]] = deque(maxlen=MAX_PROPOSALS)
        self._fence = EpochFence()
        self._proposals: OrderedDict[str, ReceivedProposal] = OrderedDict()
        self._positions: dict[int, tuple[float, np.ndarray]] = {}
        self._executions: OrderedDict[str, RunningExecution] = OrderedDict()  # by proposal
        self._undos: list[RunningExecution] = []  # in progress
        self._speeds: dict[int, float] = {}  # commanded last, by UAV [m/s]
        self._replies: list[tuple[int, Any]] = []  # UAV and message of an aircraft that is being commanded
        self._entries: list[dict[str, Any]] = []  # of the audit, not yet written
        self._latest: dict[int, Execution] = {}
        self._lock = threading.Lock()  # queries arrive on a thread of the bus
        bus.subscribe(Proposal, self._receive, accepts=self._is_ours)
        bus.subscribe(Approval, self._receive, accepts=self._is_ours)
        bus.declare_queryable(Execution, self._answer)

    @property
    def transferring(self) -> set[int]:
        """Return the ids of the aircraft whose mission is being transferred."""
        running = (run.current for run in self._running())
        return {aircraft.uav for aircraft, step in running if step.transfers_mission}

    def observe(self, messages: Iterable[Any]) -> None:
        """Read the positions of aircraft with a proposal or an execution from published samples."""
        watched = {uav for received in self._proposals.values() for uav in received.situations}
        watched.update(uav for run in self._executions.values() for uav in run.uavs)
        for message in messages:
            kind = message.kind if isinstance(message, EncodedMessage) else type(message)
            if kind is Sample and message.uav in watched:
                sample = message.message() if isinstance(message, EncodedMessage) else message
                t, positions = position_rows(sample)
                if len(t):
                    self._positions[sample.uav] = float(t[-1]), positions[-1]

    def tick(self, now: float) -> list[tuple[AircraftLink, Any]]:
        """Process what was received, and return the messages to send: aircraft and message.

        Args:
            now: fleet time [s since 1970]
        """
        while self._received:
            message, stamp = self._received.popleft()
            if isinstance(message, Proposal):
                self._store(message, stamp, now)
            else:
                self._approve(message, now)
        for run in self._running():
            self._pass_replies(run, now)
        self._replies.clear()
        out = [pair for run in self._running() for pair in self._messages(run, now)]
        if not self._write(now):
            out = []
        for run in [run for run in (*self._executions.values(), *self._undos) if not run.has_undo]:
            self._compare(run, now)
            self._publish(run, now)
        self._undos = [run for run in self._undos if run.is_sending]
        return out

    # --- proposals and approvals -------------------------------------------------------------------------------------

    def _is_ours(self, uav: int) -> bool:
        return uav in self._aircraft

    def _receive(self, message: Proposal | Approval, stamp: Stamp | None) -> None:
        self._received.append((message, stamp))

    def _store(self, proposal: Proposal, stamp: Stamp | None, now: float) -> None:
        """Store the newest version of a proposal, with the situation of its aircraft now; remove those long expired."""
        before = self._proposals.get(proposal.id)
        is_older = before is not None and (before.proposal.uav != proposal.uav or before.proposal.t > proposal.t)
        if is_older or not self._fence.accepts(proposal.uav, stamp):
            return
        uavs = {change.uav for option in proposal.options for change in option.changes}
        situations = {uav: situation_of(self._aircraft[uav]) for uav in uavs if uav in self._aircraft}
        run = self._executions.get(proposal.id)
        if run is not None:
            run.replace_paths(proposal)
        earlier = () if before is None else self._proposals[proposal.id].valid_versions(now)
        self._proposals[proposal.id] = ReceivedProposal(proposal, situations, earlier[:MAX_VERSIONS])
        self._proposals.move_to_end(proposal.id)
        expired = [key for key, one in self._proposals.items() if not now - one.proposal.valid_until < EXPIRED_S]
        for key in expired + list(self._proposals)[: max(len(self._proposals) - MAX_PROPOSALS, 0)]:
            self._proposals.pop(key, None)

    def _approve(self, approval: Approval, now: float) -> None:
        """Check an approval; begin its execution or publish why it is refused."""
        checked: tuple[ReceivedProposal, Option] | Option | str = approval_refusal(approval, now, self._audit.executed)
        if not checked:
            checked = self._undoable(approval) if approval.undo else self._executable(approval, now)
        entry = {"proposal": approval.proposal, "uav": approval.uav, "who": printable(approval.who[:MAX_TEXT])}
        if isinstance(checked, str):
            self._entries.append({"event": "refused", **entry, "undo": approval.undo, "reason": checked})
            self._bus.publish(_refused(approval, checked, now))
            return
        run = self._undo_of(approval) if isinstance(checked, Option) else self._begin(approval, *checked)
        option = run.option
        event = UNDO_APPROVED if approval.undo else APPROVED
        self._entries.append({"event": event, **entry, "approved_t": approval.t, "changes": list(option.changes)})
        self._publish(run, now)
        if self._dry_run is not None:
            self._print(run, self._dry_run)
        (self._undos.append if approval.undo else self._add)(run)
        self._audit.executed.add((approval.proposal, approval.undo))

    def _fleet(self) -> Fleet:
        busy = {uav for run in self._running() for uav in run.uavs}
        return Fleet(self._aircraft, self._positions, self._is_allowed, busy)

    def _executable(self, approval: Approval, now: float) -> tuple[ReceivedProposal, Option] | str:
        """Return the version of the proposal and the option to execute, or why none is."""
        fleet, checked = self._fleet(), approved_version(approval, self._proposals.get(approval.proposal), now)
        if isinstance(checked, str):
            return checked
        received, option = checked
        refusals = (change_refusal(change, fleet) for change in option.changes)
        reason = next(filter(None, refusals), "") or situation_refusal(option, received, fleet, now)
        return reason or checked

    def _undoable(self, approval: Approval) -> Option | str:
        """Return the executed option whose plan from before can be restored, or why it cannot."""
        run = self._executions.get(approval.proposal)
        if run is None or run.approval.uav != approval.uav or run.approval.digest != approval.digest:
            return "this gateway has executed no such proposal since its start"
        if not run.can_undo:
            return "there is nothing that can be restored"
        fleet = self._fleet()
        for uav, former in run.former.items():
            probe = Change(uav=uav, mode="hold")  # any change: whether the aircraft may be commanded
            if former.changed and (reason := change_refusal(probe, fleet)):
                return reason
            if former.changed and self._aircraft[uav].mode != former.final_mode:
                mode = self._aircraft[uav].mode
                return f"uav-{uav} is in mode {mode}, after the execution it was {former.final_mode}: it was commanded"
        return run.option

    def _begin(self, approval: Approval, received: ReceivedProposal, option: Option) -> RunningExecution:
        former, steps = {}, []
        for change in option.changes:
            aircraft = self._aircraft[change.uav]
            plan = former[change.uav] = former_plan(aircraft, self._speeds.get(change.uav))
            plan.steps = change_steps(aircraft, change, received.situations[change.uav])
            steps += [(aircraft, step) for step in plan.steps]
        return RunningExecution(approval, received.proposal, option, steps, former, self._dry_run is not None)

    def _undo_of(self, approval: Approval) -> RunningExecution:
        run = self._executions[approval.proposal]
        run.has_undo, run.state = True, ExecutionState.DONE
        steps = [
            (self._aircraft[uav], step)
            for uav, plan in run.former.items()
            for step in undo_steps(self._aircraft[uav], plan)
        ]
        former = {uav: former_plan(self._aircraft[uav], None) for uav in run.former}
        return RunningExecution(approval, run.proposal, run.option, steps, former, self._dry_run is not None)

    def _add(self, run: RunningExecution) -> None:
        self._executions[run.approval.proposal] = run
        while len(self._executions) > MAX_EXECUTIONS:
            self._executions.popitem(last=False)

    # --- sending -----------------------------------------------------------------------------------------------------

    def _running(self) -> list[RunningExecution]:
        return [run for run in (*self._executions.values(), *self._undos) if run.is_sending and not run.is_dry]

    def _messages(self, run: RunningExecution, now: float) -> Sequence[tuple[AircraftLink, Any]]:
        """Return the messages of a run, each with an entry of the audit."""
        for aircraft, _ in run.steps:
            if self._aircraft.get(aircraft.uav) is not aircraft:
                run.state = ExecutionState.FAILED
                run.sentence = f"uav-{aircraft.uav} is no longer received by this gateway"
                self._end(run)
                return ()
            aircraft.observer = self._observer(aircraft.uav)
        done = len(run.results_t)
        out = list(run.messages(now))
        self._entries += [self._entry("sent", run, aircraft.uav, message) for aircraft, message in out]
        for aircraft, step in run.steps[done : len(run.results_t)]:
            assert step.result is not None
            entry = {"event": "step", "proposal": run.approval.proposal, "uav": aircraft.uav}
            self._entries.append({**entry, "accepted": step.result.accepted, "sentence": step.result.sentence})
            if type(step) is AcknowledgedCommand and step.result.accepted:
                self._speeds[aircraft.uav] = step.params[1]
        if not run.is_sending:
            self._end(run)
        return out

    def _end(self, run: RunningExecution) -> None:
        for aircraft, _ in run.steps:
            aircraft.observer = None
            aircraft.mission.needs_download = True  # published anew, with the checks of a download
        entry = {"event": "result", "proposal": run.approval.proposal, "undo": run.approval.undo}
        self._entries.append({**entry, "state": run.state, "sentence": run.sentence})

    def _observer(self, uav: int) -> Callable[[Any, float], None]:
        return lambda message, _: self._replies.append((uav, message))

    def _pass_replies(self, run: RunningExecution, now: float) -> None:
        aircraft, step = run.current
        for uav, message in self._replies:
            if uav != aircraft.uav:
                continue
            step.receive(message, now)
            if message.get_type() in _ADDRESSED and is_for_us(message):
                self._entries.append(self._entry("received", run, uav, message))

    def _entry(self, event: str, run: RunningExecution, uav: int, message: Any) -> dict[str, Any]:
        fields = message.to_dict() if hasattr(message, "to_dict") else message._asdict()
        content = {"mavpackettype": message.get_type(), **fields}
        return {"event": event, "proposal": run.approval.proposal, "uav": uav, "message": content}

    def _write(self, now: float) -> bool:
        """Write the audit; where that fails, every execution ends and nothing is sent."""
        entries, self._entries = self._entries, []
        if not entries:
            return True
        try:
            self._audit.write(now, entries)
        except OSError as error:
            for run in self._running():
                run.state = ExecutionState.FAILED
                run.sentence = (
                    f"the audit {self._audit.path} cannot be written ({error.strerror}); nothing more is sent"
                )
                for aircraft, _ in run.steps:
                    aircraft.observer = None
            return False
        return True

    def _print(self, run: RunningExecution, report: Callable[[str], None]) -> None:
        """Print the messages of an approved option instead of sending them."""
        for aircraft, step in run.steps:
            report(f"dry run: uav-{aircraft.uav}: {step.sentence}")
            for message in step.planned():
                report(f"dry run: uav-{aircraft.uav}:   {message}")
                self._entries.append(self._entry("dry_run", run, aircraft.uav, message))
        run.state, run.sentence = ExecutionState.DONE, "dry run: nothing was sent"

    # --- publishing --------------------------------------------------------------------------------------------------

    def _compare(self, run: RunningExecution, now: float) -> None:
        if run.state is ExecutionState.ACCEPTED and now - run.compared_t >= COMPARE_S:
            run.compare(now, dict(self._aircraft), self._positions)

    def _publish(self, run: RunningExecution, now: float) -> None:
        """Publish an execution when it has changed, and every few seconds while a flight is compared."""
        slot = now // REPORT_S if run.state is ExecutionState.ACCEPTED else 0.0
        content = (run.state, len(run.results_t), run.follows, slot)
        if run.published == content:
            return
        run.published = content
        index = next((k for k, option in enumerate(run.proposal.options) if option is run.option), 0)
        message = run.message(now, index)
        with self._lock:
            self._latest[message.uav] = message
        self._bus.publish(message)

    def _answer(self, uav: int | None, settings: dict[str, str], payload: bytes) -> Replies:
        del settings, payload
        with self._lock:
            return [(message, None) for message in self._latest.values() if uav in (None, message.uav)]


def _refused(approval: Approval, reason: str, now: float) -> Execution:
    return Execution(
        uav=approval.uav,
        t=now,
        proposal=approval.proposal,
        option=approval.option,
        state=ExecutionState.REFUSED,
        who=approval.who[:MAX_TEXT],
        digest=approval.digest[:MAX_TEXT],
        approved_t=approval.t,
        undo=approval.undo,
        sentence=reason,
    )
