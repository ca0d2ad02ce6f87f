"""Compute proposals against alerts in a thread of limited CPU share; telemetry and predictions are not delayed."""

import logging
import threading
from collections import deque
from functools import partial
from math import inf
from typing import Protocol

from fleet.contract import Alert, Execution, Message, Proposal
from twin_worker.ownership.twin_store import OwnedTwin, data_time
from twin_worker.proposals.proposer import Proposer
from twin_worker.service.identification_thread import CpuShareLimiter

_POLL_S = 0.1  # between checks for new alerts [s]
_SETTLED_S = 1.5  # after the last step, until mode and item are reported [s]
_MAX_WAITING = 100  # states of executions that wait
_log = logging.getLogger(__name__)


class AlertSource(Protocol):
    """Aircraft of a worker with their active alerts, and where results are published."""

    def owned_twins(self) -> list[OwnedTwin]:
        """Return the ready twins."""

    def active_alerts(self, owned: OwnedTwin) -> list[Alert]:
        """Return the active alerts of one aircraft."""

    def publish(self, result: Message, owned: OwnedTwin) -> None:
        """Publish a result of one aircraft."""


class ProposalThread:
    """Answers alerts with proposals: new alerts first, then the renewal that waits longest.

    Args:
        source: aircraft, alerts and publication
        proposer: computes the proposals
        cpu_share: limits the CPU time
    """

    def __init__(self, source: AlertSource, proposer: Proposer, cpu_share: CpuShareLimiter) -> None:
        self._source, self._proposer, self._cpu_share = source, proposer, cpu_share
        self._executions: deque[Execution] = deque(maxlen=_MAX_WAITING)  # received, not processed
        self._executed: list[tuple[float, Execution]] = []  # whose paths are due, at a data time [s since 1970]

    def on_execution(self, execution: Execution) -> None:
        """Note the state of an execution, on a thread of the bus."""
        self._executions.append(execution)

    def run(self, stop: threading.Event) -> None:
        """Answer alerts until `stop` is set."""
        while not stop.wait(_POLL_S):
            try:
                self.withdraw()
                self.follow_executions()
                while not stop.is_set() and (due := self._next_due()) is not None:
                    self._cpu_share.run(partial(self._update, *due), stop)
            except ConnectionError:  # the session is closed: shutdown
                return
            except Exception:  # an error must not stop the proposals of other aircraft
                _log.exception("proposals failed with an internal error; report it")

    def run_once(self) -> None:
        """Answer everything that is due now, on the caller's thread."""
        self.withdraw()
        self.follow_executions()
        while (due := self._next_due()) is not None:
            self._update(*due)

    def withdraw(self) -> None:
        """Withdraw the proposals whose alert was cleared."""
        for owned in self._source.owned_twins():
            uav, active = owned.twin.config.uav, self._source.active_alerts(owned)
            for proposal in self._proposer.withdraw(uav, active, data_time(owned)):
                self._source.publish(proposal, owned)

    def follow_executions(self) -> None:
        """Publish the paths of executed options from their execution on, with which the gateway compares the flight."""
        by_uav = {owned.twin.config.uav: owned for owned in self._source.owned_twins()}
        while self._executions:
            execution = self._executions.popleft()
            owned = by_uav.get(execution.uav)
            if owned is not None and self._proposer.on_execution(execution, data_time(owned)):
                others = [(t, one) for t, one in self._executed if one.proposal != execution.proposal]
                self._executed = [*others, (data_time(owned) + _SETTLED_S, execution)]
        for due in list(self._executed):
            owned = by_uav.get(due[1].uav)
            if owned is None or data_time(owned) >= due[0]:
                self._executed.remove(due)
                if owned is not None and (proposal := self._proposer.executed(due[1])) is not None:
                    self._source.publish(proposal, owned)

    def _next_due(self) -> tuple[OwnedTwin, Alert] | None:
        due = [
            (self._proposer.computed_t(alert), inf if alert.predicted_t is None else alert.predicted_t, owned, alert)
            for owned in self._source.owned_twins()
            for alert in self._source.active_alerts(owned)
            if self._proposer.due(alert, data_time(owned))
        ]
        return min(due, key=lambda one: one[:2])[2:] if due else None

    def _update(self, owned: OwnedTwin, alert: Alert) -> None:
        try:
            proposal: Proposal | None = self._proposer.update(alert, data_time(owned))
        except Exception as error:  # an error in one aircraft must not stop the others
            owned.defect = f"{owned.twin.name}: found an internal error ({error}), expected a proposal; report it"
            _log.exception(owned.defect)
            return
        if proposal is not None:
            self._source.publish(proposal, owned)
