"""Write the configuration of a site's router, for `zenohd -c`: who may join, who may say what, how much at a time."""

import argparse
import json
from typing import Any

from fleet.access.entry import endpoint
from fleet.config import entry, router_arguments

HEAD = "// Made by `fleet router` from the table in fleet/access/roles.py: change that, and make it again."
WIDTH = 110
EXAMPLES = """
  fleet router > zenohd.json5                                                    loopback, in the clear
  fleet router --config fleet.toml --listen tls/0.0.0.0:7447 > zenohd.json5      certificates and rules by role
  fleet router --config fleet.toml --listen tls/0.0.0.0:7447 --beside tls/north.example:7447 > zenohd.json5
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    router_arguments(parser)
    parser.add_argument("--listen", action="append", metavar="ENDPOINT", help="where it listens (where it is)")
    parser.add_argument("--beside", action="append", metavar="ENDPOINT", help="another router of the site; repeatable")


def run(args: argparse.Namespace) -> int:
    """Print it."""
    at = entry(args)
    for given in (*(args.listen or ()), *(args.beside or ())):
        endpoint(given)
    print(text(at.router(args.listen, args.beside)))
    return 0


def text(settings: dict[str, Any]) -> str:
    """Write settings by path as nested JSON, a comment before it."""
    out: dict[str, Any] = {}
    for path, value in settings.items():
        *above, last = path.split("/")
        here = out
        for name in above:
            here = here.setdefault(name, {})
        here[last] = value
    return f"{HEAD}\n{_lines(out, '')}"


def _lines(value: Any, indent: str) -> str:
    """Write what fits on one line, and one item a line of the rest."""
    short = json.dumps(value)
    if len(indent) + len(short) <= WIDTH or not isinstance(value, dict | list):
        return short
    within = indent + "  "
    if isinstance(value, dict):
        parts = [f"{within}{json.dumps(name)}: {_lines(one, within)}" for name, one in value.items()]
        return "{\n" + ",\n".join(parts) + f"\n{indent}}}"
    return "[\n" + ",\n".join(within + _lines(one, within) for one in value) + f"\n{indent}]"
