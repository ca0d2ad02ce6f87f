"""Check this machine, the connection to the bus, and the fleet: one line per check, with a remedy where needed.

Each line is `ok`, `note` (something optional is missing) or `BAD` (exit code 1). With a router: certificates, clocks
and sources of all machines, the writer of each aircraft, aircraft without writer or with two; late clocks of aircraft,
stalled predictions, and two writers of one key. A port that another program uses is named with that program.
"""

import argparse
import json
import platform
import sys
from collections.abc import Iterator

from fleet.access.entry import BusConfig
from fleet.bus.session import connect
from fleet.config import bus_config_from, router_arguments
from fleet.contract import GatewayCounters
from fleet.health import claims, machine, ports, traffic
from fleet.health.machine import BAD, CheckResult
from fleet.process.sanitise import printable

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
    findings = []
    for finding in _checks(bus_config_from(args)):
        findings.append(finding)
        if not args.json:
            print(f"{finding.grade:5} {finding.what:14} {printable(finding.sentence)}", flush=True)
    if args.json:
        json.dump([finding._asdict() for finding in findings], sys.stdout, indent=1)
        print()
    return int(any(finding.grade == BAD for finding in findings))


def _checks(bus_config: BusConfig) -> Iterator[CheckResult]:
    yield from machine.check_machine()
    yield ports.viewer_port()
    yield from claims.check_certificates(bus_config)
    reachable = yield from claims.check_router(bus_config)
    if not reachable:
        yield ports.mavlink_port()
        return
    try:
        bus = connect(bus_config)
    except ConnectionError as error:
        yield CheckResult(BAD, "router", f"{error}{claims.at_router_port(bus_config)}")
        return
    with bus:
        local = [counters for counters, _ in bus.get(GatewayCounters) if counters.machine == platform.node()]
        yield ports.mavlink_port([link for counters in local for link in counters.links])
        yield from claims.check_fleet(bus)
        yield from traffic.check_traffic(bus)
