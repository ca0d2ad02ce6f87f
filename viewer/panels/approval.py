"""Approval of proposals on one page: what is asked for, its confirmation, and what came of it."""

import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from html import escape

import msgspec

from fleet.bus.codec import digest_of
from fleet.contract import Approval, Execution, ExecutionState
from fleet.report.changes import describe_changes
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.theme.events import clip
from viewer.theme.palette import Palette

ANSWER_S = 5.0  # wait for the first answer of a gateway [s]
MAX_TEXT = 300  # characters of a received text
MAX_STEPS = 12  # steps of an execution that are shown
APPROVE, UNDO, CONFIRM, CANCEL = "approve", "undo", "confirm", "cancel"
NO_ANSWER = "No gateway has answered; start the gateway of this aircraft with --allow commands."


@dataclass(frozen=True)
class PendingApproval:
    """What is sent once the person confirms.

    Attributes:
        approval: without its time
        lines: what is sent to the aircraft
        valid_until: fleet time after which a gateway refuses it [s since 1970]; None: unlimited
        name: random, in the code of its buttons: nothing else confirms it
    """

    approval: Approval
    lines: tuple[str, ...]
    valid_until: float | None
    name: str


class ApprovalDialog:
    """Clicks of one page: an option or an undo is first shown, then sent after a confirmation.

    Args:
        store: received data
        send: publishes an approval with the credentials of an operator
        who: name of the person, for the audit
    """

    def __init__(self, store: FleetStore, send: Callable[[Approval], None], who: str) -> None:
        self._store, self._send, self._who = store, send, who
        self.changed: Callable[[], None] = lambda: None  # draws the page anew
        self.pending: PendingApproval | None = None
        self._sent: tuple[Approval, float] | None = None  # and when, monotonic [s]

    def on_click(self, text: str, now: float) -> None:
        """Process the text of a button, untrusted: `approve/7/5f2c…/0`, `undo/7`, `confirm/NAME`, `cancel/NAME`."""
        action, _, rest = text[:120].partition("/")
        if action == APPROVE and (chosen := parse_option(rest)) is not None:
            self.pending = self._of_option(*chosen, now)
        elif action == UNDO and rest.isascii() and rest.isdecimal():
            self.pending = self._of_undo(int(rest))
        elif self.pending is not None and secrets.compare_digest(rest.encode(), self.pending.name.encode()):
            if action == CONFIRM and not self._is_expired(self.pending, now):
                approval = msgspec.structs.replace(self.pending.approval, t=time.time())
                self._send(approval)
                self._sent = approval, now
                self.pending = None
            elif action == CANCEL:
                self.pending = None
        self.changed()

    def _is_expired(self, pending: PendingApproval, now: float) -> bool:
        """Return whether a gateway would refuse it: the page that showed the button may be late, or gone on."""
        vehicle = self._store.get(pending.approval.uav)
        return pending.valid_until is not None and (vehicle is None or vehicle.data_time(now) >= pending.valid_until)

    def _of_option(self, uav: int, name: str, index: int, now: float) -> PendingApproval | None:
        vehicle = self._store.get(uav)
        if vehicle is None:
            return None
        clock = vehicle.data_time(now)
        shown = [one for one in vehicle.open_proposals() if one.is_valid(clock) and one.message.id == name]
        if not shown or index >= len(shown[0].options):
            return None
        message = shown[0].message
        option = message.options[index]
        missions = {one.uav: one.mission for one in self._store.all() if one.mission is not None}
        approval = self._approval(uav, message.id, index, digest_of(option))
        lines = (clip(option.sentence, MAX_TEXT), *describe_changes(option, missions))
        return PendingApproval(approval, lines, message.valid_until, secrets.token_hex(8))

    def _of_undo(self, uav: int) -> PendingApproval | None:
        vehicle = self._store.get(uav)
        execution = None if vehicle is None else vehicle.execution
        if execution is None or not execution.can_undo:
            return None
        approval = self._approval(execution.uav, execution.proposal, execution.option, execution.digest)
        lines = tuple(f"uav-{step.uav}: undo {clip(step.sentence, MAX_TEXT)}" for step in execution.steps)
        return PendingApproval(msgspec.structs.replace(approval, undo=True), lines, None, secrets.token_hex(8))

    def _approval(self, uav: int, proposal: str, option: int, digest: str) -> Approval:
        return Approval(uav=uav, t=0.0, proposal=proposal, option=option, digest=digest, who=self._who)

    def html(self, vehicle: Vehicle, palette: Palette, now: float, code: str) -> str:
        """Return the confirmation and a missing answer as HTML; `code`: page code that sends what is at `{}`."""
        pending, cards = self.pending, []
        if pending is not None and pending.approval.uav == vehicle.uav:
            lines = "".join(f"<div>{escape(line)}</div>" for line in pending.lines)
            title = "Restore the plan from before?" if pending.approval.undo else "Send this to the aircraft?"
            left_s = None if pending.valid_until is None else pending.valid_until - vehicle.data_time(now)
            valid = "" if left_s is None else f'<div class="soft">{_validity(left_s)}</div>'
            buttons = button(code, f"{CONFIRM}/{pending.name}", "Send") if left_s is None or left_s > 0 else ""
            buttons += button(code, f"{CANCEL}/{pending.name}", "Cancel")
            cards.append(f'<div class="ask"><b>{title}</b>{lines}{valid}{buttons}</div>')
        if self._sent is not None and self._is_unanswered(vehicle, now):
            cards.append(f'<div class="say" style="border-color:{palette.mismatch}">{NO_ANSWER}</div>')
        return "".join(cards)

    def _is_unanswered(self, vehicle: Vehicle, now: float) -> bool:
        assert self._sent is not None
        approval, sent = self._sent
        execution = vehicle.execution
        is_answer = execution is not None and execution.approved_t == approval.t
        return approval.uav == vehicle.uav and not is_answer and ANSWER_S < now - sent < 10 * ANSWER_S


def _validity(left_s: float) -> str:
    return f"valid for {left_s:.0f} s" if left_s > 0 else "expired: choose the newest version"


def parse_option(text: str) -> tuple[int, str, int] | None:
    """Parse `7/5f2c…/0`: UAV, id of the proposal and index of the option; None for any other text."""
    uav, _, rest = text[:80].partition("/")
    name, _, index = rest.partition("/")
    is_number = all(part.isascii() and part.isdecimal() and len(part) <= 6 for part in (uav, index))
    return (int(uav), name, int(index)) if is_number and name.isalnum() else None


def button(code: str, text: str, label: str) -> str:
    """Return a button that sends a text; `code`: page code with the text at `{}`, empty: no button."""
    return f'<button class="approve" onclick="{code.format(text)}">{label}</button>' if code else ""


def execution_html(execution: Execution | None, uav: int, palette: Palette, code: str) -> str:
    """Return what was executed and how it is flown as HTML; `code`: page code of the button Undo, empty: a command."""
    if execution is None:
        return ""
    is_bad = execution.state in (ExecutionState.REFUSED, ExecutionState.FAILED) or execution.follows is False
    what = "Undo" if execution.undo else f"Option {execution.option + 1}"
    title = f"{what} approved by {escape(clip(execution.who, 80))}: {execution.state.value}"
    steps = "".join(
        f"<div>{'·' if step.accepted is None else '✓' if step.accepted else '✗'} "
        f"uav-{step.uav}: {escape(clip(step.sentence, MAX_TEXT))}</div>"
        for step in execution.steps[:MAX_STEPS]
    )
    text = f"<div>{escape(clip(execution.sentence, MAX_TEXT))}</div>" if execution.sentence else ""
    undo = ""
    if execution.can_undo:
        undo = button(code, f"{UNDO}/{uav}", "Undo") or f'<div class="soft">fleet undo {uav}</div>'
    colour = palette.mismatch if is_bad else palette.horizon
    body = f'<b>{title}</b>{text}<div class="soft">{steps}</div>{undo}'
    return f'<div class="say" style="border-color:{colour}">{body}</div>'
