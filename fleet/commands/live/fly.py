"""Fly simulated aircraft: wings on JSBSim, rotors on RotorPy, which send MAVLink 2 over UDP or into a recording."""

import argparse
from typing import TYPE_CHECKING

from fleet.cli import host_and_port, id_range, stop_on_signal
from fleet.process.file_options import output_file
from fleet.process.logs import report_status

if TYPE_CHECKING:
    from fleet.simulator.faults.physics import Fault
    from fleet.simulator.multirotor.uav import SimulatedMultirotor

EXAMPLES = """
  fleet fly --uavs 0-7
  fleet fly --uavs 0-49 --to 127.0.0.1:14550 --wind 6 --turbulence 4 --loss 0.05
  fleet fly --uavs 0-1 --autopilot px4 --aircraft c172p
  fleet fly --uavs 0-5 --aircraft mixed                    wings and quadrotors in turn
  fleet fly --uavs 0-3 --fault drag_increase,dCD=0.03,at=120 --fault actuator_lag:elevator,tau_s=0.3 --fault-uav 2
  fleet fly --uavs 0-7 --story conflict                    aircraft 0 and 1 meet after about 2 min
  fleet fly --uavs 0 --seed 3 --for 300 --tlog flight.tlog     as fast as possible, no network
"""
AUTOPILOTS = ("ardupilot", "px4")  # both as in `fleet.simulator.flight.tuning`, which loads slowly
AIRCRAFT = ("small", "c172p")
MULTIROTORS = ("quad", "quad_large")  # as in `fleet.simulator.multirotor.airframes`
GROUPS = {"plane": ("small",), "mixed": ("small", "quad")}  # taken in turn by the aircraft of one fleet
STORIES = ("conflict",)
CHOICES = (*AIRCRAFT, *MULTIROTORS, *GROUPS)
AIRCRAFT_HELP = "small (11 kg, electric) or plane, c172p, quad, quad_large, mixed: small and quad in turn (small)"
WIND_FIELDS = ("shared", "independent")
_DEFAULT_TLOG_S = 300.0  # length of a recording when --for is not given [s]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--uavs", type=id_range, default=range(8), metavar="A-B", help="aircraft ids (0-7)")
    parser.add_argument("--to", default="127.0.0.1:14550", metavar="HOST:PORT", help="destination of the frames")
    parser.add_argument(
        "--autopilot", choices=AUTOPILOTS, default="ardupilot", help="autopilot law and MAVLink dialect (ardupilot)"
    )
    parser.add_argument("--aircraft", choices=CHOICES, default="small", help=AIRCRAFT_HELP)
    parser.add_argument("--seed", type=int, default=1, help="random seed of aircraft, missions, weather and noise (1)")
    parser.add_argument("--wind", type=float, default=4.0, metavar="M/S", help="mean wind at 100 m (4)")
    parser.add_argument(
        "--turbulence",
        default="2",
        metavar="LEVEL",
        help="MIL-F-8785C: none, light (3), moderate (4), severe (6) or 0..7 (2, typical of a wind of 4 m/s)",
    )
    parser.add_argument(
        "--wind-field",
        choices=WIND_FIELDS,
        default=WIND_FIELDS[0],
        help="one field coherent in space and time for all aircraft, or an independent drift of each (shared)",
    )
    parser.add_argument("--loss", type=float, default=0.02, metavar="SHARE", help="share of frames lost (0.02)")
    parser.add_argument("--for", dest="seconds", type=float, metavar="S", help="duration (unlimited; 300 with --tlog)")
    fault_arguments(parser)
    parser.add_argument("--story", choices=STORIES, help="conflict: aircraft 0 and 1 meet, the others are far away")
    parser.add_argument("--tlog", type=output_file, metavar="FILE", help="write this .tlog as fast as possible instead")


def fault_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options for the faults of one aircraft."""
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME[:OF],KEY=VALUE,...[,at=S]",
        help="fault of one aircraft, from S seconds on; repeatable",
    )
    parser.add_argument("--fault-uav", type=int, metavar="ID", help="aircraft with the faults (the first)")


def run(args: argparse.Namespace) -> int:
    """Fly until stopped, or for the given time.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    from fleet.simulator.flight import drive  # loads JSBSim and the compiler: not for --help
    from fleet.simulator.flight.story import story_aircraft
    from fleet.simulator.flight.uav import SimulatedUav
    from fleet.simulator.vehicle.missions import HOME
    from fleet.simulator.vehicle.weather import turbulence_level
    from fleet.simulator.vehicle.wind_field import CoherentWind

    _check(args)
    stop = stop_on_signal()
    level = turbulence_level(args.turbulence)
    host, port = host_and_port("--to", args.to)
    field = CoherentWind.of_fleet(args.wind, args.seed, HOME) if args.wind_field == "shared" else None
    options = {"autopilot": args.autopilot, "wind": args.wind, "turbulence": level, "wind_field": field}
    faulty = faults_of(args, args.uavs)
    uavs: list[drive.SimulatedAircraft] = []
    if args.story:
        uavs += story_aircraft(len(args.uavs), args.seed, **options)
    for uav, aircraft in () if args.story else zip(args.uavs, aircraft_types(args.aircraft, args.uavs), strict=True):
        if aircraft in MULTIROTORS:
            uavs.append(_multirotor_class()(uav, args.seed, aircraft=aircraft, **options))
        else:
            uavs.append(SimulatedUav(uav, args.seed, aircraft=aircraft, faults=faulty.get(uav, ()), **options))
    if args.aircraft not in MULTIROTORS:
        report_status("fly", "compiling the autopilot, first start only")
        SimulatedUav(args.uavs[0], args.seed).step(0.2)
    if args.tlog is not None:
        seconds = args.seconds or _DEFAULT_TLOG_S
        title = f"flying into {args.tlog.name}"
        frames = drive.to_tlog(args.tlog, uavs, seconds=seconds, loss=args.loss, seed=args.seed, title=title, stop=stop)
        report_status("fly", f"{frames} frames of {len(uavs)} aircraft in {args.tlog}")
        return 0
    report_status("fly", f"{len(uavs)} aircraft in the air, sending to {host}:{port}")
    max_delay = drive.to_udp(uavs, (host, port), seconds=args.seconds, loss=args.loss, seed=args.seed, stop=stop)
    report_status("fly", f"stopped; at most {max_delay * 1e3:.0f} ms behind real time")
    return 0


def _multirotor_class() -> "type[SimulatedMultirotor]":
    """Return the class of simulated multirotors.

    Raises:
        ValueError: when RotorPy is not installed.
    """
    try:
        from fleet.simulator.multirotor.uav import SimulatedMultirotor
    except ModuleNotFoundError as error:
        if error.name is None or not error.name.startswith("rotorpy"):
            raise
        remedy = "pip install --no-deps rotorpy, or run make setup"
        raise ValueError(f"--aircraft: found no package rotorpy, expected it for multirotors; {remedy}") from None
    return SimulatedMultirotor


def aircraft_types(name: str, uavs: range) -> list[str]:
    """Return the type of each aircraft of a fleet; the types of a group alternate by id."""
    group = GROUPS.get(name, (name,))
    return [group[uav % len(group)] for uav in uavs]


def faults_of(args: argparse.Namespace, uavs: range) -> "dict[int, tuple[Fault, ...]]":
    """Return the faults by id of the one aircraft that has any.

    Raises:
        ValueError: when a fault is not applicable to the aircraft type, or the id is not simulated.
    """
    from fleet.simulator.faults.kinds import parse_fault

    uav = uavs[0] if args.fault_uav is None else args.fault_uav
    if args.fault_uav is not None and not args.fault:
        raise ValueError(f"--fault-uav: found {uav} without a fault, expected one; add --fault")
    if uav not in uavs:
        raise ValueError(f"--fault-uav: found {uav}, expected one of {uavs[0]}-{uavs[-1]}; change --fault-uav")
    aircraft = aircraft_types(args.aircraft, range(uav, uav + 1))[0]
    if args.fault and aircraft in MULTIROTORS:
        raise ValueError(f"--fault: found aircraft {aircraft}, expected wings; add --fault-uav or change --aircraft")
    faults = tuple(parse_fault(text, aircraft) for text in args.fault)
    return {uav: faults} if faults else {}


def _check(args: argparse.Namespace) -> None:
    if not 0 <= args.wind <= 15:
        raise ValueError(f"--wind: found {args.wind} m/s, expected 0..15 (cruise is 23 m/s); lower --wind")
    if not 0 <= args.loss < 1:
        raise ValueError(f"--loss: found {args.loss}, expected a share from 0 to below 1; write e.g. 0.02")
    if args.seed < 0:
        raise ValueError(f"--seed: found {args.seed}, expected an integer from 0; change --seed")
    if args.story and (args.aircraft != "small" or args.fault or args.uavs[0] != 0):
        given = f"--aircraft {args.aircraft}, {len(args.fault)} faults, first id {args.uavs[0]}"
        raise ValueError(f"--story: found {given}, expected small aircraft from id 0 without faults; leave these out")
    if args.seconds is not None and not args.seconds > 0:
        raise ValueError(f"--for: found {args.seconds} s, expected more than 0; change --for")
