"""Where the router is and what is shown there: `--router` and `--config FILE`, as in `deploy/fleet.toml`."""

import argparse
import tomllib
from pathlib import Path

from fleet.access.entry import ROUTER, Entry
from fleet.access.roles import TOOLS

KEYS = ("at", "certificates", "passwords")


def router_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--router` and `--config`, the same for every command."""
    parser.add_argument("--router", metavar="ENDPOINT", help=f"where the Zenoh router is ({ROUTER})")
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="the same, and what is shown there (deploy/fleet.toml)"
    )


def entry(args: argparse.Namespace, role: str = TOOLS) -> Entry:
    """Return this process's way onto the bus, as it was told on the command line.

    Raises:
        ValueError: when the file says what cannot be; the sentence names the line's key.
        OSError: when it cannot be read.
    """
    told = {} if args.config is None else _read(args.config)
    # absolute: what `fleet router` writes is read elsewhere, zenohd under systemd runs in /
    paths = {n: args.config.absolute().parent / told[n] for n in ("certificates", "passwords") if n in told}
    return Entry(args.router or told.get("at", ROUTER), role, **paths)


def passed_on(args: argparse.Namespace) -> list[str]:
    """Return the same as options for a process that is started here."""
    router = [] if args.router is None else [f"--router={args.router}"]
    return router + ([] if args.config is None else [f"--config={args.config.absolute()}"])


def _read(path: Path) -> dict[str, str]:
    """Read the table `router` of a file, which is all it may hold."""
    try:
        told = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(
            f"--config: found {path} is no TOML ({error}), expected [router] and a few keys; see deploy/fleet.toml"
        ) from None
    router = told.pop("router", {})
    strange = [*told, *(name for name in router if name not in KEYS)] if isinstance(router, dict) else ["router"]
    if strange:
        raise ValueError(
            f"--config: found {', '.join(map(repr, strange))} in {path}, expected [router] with {', '.join(KEYS)} at "
            "most; correct it"
        )
    if not all(isinstance(value, str) and value for value in router.values()):
        raise ValueError(f"--config: found a value that is no text in {path}, expected texts; put it in quotes")
    return router
