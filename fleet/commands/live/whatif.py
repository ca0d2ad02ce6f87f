"""Predict an aircraft with another mission, speed, position, wind or parameters; nothing is sent to the aircraft."""

import argparse
import json
import sys
from math import radians
from pathlib import Path

import msgspec
import numpy as np

from fleet.bus.bus_protocol import Bus
from fleet.bus.session import connect
from fleet.config import entry, router_arguments
from fleet.contract import Prediction, WhatIf, WhatIfStart
from fleet.frames import to_geodetic, to_ned
from fleet.process.sanitise import plain
from fleet.telemetry.mavlink.microservices.waypoints import read_waypoints

EXAMPLES = """
  fleet whatif 7 --speed 18
  fleet whatif 7 --items other.waypoints --seq 3
  fleet whatif 7 --start 47.4,8.5,600,90,22       latitude, longitude, metres above sea, heading, airspeed
  fleet whatif 7 --wind 6,-2 --param NAVL1_PERIOD=25 --json
"""
_SHOWN_S = (0, 5, 10, 20, 30, 45, 60, 92, 120, 180)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("uav", type=int, help="UAV id")
    parser.add_argument("--items", type=Path, metavar="FILE", help="another mission, a QGC WPL 110 file")
    parser.add_argument("--seq", type=int, metavar="N", help="item to fly to first")
    parser.add_argument("--speed", type=float, metavar="M/S", help="another airspeed; of a multirotor, ground speed")
    parser.add_argument(
        "--start", type=_numbers, metavar="LAT,LON,ALT[,DEG[,M/S]]", help="another position; --start=-33,… if south"
    )
    parser.add_argument("--wind", type=_numbers, metavar="N,E", help="another wind, the direction it blows to [m/s]")
    parser.add_argument("--param", action="append", default=[], metavar="NAME=VALUE", help="a parameter; repeatable")
    parser.add_argument("--json", action="store_true", help="the complete prediction, in degrees and metres")
    router_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Query the what-if and print its path compared with the current prediction; exit code 1 without a reply.

    Raises:
        ValueError: when an option is invalid, or the worker rejects the request; with the reason.
    """
    asked = question(args)
    with connect(entry(args)) as bus:
        made, usual = ask(bus, args.uav, asked), next((p for p, _ in bus.ask(Prediction, args.uav)), None)
    if made is None:
        print(f"uav {args.uav}: found no worker that replies, expected one; see `fleet status`", file=sys.stderr)
        return 1
    if args.json:
        json.dump(as_object(made), sys.stdout, indent=1)
        print()
    else:
        print(text(made, usual))
    return 0


def _numbers(words: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {words!r}, expected numbers separated by commas") from None


def question(args: argparse.Namespace) -> WhatIf:
    """Build the request from the options.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    if args.wind is not None and len(args.wind) != 2:
        raise ValueError(f"--wind: found {len(args.wind)} numbers, expected north and east; write e.g. --wind=6,-2")
    params = {}
    for pair in args.param:
        name, _, value = pair.partition("=")
        try:
            params[name] = float(value)
        except ValueError:
            raise ValueError(f"--param: found {pair!r}, expected NAME=VALUE such as NAVL1_PERIOD=25") from None
    return WhatIf(
        items=read_waypoints(args.items) if args.items else None,
        seq=args.seq,
        speed=args.speed,
        start=_start(args.start) if args.start else None,
        wind=args.wind,
        params=params,
    )


def _start(numbers: tuple[float, ...]) -> WhatIfStart:
    if not 3 <= len(numbers) <= 5 or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e6:
        raise ValueError(f"--start: found {numbers}, expected LAT,LON,ALT[,DEG[,M/S]]; correct it")
    lat, lon, alt, *more = numbers
    heading, speed = (*more, None, None)[:2]
    return WhatIfStart(
        lat_e7=round(lat * 1e7),
        lon_e7=round(lon * 1e7),
        alt_mm=round(alt * 1e3),
        heading=None if heading is None else radians(heading),
        speed=speed,
    )


def ask(bus: Bus, uav: int, asked: WhatIf) -> Prediction | None:
    """Send the request; None without a reply."""
    found = bus.inquire(Prediction, uav, msgspec.msgpack.encode(asked))
    return found[0] if found else None


def as_object(made: Prediction) -> dict[str, object]:
    """Return a prediction for JSON: lists instead of packed arrays, and geodetic positions."""
    out = msgspec.to_builtins(made, builtin_types=(bytes,))
    places = to_geodetic(made.ned_origin(), made.path.numpy())
    for name in ("ahead", "path", "tube"):
        out[name] = np.round(getattr(made, name).numpy().astype(float), 3).tolist()
    out["held"] = made.held if made.held == made.held else None
    out["places"] = [[lat * 1e-7, lon * 1e-7, alt * 1e-3] for lat, lon, alt in places.tolist()]
    return out


def text(made: Prediction, usual: Prediction | None) -> str:
    """Format the path as a table, with the deviation from the reference prediction."""
    ahead, path, tube = (a.numpy().astype(float) for a in (made.ahead, made.path, made.tube))
    places = to_geodetic(made.ned_origin(), path)
    flown = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    off = _apart(made, usual)
    lines = [plain(made.sentence), f"{plain(made.method)} · {plain(made.law)} · horizon {made.horizon_s:.0f} s"]
    lines.append("   in s    latitude   longitude  alt m  length m  tube m   deviation m")
    for at in (s for s in _SHOWN_S if s <= ahead[-1]):
        k = int(np.argmin(np.abs(ahead - at)))
        lat, lon, alt = places[k] * [1e-7, 1e-7, 1e-3]
        apart = f"{off[k]:13.0f}" if off is not None else f"{'–':>13}"
        lines.append(f"{ahead[k]:7.0f} {lat:11.5f} {lon:11.5f} {alt:6.0f} {flown[k]:9.0f} {tube[k].max():7.0f} {apart}")
    return "\n".join(lines)


def _apart(made: Prediction, usual: Prediction | None) -> np.ndarray | None:
    """Return the distance to the reference prediction at the same times, (n,) [m]; nan beyond its end."""
    if usual is None or not usual.path.shape[0]:
        return None
    t = made.t + made.ahead.numpy().astype(float)
    then = usual.t + usual.ahead.numpy().astype(float)
    lat_lon_alt = to_geodetic(usual.ned_origin(), usual.path.numpy())
    there = to_ned(made.ned_origin(), *lat_lon_alt.T)
    there = np.column_stack([np.interp(t, then, column, left=np.nan, right=np.nan) for column in there.T])
    return np.linalg.norm(made.path.numpy() - there, axis=1)
