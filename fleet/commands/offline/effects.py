"""List the physics a simulation may lack: every effect, its parameters and equation, and what it is confused with."""

import argparse
import difflib
import sys
import textwrap
from itertools import zip_longest
from typing import Any

import msgspec
import numpy as np

from fleet.effects import FOLDERS, Body, Effect, Parameter, catalogue

EXAMPLES = """
  fleet effects                       all of them in one table
  fleet effects icing                 one of them: source, meaning, bounds, what it is confused with
  fleet effects icing --json          the same for a machine
  PARAUAV_EFFECTS=mine fleet effects  with those of a folder of your own
"""

TITLES = ("name", "where", "parameters", "equation")
WIDTHS = (28, 19, 28, 43)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="one effect, and everything about it")
    parser.add_argument("--json", action="store_true", help="everything as JSON")


def run(args: argparse.Namespace) -> int:
    """Print one effect, or the table of all.

    Raises:
        ValueError: when there is no such effect, or a file of a folder of effects is broken.
    """
    known = catalogue()
    chosen = [_found(known, args.name)] if args.name else list(known.values())
    if args.json:
        described = msgspec.json.encode({effect.name: as_json(effect) for effect in chosen})
        print(msgspec.json.format(described, indent=2).decode())
    elif args.name:
        print(as_text(chosen[0]))
    else:
        print("\n".join((_columns(TITLES), *(row for effect in chosen for row in as_rows(effect)))))
    return 0


def _found(known: dict[str, Effect], name: str) -> Effect:
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, cutoff=0.4)
    such = f"such as {', '.join(near)}" if near else f"of the {len(known)} known"
    raise ValueError(f"found {name!r}, expected an effect {such}; see `fleet effects`, or name its folder in {FOLDERS}")


def as_rows(effect: Effect) -> list[str]:
    """Return the lines of one effect in the table, each cell wrapped in its own column."""
    cells = (
        [effect.name],
        [f"{effect.stage}, {effect.channel}"],
        [f"{p.name} [{p.unit}]" for p in effect.parameters],
        textwrap.wrap(effect.equation, WIDTHS[-1] - 1),
    )
    return [_columns(row) for row in zip_longest(*cells, fillvalue="")]


def _columns(row: tuple[str, ...]) -> str:
    return "".join(f"{cell:{width - 1}} " for cell, width in zip(row, WIDTHS, strict=True)).rstrip()


def as_text(effect: Effect) -> str:
    """Describe one effect for a reader."""
    facts = {
        "equation": effect.equation,
        "source": effect.source,
        "where": f"{effect.stage}, {effect.channel}" + (", seen in the scatter alone" if effect.variance else ""),
        "may befall": ", ".join(effect.of) or "the aircraft",
        "comes as": ", ".join(effect.onsets),
        "told as": ", ".join(told_names(effect)),
        "examples": "; ".join(", ".join(f"{x:g}" for x in example) for example in effect.examples),
        "search from": "; ".join(", ".join(f"{x:g}" for x in start) for start in effect.starts) or "zero",
    }
    lines = [*_wrapped(f"{effect.name}   ", summary(effect)), ""]
    lines += [row for name, fact in facts.items() for row in _wrapped(f"  {name:12} ", fact)]
    lines += ["", "  parameters, all zero when there is nothing:", *map(_parameter, effect.parameters)]
    if effect.confused:
        lines += ["", "  confused with, and told apart by:"]
    lines += [row for rival, how in effect.confused.items() for row in _wrapped(f"    {rival:27} ", how)]
    return "\n".join(lines)


def _parameter(p: Parameter) -> str:
    return f"    {p.name:20} {'[' + p.unit + ']':8} {p.low:>6g} to {p.high:<6g} {p.meaning}"


def _wrapped(head: str, text: str) -> list[str]:
    return textwrap.wrap(text, 118, initial_indent=head, subsequent_indent=" " * len(head))


def summary(effect: Effect) -> str:
    """Return the first sentence of the effect's file."""
    own = [m for name, m in list(sys.modules.items()) if name.endswith(effect.name)]
    said = next((m.__doc__ for m in own if getattr(m, "EFFECT", None) is effect), None)
    return (said or "").strip().partition("\n")[0]


def told_names(effect: Effect) -> list[str]:
    """List the numbers it is reported in."""
    return list(effect.told(effect, np.array(effect.examples[0]), Body()))


def as_json(effect: Effect) -> dict[str, Any]:
    """Describe one effect for a machine."""
    plain = ("channel", "equation", "source", "examples", "of", "starts", "variance")
    return {
        "summary": summary(effect),
        "stage": effect.stage.value,
        **{name: getattr(effect, name) for name in plain},
        "onsets": [onset.value for onset in effect.onsets],
        "told": told_names(effect),
        "parameters": [vars(p) for p in effect.parameters],
        "confused": dict(effect.confused),
    }
