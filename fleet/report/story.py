"""Explain a scripted scene while it happens: alert, proposals, approval, and whether the conflict was avoided."""

from collections import defaultdict
from collections.abc import Callable

import numpy as np

from fleet.bus.session import Bus
from fleet.contract import Alert, AlertKind, Execution, ExecutionState, Message, Proposal, Sample
from fleet.frames import Origin, to_ned
from fleet.process.sanitise import printable
from fleet.report.changes import ID_LETTERS

PAIR = (0, 1)
"""Aircraft that meet, see `fleet.simulator.flight.story`."""
HORIZONTAL_M, VERTICAL_M = 50.0, 20.0  # separation minima of `twin_worker`
_AFTER_S = 15.0  # flight after the predicted time that is measured [s]
_LOST_S = 30.0  # later, the scene ends although one of them has no positions
_STEP_S = 0.1


class ConflictStory:
    """Sentences on the scene in which two aircraft meet.

    Args:
        page: address of the page; empty: there is none
        router: options of commands on another router than the default one
    """

    def __init__(self, page: str = "", router: str = "") -> None:
        self._page, self._router = page, router
        self.sentences: list[str] = []
        self._alert: Alert | None = None
        self._ids: set[str] = set()  # proposals announced
        self._offered: tuple[str, ...] = ()  # changes announced last
        self._states: set[tuple[float, object]] = set()  # of executions announced
        self._executed = False
        self._positions: dict[int, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
        self.ended = False

    def subscribe(self, bus: Bus) -> None:
        """Follow the two aircraft on the bus."""
        handlers: tuple[tuple[type[Message], Callable[..., None]], ...] = (
            (Alert, self.on_alert),
            (Proposal, self.on_proposal),
            (Execution, self.on_execution),
            (Sample, self.on_sample),
        )
        for kind, handle in handlers:
            bus.subscribe(kind, lambda message, _, handle=handle: handle(message), accepts=PAIR.__contains__)  # type: ignore[misc]

    def begin(self) -> None:
        """Announce the scene when the aircraft start."""
        where = f" Open {self._page} and select UAV-000." if self._page else ""
        self._add(
            f"step 1 of 5: UAV 0 and UAV 1 fly at one height and meet about 2 min from now; their twins identify "
            f"models and predict. Wait for the alert.{where}"
        )

    def on_alert(self, alert: Alert) -> None:
        """Announce the predicted conflict."""
        if alert.kind is AlertKind.CONFLICT and alert.active and alert.predicted_t is not None and self._alert is None:
            self._alert = alert
            self._add(f"step 2 of 5, alert: {printable(alert.sentence)}")

    def on_proposal(self, proposal: Proposal) -> None:
        """Announce a proposal with its options, and how to approve one."""
        changes = tuple(option.sentence.partition(":")[0] for option in proposal.options)
        if not changes or changes == self._offered or self._executed:
            return
        self._ids.add(proposal.id)
        self._offered = changes
        name = printable(proposal.id[:ID_LETTERS])
        self._add(f"step 3 of 5, proposal {name}: {printable(proposal.sentence)}")
        for number, option in enumerate(proposal.options, 1):
            self._add(f"    option {number}: {printable(option.sentence)}")
        page = f"press Approve at an option of UAV-{proposal.uav:03d} on {self._page}, or " if self._page else ""
        self._add(f"    {page}enter in another terminal: fleet approve {name} --option 1{self._router}")

    def on_execution(self, execution: Execution) -> None:
        """Announce who approved what, and what came of it."""
        key = (execution.approved_t, (execution.state, execution.follows))
        if key in self._states or execution.proposal not in self._ids:
            return
        self._states.add(key)
        who, text = printable(execution.who), printable(execution.sentence)
        if execution.state is ExecutionState.APPROVED:
            self._executed = self._executed or not execution.undo
            what = "undo" if execution.undo else f"option {execution.option + 1}"
            self._add(f"step 4 of 5: {what} approved by {who}; its commands are sent to the aircraft")
        elif execution.state is ExecutionState.REFUSED:
            self._add(f"    approval refused: {text}. Approve the newest version")
        elif execution.state is not ExecutionState.SENDING:
            self._add(f"    {execution.state.value}: {text}")

    def on_sample(self, sample: Sample) -> None:
        """Store positions from the alert on."""
        if self._alert is None or self.ended:
            return
        if sample.position is not None and sample.position.t.shape[0]:
            rows = sample.position.t.numpy(), sample.position.x.numpy().astype(float)
            self._positions[sample.uav].append(rows)
            newest, end = sorted(self._newest(uav) for uav in PAIR), (self._alert.predicted_t or 0.0) + _AFTER_S
            if newest[0] > end or newest[1] > end + _LOST_S:
                self._end()

    def _newest(self, uav: int) -> float:
        rows = self._positions[uav]
        return float(rows[-1][0][-1]) if rows else float("-inf")

    def _end(self) -> None:
        """Announce the closest approach."""
        self.ended = True
        lost_uav = min(PAIR, key=self._newest)
        if self._newest(lost_uav) < (self._alert.predicted_t if self._alert and self._alert.predicted_t else 0.0):
            self._add(f"step 5 of 5: UAV {lost_uav} sent no positions at the predicted time: the result is not known.")
            self._positions.clear()
            return
        horizontal, vertical, lost = self.closest_approach()
        distances = f"{horizontal:.0f} m apart horizontally and {vertical:.0f} m vertically"
        if lost:
            result = f"the conflict was not avoided: UAV 0 and UAV 1 were {distances}. Start again and approve sooner."
        elif self._executed:
            result = f"the conflict was avoided: UAV 0 and UAV 1 passed {distances}."
        else:
            result = f"UAV 0 and UAV 1 passed {distances} without an approval."
        limits = f"Required is {HORIZONTAL_M:.0f} m or {VERTICAL_M:.0f} m"
        undo = f". To restore the former plan: fleet undo 0{self._router}" if self._executed else ""
        self._add(f"step 5 of 5: {result} {limits}{undo}. Ctrl-C ends the scene.")

    def closest_approach(self) -> tuple[float, float, bool]:
        """Return horizontal and vertical distance at the closest approach since the alert [m], and a lost separation.

        The closest approach is where sqrt((d_horizontal / 50 m)^2 + (d_vertical / 20 m)^2) is smallest.
        """
        tracks = [[np.concatenate(part) for part in zip(*self._positions[uav], strict=True)] for uav in PAIR]
        start, stop = max(t[0] for t, _ in tracks), min(t[-1] for t, _ in tracks)
        at, origin = np.arange(start, stop, _STEP_S), Origin(*(int(x) for x in tracks[0][1][0]))
        paths = []
        for t, geodetic in tracks:
            ned = to_ned(origin, *geodetic.T)
            paths.append(np.column_stack([np.interp(at, t, column) for column in ned.T]))
        offset = paths[0] - paths[1]
        horizontal, vertical = np.hypot(offset[:, 0], offset[:, 1]), np.abs(offset[:, 2])
        lost = (horizontal < HORIZONTAL_M) & (vertical < VERTICAL_M)
        k = int(np.hypot(horizontal / HORIZONTAL_M, vertical / VERTICAL_M).argmin())
        return float(horizontal[k]), float(vertical[k]), bool(lost.any())

    def _add(self, sentence: str) -> None:
        self.sentences.append(sentence)
