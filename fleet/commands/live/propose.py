"""Show which changes of plan avoid what is predicted for the aircraft; nothing is sent to them."""

import argparse
import json
import sys
from typing import Any

import msgspec
import numpy as np

from fleet.bus.session import Bus, connect
from fleet.config import bus_config_from, router_arguments
from fleet.contract import FleetState, Option, Proposal, ProposedPath
from fleet.frames import Origin, to_geodetic
from fleet.process.sanitise import printable

EXAMPLES = """
  fleet propose                     all proposals in force
  fleet propose 7 8                 of two aircraft, computed now where none is in force
  fleet propose 7 --json            with the predicted paths, in degrees and metres
"""
_TIMEOUT_S = 10.0  # about 20 experiments for each aircraft of a cluster of conflicts


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("uavs", type=int, nargs="*", metavar="uav", help="UAV ids; none: all proposals in force")
    parser.add_argument("--json", action="store_true", help="the complete proposals, in degrees and metres")
    router_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Query the proposals and print their options as a table; exit code 1 where an aircraft does not reply.

    Raises:
        ValueError: when the worker rejects the request; with the reason.
    """
    with connect(bus_config_from(args)) as bus:
        proposals = query(bus, args.uavs)
        silent = [uav for uav in args.uavs if all(proposal.uav != uav for proposal in proposals)]
        has_worker = bool(proposals) or bool(args.uavs) or bool(bus.get(FleetState))
    if args.json:
        json.dump([as_object(proposal) for proposal in proposals], sys.stdout, indent=1)
        print()
    elif proposals:
        print("\n\n".join(format_text(proposal) for proposal in proposals))
    elif has_worker and not silent:
        print("no proposals: nothing is predicted that a change of plan would avoid")
    names = [f"uav {uav}" for uav in silent] or ([] if has_worker else ["fleet"])
    for name in names:
        print(f"{name}: found no worker that replies, expected one; see `fleet status`", file=sys.stderr)
    return 1 if names else 0


def query(bus: Bus, uavs: list[int]) -> list[Proposal]:
    """Return the proposals in force of all aircraft; of named aircraft without any, a proposal computed now.

    Raises:
        ValueError: when a worker rejects the request.
    """
    if not uavs:
        return [proposal for proposal, _ in bus.get(Proposal)]
    proposals: list[Proposal] = []
    for uav in dict.fromkeys(uavs):
        replies = [proposal for proposal, _ in bus.get(Proposal, uav, _TIMEOUT_S)]
        if not replies and (reply := bus.get_one(Proposal, uav, b"", _TIMEOUT_S)) is not None:
            replies = [reply[0]]
        proposals += replies
    return proposals


def format_text(proposal: Proposal) -> str:
    """Format the options of a proposal as a table."""
    if not proposal.options:
        return printable(proposal.sentence)
    before = "–" if proposal.probability is None else f"{proposal.probability:.0%}"
    lines = [
        f"{printable(proposal.sentence)}   id {printable(proposal.id)}",
        "     probability  clearance m  delay s  energy  deviation m  option",
    ]
    for number, option in enumerate(proposal.options, start=1):
        change = f"{before} > {option.probability:.0%}"
        lines.append(
            f"{number:3}  {change:>11}  {_clearance(option):>11}  {option.delay_s:7.0f}  {option.energy - 1:+6.0%}  "
            f"{option.deviation_m:11.0f}  {printable(option.sentence)}"
        )
    return "\n".join(lines)


def _clearance(option: Option) -> str:
    """Return the clearance [m]; a dash where nothing is near."""
    return f"{option.clearance_m:.0f}" if option.clearance_m < 1e5 else "–"


def as_object(proposal: Proposal) -> dict[str, Any]:
    """Return a proposal for JSON: lists instead of packed arrays, and geodetic positions."""
    out: dict[str, Any] = msgspec.to_builtins(msgspec.structs.replace(proposal, options=()))
    out["options"] = [
        msgspec.to_builtins(msgspec.structs.replace(option, paths=())) | {"paths": [_path(one) for one in option.paths]}
        for option in proposal.options
    ]
    return out


def _path(path: ProposedPath) -> dict[str, Any]:
    positions = to_geodetic(Origin(*path.origin), path.path.numpy())
    return {
        "uav": path.uav,
        "ahead": np.round(path.ahead.numpy().astype(float), 2).tolist(),
        "places": [[lat * 1e-7, lon * 1e-7, alt * 1e-3] for lat, lon, alt in positions.tolist()],
        "prediction_region_half_axes": np.round(path.prediction_region_half_axes.numpy().astype(float), 2).tolist(),
    }
