"""Restore the mission, item, speed and mode that an aircraft had before an approved proposal was executed."""

import argparse
import sys
import time

from fleet.access.roles import OPERATOR
from fleet.bus.session import Bus, connect
from fleet.commands.control.approve import approval_arguments, is_confirmed, person, send_approval
from fleet.config import bus_config_from
from fleet.contract import Approval, Execution
from fleet.process.sanitise import printable

EXAMPLES = """
  fleet undo 7                       show what is restored, ask, and print each acknowledged step
  fleet undo 7 --yes --who "Kim Lee"

Restored is what the last executed proposal of this aircraft has changed, once, by the gateway that executed it and
since its start. It is refused where somebody has changed the mission or the mode since.
exit codes: 0 restored; 1 refused, failed, declined or nothing to restore; 2 wrong use
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("uav", type=int, metavar="UAV", help="UAV id")
    approval_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Show what will be restored, ask, approve, and print the steps as they are acknowledged."""
    with connect(bus_config_from(args, OPERATOR)) as bus:
        return undo(bus, args)


def undo(bus: Bus, args: argparse.Namespace) -> int:
    """Approve the undo of the last execution of an aircraft; return the exit code."""
    executions = [message for message, _ in bus.get(Execution)]
    own = [one for one in executions if args.uav in {one.uav, *(step.uav for step in one.steps)}]
    last = max(own, key=lambda one: one.t, default=None)
    if last is None or not last.can_undo:
        problem = "no execution of it" if last is None else f"one that cannot be undone ({last.state.value})"
        print(f"uav-{args.uav}: found {problem}, expected one; see the audit of the gateway", file=sys.stderr)
        return 1
    print(f"restore the plan from before proposal {printable(last.proposal)}, approved by {printable(last.who)}:")
    print("\n".join(f"  uav-{step.uav}: undo {printable(step.sentence)}" for step in last.steps))
    if not is_confirmed(args):
        return 1
    approval = Approval(
        uav=last.uav,
        t=time.time(),
        proposal=last.proposal,
        option=last.option,
        digest=last.digest,
        who=person(args),
        undo=True,
    )
    return send_approval(bus, approval)
