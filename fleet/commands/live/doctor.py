"""Check this machine, the connection to the bus, and the fleet: one line per check, with a remedy where needed.

Each line is `ok`, `note` (something optional is missing) or `BAD` (exit code 1). With a router: certificates, clocks
and sources of all machines, the writer of each aircraft, aircraft without writer or with two.
"""

import argparse
import json
import platform
import sys
from collections.abc import Iterator

from fleet.access.entry import Entry
from fleet.bus.session import connect
from fleet.config import entry, router_arguments
from fleet.contract import Account
from fleet.health import claims, door, machine
from fleet.health.finding import BAD, Finding
from fleet.process.sanitise import plain

EXAMPLES = """
  fleet doctor
  fleet doctor --router tcp/127.0.0.1:7448
  fleet doctor --config fleet.toml
  fleet doctor --json
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    router_arguments(parser)
    parser.add_argument("--json", action="store_true", help="a list of objects instead of lines")


def run(args: argparse.Namespace) -> int:
    """Print every finding; return exit code 1 if one of them is BAD."""
    found = []
    for finding in _looked(entry(args)):
        found.append(finding)
        if not args.json:
            print(f"{finding.grade:5} {finding.what:14} {plain(finding.sentence)}", flush=True)
    if args.json:
        json.dump([finding._asdict() for finding in found], sys.stdout, indent=1)
        print()
    return int(any(finding.grade == BAD for finding in found))


def _looked(at: Entry) -> Iterator[Finding]:
    yield from machine.look()
    yield from door.papers(at)
    there = yield from door.router(at)
    if not there:
        yield machine.mavlink_port()
        return
    try:
        bus = connect(at)
    except ConnectionError as error:
        yield Finding(BAD, "router", str(error))
        return
    with bus:
        here = [account for account, _ in bus.ask(Account) if account.machine == platform.node()]
        yield machine.mavlink_port([link for account in here for link in account.links])
        yield from claims.look(bus)
