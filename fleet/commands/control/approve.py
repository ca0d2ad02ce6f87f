"""Approve an option of a proposal, which a gateway with --allow commands then sends to the aircraft."""

import argparse
import queue
import sys
import time

from fleet.access.roles import OPERATOR
from fleet.bus.codec import digest_of
from fleet.bus.session import Bus, connect
from fleet.config import bus_config_from, router_arguments
from fleet.contract import Approval, Execution, ExecutionState, Mission, Proposal
from fleet.process.sanitise import printable
from fleet.report.changes import describe_changes, user_name

EXAMPLES = """
  fleet approve 1a2b3c4d5e6f7081               show the first option, ask, and print each acknowledged step
  fleet approve 1a2b --option 2                the second one; a unique beginning of the id is enough
  fleet approve 1a2b --yes --who "Kim Lee"     do not ask
  fleet approve 1a2b --config fleet.toml       with the certificate or password of the role operator

exit codes: 0 every step was acknowledged; 1 refused, failed, declined or no answer; 2 wrong use
"""
ANSWER_S = 5.0  # wait for the first answer of a gateway [s]
LIMIT_S = 300.0  # wait for the last step [s]
_ENDS = {
    ExecutionState.ACCEPTED: 0,
    ExecutionState.DONE: 0,
    ExecutionState.UNDONE: 0,
    ExecutionState.REFUSED: 1,
    ExecutionState.FAILED: 1,
}
"""Exit code of each state after which nothing more is sent."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("id", metavar="ID", help="id of the proposal, or its unique beginning")
    parser.add_argument("--option", type=int, default=1, metavar="N", help="number of the option (1)")
    approval_arguments(parser)


def approval_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of all commands that approve something."""
    parser.add_argument("--yes", action="store_true", help="do not ask")
    parser.add_argument("--who", metavar="NAME", help="the person who approves, for the audit (user@machine)")
    router_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Show what will be sent, ask, approve, and print the steps as they are acknowledged."""
    with connect(bus_config_from(args, OPERATOR)) as bus:
        return approve(bus, args)


def approve(bus: Bus, args: argparse.Namespace) -> int:
    """Approve the option named by the arguments; return the exit code.

    Raises:
        ValueError: when there is no such proposal or option.
    """
    proposal = find_proposal([message for message, _ in bus.get(Proposal)], args.id)
    if not 1 <= args.option <= len(proposal.options):
        known = f"1 to {len(proposal.options)} of proposal {printable(proposal.id)}"
        raise ValueError(f"--option: found {args.option}, expected {known}; correct it")
    option = proposal.options[args.option - 1]
    missions = {message.uav: message for message, _ in bus.get(Mission)}
    remaining_s = proposal.valid_until - time.time()
    print(printable(proposal.sentence))
    print(f"option {args.option}: {printable(option.sentence)}")
    print("\n".join(f"  {line}" for line in describe_changes(option, missions)))
    print(f"  valid for {remaining_s:.0f} s" if remaining_s > 0 else "  expired: a gateway will refuse it")
    if not is_confirmed(args):
        return 1
    approval = Approval(
        uav=proposal.uav,
        t=time.time(),
        proposal=proposal.id,
        option=args.option - 1,
        digest=digest_of(option),
        who=person(args),
    )
    return send_approval(bus, approval)


def find_proposal(proposals: list[Proposal], start: str) -> Proposal:
    """Return the only proposal with options whose id begins so.

    Raises:
        ValueError: when there is none, or more than one.
    """
    matching = [one for one in proposals if one.id.startswith(start) and one.options]
    if len({one.id for one in matching}) != 1:
        ids = ", ".join(sorted({printable(one.id) for one in proposals if one.options})) or "none at all"
        count = f"{len(matching)} proposals" if matching else "no proposal"
        raise ValueError(f"ID: found {count} that begin with {start!r}, expected one of {ids}; correct it")
    return max(matching, key=lambda one: one.t)


def is_confirmed(args: argparse.Namespace) -> bool:
    """Return whether the person confirms; without a terminal only `--yes` does."""
    if args.yes:
        return True
    try:
        answer = input("send this to the aircraft? [y/N] ")
    except EOFError:
        answer = ""
    if answer.strip().lower() not in ("y", "yes"):
        print("not approved; nothing is sent")
        return False
    return True


def person(args: argparse.Namespace) -> str:
    """Return the name of the person who approves."""
    return args.who or user_name()


def send_approval(bus: Bus, approval: Approval) -> int:
    """Publish an approval and print the steps of its execution until the last; return the exit code."""
    answers: queue.Queue[Execution] = queue.Queue()
    bus.subscribe(Execution, lambda message, _: answers.put(message), accepts=lambda uav: uav == approval.uav)
    bus.publish(approval)
    printed, deadline = 0, time.monotonic() + ANSWER_S
    while (wait_s := deadline - time.monotonic()) > 0:
        try:
            execution = answers.get(timeout=wait_s)
        except queue.Empty:
            break
        if (execution.proposal, execution.approved_t) != (approval.proposal, approval.t):
            continue
        if not printed:
            deadline = time.monotonic() + LIMIT_S
        results = [step for step in execution.steps if step.accepted is not None]
        for step in results[max(printed - 1, 0) :]:
            mark = "ok" if step.accepted else "FAILED"
            print(f"  {mark:7}uav-{step.uav}: {printable(step.sentence)}", flush=True)
        printed = 1 + len(results)
        if execution.state in _ENDS:
            return _report_end(execution)
    problem = f"no end of it within {LIMIT_S:.0f} s" if printed else f"no gateway has answered within {ANSWER_S:.0f} s"
    remedy = (
        "look at the audit of the gateway" if printed else "start the gateway of this aircraft with --allow commands"
    )
    print(f"uav-{approval.uav}: found {problem}, expected one; {remedy}", file=sys.stderr)
    return 1


def _report_end(execution: Execution) -> int:
    code = _ENDS[execution.state]
    state = "dry run" if execution.dry_run else execution.state.value
    undo = f"; to restore the plan from before: fleet undo {execution.uav}" if execution.can_undo else ""
    print(f"{state}: {printable(execution.sentence)}{undo}", file=sys.stderr if code else sys.stdout)
    return code
