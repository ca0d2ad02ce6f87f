"""Address of the router and credentials: `--router` and `--config FILE`, as in `deploy/fleet.toml`."""

import argparse
import tomllib
from pathlib import Path

from fleet.access.entry import ROUTER, BusConfig, parse_endpoint
from fleet.access.roles import TOOLS

KEYS = ("at", "certificates", "passwords")
MAX_UAVS = 2_000  # aircraft of one gateway, over all links, unless `--most-uavs` is given


def router_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--router` and `--config`, the same for every command."""
    parser.add_argument("--router", metavar="ENDPOINT", help=f"address of the Zenoh router ({ROUTER})")
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="address of the router and credentials (deploy/fleet.toml)"
    )


def bus_config_from(args: argparse.Namespace, role: str = TOOLS) -> BusConfig:
    """Return the bus configuration of this process from the command line.

    Raises:
        ValueError: when the file is invalid; the text names the key.
        OSError: when it cannot be read.
    """
    settings = {} if args.config is None else _read_router_table(args.config)
    # absolute: the output of `fleet router` is read in another folder, zenohd under systemd runs in /
    paths = {n: args.config.absolute().parent / settings[n] for n in ("certificates", "passwords") if n in settings}
    return BusConfig(args.router or settings.get("at", ROUTER), role, **paths)


LOOPBACK = ("127.0.0.1", "::1", "localhost")


def has_operators(option: str, bus_config: BusConfig) -> bool:
    """Return whether the router knows who is an operator; False on loopback, where every process may approve.

    Args:
        option: that needs it, for the error
        bus_config: address of the router and credentials
    Raises:
        ValueError: when other machines could approve without the certificate of an operator.
    """
    if not bus_config.identifies_roles and parse_endpoint(bus_config.endpoint)[0] not in LOOPBACK:
        raise ValueError(
            f"{option}: found router {bus_config.endpoint} without certificates or passwords, expected them: "
            "only an operator may approve; name them in the file of --config, see deploy/README.md"
        )
    return bus_config.identifies_roles


def router_options(args: argparse.Namespace) -> list[str]:
    """Return the router options of the command line, for a child process."""
    router = [] if args.router is None else [f"--router={args.router}"]
    return router + ([] if args.config is None else [f"--config={args.config.absolute()}"])


def _read_router_table(path: Path) -> dict[str, str]:
    """Read the table `router` of a file; reject any other content."""
    if path.is_dir():
        raise ValueError(f"--config: found a folder {str(path)!r}, expected a TOML file; name a file in it")
    if not path.exists():
        raise ValueError(
            f"--config: found no file {str(path)!r}, expected one such as deploy/fleet.toml; check the path"
        )
    try:
        document = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(
            f"--config: found invalid TOML in {path} ({error}), expected a table [router]; see deploy/fleet.toml"
        ) from None
    router = document.pop("router", {})
    unknown_keys = (
        [*document, *(name for name in router if name not in KEYS)] if isinstance(router, dict) else ["router"]
    )
    if unknown_keys:
        raise ValueError(
            f"--config: found {', '.join(map(repr, unknown_keys))} in {path}, expected only [router] with "
            f"{', '.join(KEYS)}; correct it"
        )
    if not all(isinstance(value, str) and value for value in router.values()):
        raise ValueError(f"--config: found a value that is not a string in {path}, expected strings; put it in quotes")
    return router
