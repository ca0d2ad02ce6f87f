"""List the effects that a simulation may lack, with parameters, equation and effects they are confusable with."""

import argparse
import difflib
import sys
import textwrap
from itertools import zip_longest
from typing import Any

import msgspec
import numpy as np

from fleet.effects import FOLDERS_ENV, Body, Effect, catalogue
from fleet.report.detection_limits import MIN_FLIGHTS, DetectionLimit, LimitSource, describe_size, load_table

EXAMPLES = """
  fleet effects                       table of all effects
  fleet effects icing                 one effect: source, meaning, bounds, confusable effects
  fleet effects icing --json          the same as JSON
  PARAUAV_EFFECTS=mine fleet effects  with the effects of your own folder
"""

TITLES = ("name", "where", "parameters", "equation")
WIDTHS = (28, 19, 28, 43)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="effect to describe")
    parser.add_argument("--json", action="store_true", help="all details as JSON")


def run(args: argparse.Namespace) -> int:
    """Print one effect, or the table of all.

    Raises:
        ValueError: when there is no such effect, or a file of effects is invalid.
    """
    known = catalogue()
    chosen = [_lookup(known, args.name)] if args.name else list(known.values())
    if args.json:
        described = msgspec.json.encode({effect.name: as_json(effect) for effect in chosen})
        print(msgspec.json.format(described, indent=2).decode())
    elif args.name:
        print(as_text(chosen[0]))
    else:
        print("\n".join((_columns(TITLES), *(row for effect in chosen for row in as_rows(effect)))))
    return 0


def _lookup(known: dict[str, Effect], name: str) -> Effect:
    if name in known:
        return known[name]
    matches = difflib.get_close_matches(name, known, cutoff=0.4)
    suggestion = f"such as {', '.join(matches)}" if matches else f"of the {len(known)} known"
    raise ValueError(
        f"found {name!r}, expected an effect {suggestion}; see `fleet effects`, or name its folder in {FOLDERS_ENV}"
    )


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
    """Describe one effect as text."""
    facts = {
        "equation": effect.equation,
        "source": effect.source,
        "where": f"{effect.stage}, {effect.channel}" + (", visible in the variance only" if effect.variance else ""),
        "may affect": ", ".join(effect.targets) or "the aircraft",
        "onset": ", ".join(effect.onsets),
        "reported as": ", ".join(reported_names(effect)),
        "examples": "; ".join(", ".join(f"{x:g}" for x in example) for example in effect.examples),
        "search from": "; ".join(", ".join(f"{x:g}" for x in start) for start in effect.initial_guesses) or "zero",
    }
    lines = [*_wrapped(f"{effect.name}   ", summary(effect)), ""]
    lines += [row for name, fact in facts.items() for row in _wrapped(f"  {name:12} ", fact)]
    lines += ["", "  parameters, all zero without the effect:"]
    for p in effect.parameters:
        lines.append(f"    {p.name:20} {'[' + p.unit + ']':8} {p.low:>6g} to {p.high:<6g} {p.meaning}")
    if effect.confusable_with:
        lines += ["", "  confusable with, and distinguished by:"]
    lines += [
        row for other, difference in effect.confusable_with.items() for row in _wrapped(f"    {other:27} ", difference)
    ]
    if known := limits_of(effect):
        lines += ["", "  magnitude named with 90 % probability, in flights with this effect concealed:"]
    for source, one in known:
        what = f"{one.parameter} {one.part}".rstrip()
        size = f"{what} none up to {describe_size(one.parameter, one.largest)}"
        if one.limit is not None:
            size = f"{what} {describe_size(one.parameter, one.limit)}"
        elif one.flights < MIN_FLIGHTS:
            size = f"{what} not known, too few flights"
        text = f"{size}, {one.named} of {one.flights} named; {source.aircraft}, against {source.reference}"
        lines += _wrapped("    ", f"{text}, {source.made}")
    return "\n".join(lines)


def limits_of(effect: Effect) -> list[tuple[LimitSource, DetectionLimit]]:
    """Return the measured limits of detection of an effect, with their origin."""
    return [(source, one) for source in load_table().sources for one in source.limits if one.effect == effect.name]


def _wrapped(head: str, text: str) -> list[str]:
    return textwrap.wrap(text, 118, initial_indent=head, subsequent_indent=" " * len(head))


def summary(effect: Effect) -> str:
    """Return the first line of the docstring of the effect's module."""
    modules = [m for name, m in list(sys.modules.items()) if name.endswith(effect.name)]
    doc = next((m.__doc__ for m in modules if getattr(m, "EFFECT", None) is effect), None)
    return (doc or "").strip().partition("\n")[0]


def reported_names(effect: Effect) -> list[str]:
    """List the names of the reported numbers."""
    return list(effect.reported(effect, np.array(effect.examples[0]), Body()))


def as_json(effect: Effect) -> dict[str, Any]:
    """Describe one effect as a JSON object."""
    names = ("channel", "equation", "source", "examples", "targets", "initial_guesses", "variance")
    return {
        "summary": summary(effect),
        "stage": effect.stage.value,
        **{name: getattr(effect, name) for name in names},
        "onsets": [onset.value for onset in effect.onsets],
        "told": reported_names(effect),
        "parameters": [vars(p) for p in effect.parameters],
        "confused": dict(effect.confusable_with),
        "detection_limits": [
            {"origin": source.origin, **msgspec.to_builtins(one)} for source, one in limits_of(effect)
        ],
    }
