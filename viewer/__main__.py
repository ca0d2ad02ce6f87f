"""Command `viewer`: serve the operator page."""

import argparse
import gc
import logging
import sys
from contextlib import ExitStack

from fleet.access.roles import OPERATOR, VIEWER
from fleet.cli import check_port, make_parser, run_command, stop_on_signal
from fleet.config import LOOPBACK, bus_config_from, has_operators, router_arguments
from fleet.process.file_options import input_file
from fleet.process.logs import log_arguments, report_status
from fleet.process.malloc_trim import enable_malloc_trim
from fleet.report.changes import user_name

GC_THRESHOLDS = 50_000, 10, 10  # a large fleet allocates 10,000 objects per second, almost none in cycles
LARGE_BLOCK_BYTES = 48 * 1024  # below a receive buffer of the bus, which one queued message keeps allocated [bytes]
EXAMPLES = """
  viewer
  viewer --port 8081 --light
  viewer --terrain dem.tif --imagery aerial.png@47.30,8.40,47.45,8.60
  viewer --terrain N47E008.hgt --map region.mbtiles
  viewer --router tcp/10.0.0.5:7447
  viewer --allow approvals --config fleet.toml --who "Kim Lee"     buttons that approve proposals, as an operator
"""
APPROVALS = "approvals"
"""What `--allow` allows."""
_log = logging.getLogger(__name__)


def main(argv: list[str] | None = None) -> int:
    """Run `viewer`."""
    parser = make_parser(
        "viewer", "Show the fleet in a browser: flown paths, predictions and their confidence.", EXAMPLES
    )
    parser.add_argument("--port", type=int, default=8080, help="port of the page (default 8080)")
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to serve on (default 127.0.0.1: this machine only; the page has no password: "
        "use an authenticating reverse proxy for remote access)",
    )
    router_arguments(parser)
    log_arguments(parser)
    parser.add_argument(
        "--name",
        default="",
        help="host name of the page behind a reverse proxy; other remote host names are refused",
    )
    parser.add_argument(
        "--terrain",
        metavar="FILE",
        help="ground elevation in metres: GeoTIFF, SRTM (.hgt), or FILE@south,west,north,east",
    )
    parser.add_argument(
        "--imagery", metavar="FILE", help="ground imagery: GeoTIFF, PNG or JPEG, or FILE@south,west,north,east"
    )
    parser.add_argument(
        "--areas",
        type=input_file("a GeoJSON file"),
        metavar="FILE",
        help="geofence areas drawn on the map: GeoJSON polygons, as in twin_worker --help",
    )
    parser.add_argument("--map", metavar="FILE", help="map tiles: MBTiles or PMTiles with PNG, JPEG or WebP images")
    parser.add_argument(
        "--allow",
        choices=(APPROVALS,),
        help="show buttons that approve proposals, with the certificate or password of the role operator (off)",
    )
    parser.add_argument("--who", metavar="NAME", help="the person who approves on this page (user@machine)")
    parser.add_argument("--light", action="store_true", help="light theme, for bright surroundings")
    return run_command("viewer", run, parser.parse_args(argv))


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C or SIGTERM.

    Raises:
        ValueError: when the port is out of range.
        OSError: when the port is in use.
    """
    check_port("--port", args.port)
    _check_approvals(args)
    from fleet.bus.session import connect, receive_on_one_thread  # here, as --help and --version need none of these
    from fleet.terrain.areas import read_areas
    from fleet.terrain.raster import read_raster
    from viewer.browser.http_server import serve, stop_server
    from viewer.scene.map.tiles import open_tiles
    from viewer.scene.terrain import TerrainLayer
    from viewer.server.app import App

    terrain = read_raster(args.terrain, colours=False) if args.terrain else None
    imagery = read_raster(args.imagery, colours=True) if args.imagery else None
    tiles = open_tiles(args.map) if args.map else None
    areas = read_areas(args.areas) if args.areas else ()
    stop = stop_on_signal()
    gc.set_threshold(*GC_THRESHOLDS)
    receive_on_one_thread()
    enable_malloc_trim(LARGE_BLOCK_BYTES)
    terrain_layer = TerrainLayer(terrain, imagery, tiles)
    with ExitStack() as stack:
        bus = stack.enter_context(connect(bus_config_from(args, VIEWER), retry=True))  # the page shows a missing router
        approver = None
        if args.allow == APPROVALS:  # a session of its own: the page itself cannot approve
            operator = stack.enter_context(connect(bus_config_from(args, OPERATOR), retry=True))
            approver = operator.publish, args.who or user_name()
        server = serve(args.host, args.port, args.name)
        try:
            app = App(bus, server, light=args.light, terrain_layer=terrain_layer, areas=areas, approver=approver)
            report_status("viewer", f"http://{args.host}:{args.port}")
            app.run(stop)
        finally:
            stop_server(server)
    return 0


def _check_approvals(args: argparse.Namespace) -> None:
    """Check the options of approvals.

    Raises:
        ValueError: when other machines could approve without the credentials of an operator.
    """
    if args.allow is None:
        if args.who is not None:
            raise ValueError(
                f"--who: found {args.who!r} without --allow approvals, expected it; add it or leave this out"
            )
        return
    if args.host not in LOOPBACK:
        raise ValueError(
            f"--allow approvals: found --host {args.host}, expected 127.0.0.1: the page has no password, and whoever "
            "opens it can approve; serve it through an authenticating reverse proxy with --name"
        )
    if not has_operators("--allow approvals", bus_config_from(args, OPERATOR)):
        _log.warning("approvals are allowed on a router without roles: every process of this machine can approve")


if __name__ == "__main__":
    sys.exit(main())
