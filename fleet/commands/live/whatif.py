"""Predict an aircraft with another mission, speed, position, wind or parameters; nothing is sent to the aircraft."""

import argparse
import json
import sys
from math import radians

import msgspec
import numpy as np

from fleet.bus.session import Bus, connect
from fleet.config import bus_config_from, router_arguments
from fleet.contract import Prediction, WhatIf, WhatIfStart
from fleet.frames import to_geodetic, to_ned
from fleet.process.file_options import input_file
from fleet.process.sanitise import printable
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
    parser.add_argument(
        "--items", type=input_file("a QGC WPL 110 file"), metavar="FILE", help="another mission, a QGC WPL 110 file"
    )
    parser.add_argument("--seq", type=int, metavar="N", help="item to fly to first")
    parser.add_argument("--speed", type=float, metavar="M/S", help="another airspeed; of a multirotor, ground speed")
    parser.add_argument(
        "--start",
        type=_read_numbers,
        metavar="LAT,LON,ALT[,DEG[,M/S]]",
        help="another position; --start=-33,… if south",
    )
    parser.add_argument(
        "--wind", type=_read_numbers, metavar="N,E", help="another wind, the direction it blows to [m/s]"
    )
    parser.add_argument("--param", action="append", default=[], metavar="NAME=VALUE", help="a parameter; repeatable")
    parser.add_argument("--json", action="store_true", help="the complete prediction, in degrees and metres")
    router_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Query the what-if and print its path compared with the current prediction; exit code 1 without a reply.

    Raises:
        ValueError: when an option is invalid, or the worker rejects the request; with the reason.
    """
    request = build_request(args)
    with connect(bus_config_from(args)) as bus:
        what_if = send_request(bus, args.uav, request)
        reference = next((p for p, _ in bus.get(Prediction, args.uav)), None)
    if what_if is None:
        print(f"uav {args.uav}: found no worker that replies, expected one; see `fleet status`", file=sys.stderr)
        return 1
    if args.json:
        json.dump(as_object(what_if), sys.stdout, indent=1)
        print()
    else:
        print(format_text(what_if, reference))
    return 0


def _read_numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected numbers separated by commas; correct it") from None


def build_request(args: argparse.Namespace) -> WhatIf:
    """Build the request from the options.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    if args.wind is not None and (len(args.wind) != 2 or not np.isfinite(args.wind).all()):
        given = ",".join(f"{value:g}" for value in args.wind)
        raise ValueError(f"--wind: found {given!r}, expected two numbers, north and east; write e.g. --wind=6,-2")
    params = {}
    for pair in args.param:
        name, _, value = pair.partition("=")
        try:
            params[name] = float(value)
        except ValueError:
            params[name] = float("nan")
        if not np.isfinite(params[name]):
            raise ValueError(f"--param: found {pair!r}, expected NAME=VALUE such as NAVL1_PERIOD=25; correct it")
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


def send_request(bus: Bus, uav: int, request: WhatIf) -> Prediction | None:
    """Send the request; None without a reply."""
    reply = bus.get_one(Prediction, uav, msgspec.msgpack.encode(request))
    return reply[0] if reply else None


def as_object(prediction: Prediction) -> dict[str, object]:
    """Return a prediction for JSON: lists instead of packed arrays, and geodetic positions."""
    out = msgspec.to_builtins(prediction, builtin_types=(bytes,))
    positions = to_geodetic(prediction.ned_origin(), prediction.path.numpy())
    for name in ("ahead", "path", "prediction_region_half_axes"):
        out[name] = np.round(getattr(prediction, name).numpy().astype(float), 3).tolist()
    out["coverage"] = prediction.coverage if prediction.coverage == prediction.coverage else None
    out["places"] = [[lat * 1e-7, lon * 1e-7, alt * 1e-3] for lat, lon, alt in positions.tolist()]
    return out


def format_text(prediction: Prediction, reference: Prediction | None) -> str:
    """Format the path as a table, with the deviation from the reference prediction."""
    ahead, path, half_axes = (
        a.numpy().astype(float) for a in (prediction.ahead, prediction.path, prediction.prediction_region_half_axes)
    )
    positions = to_geodetic(prediction.ned_origin(), path)
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    deviations = _deviation(prediction, reference)
    lines = [
        printable(prediction.sentence),
        f"{printable(prediction.method)} · {printable(prediction.law)} · horizon {prediction.horizon_s:.0f} s",
        "   in s    latitude   longitude  alt m  length m  tube m   deviation m",
    ]
    for lead_s in (s for s in _SHOWN_S if s <= ahead[-1]):
        k = int(np.argmin(np.abs(ahead - lead_s)))
        lat, lon, alt = positions[k] * [1e-7, 1e-7, 1e-3]
        deviation = f"{deviations[k]:13.0f}" if deviations is not None else f"{'–':>13}"
        lines.append(
            f"{ahead[k]:7.0f} {lat:11.5f} {lon:11.5f} {alt:6.0f} {distance[k]:9.0f} {half_axes[k].max():7.0f} "
            f"{deviation}"
        )
    return "\n".join(lines)


def _deviation(prediction: Prediction, reference: Prediction | None) -> np.ndarray | None:
    """Return the distance to the reference prediction at the same times, (n,) [m]; nan beyond its end."""
    if reference is None or not reference.path.shape[0]:
        return None
    t = prediction.t + prediction.ahead.numpy().astype(float)
    reference_t = reference.t + reference.ahead.numpy().astype(float)
    lat_lon_alt = to_geodetic(reference.ned_origin(), reference.path.numpy())
    reference_path = to_ned(prediction.ned_origin(), *lat_lon_alt.T)
    reference_path = np.column_stack(
        [np.interp(t, reference_t, column, left=np.nan, right=np.nan) for column in reference_path.T]
    )
    return np.linalg.norm(prediction.path.numpy() - reference_path, axis=1)
