"""How often each kind of work is wanted, in data time; and who may do it now."""

import argparse
from dataclasses import dataclass, fields
from enum import StrEnum

SOON = 0.9  # share of a period after which work that follows telemetry or a flight is due: neither keeps the beat [-]


class Work(StrEnum):
    """Kinds of work, the first to be done and the last to give way first."""

    RENEW = "renew"
    PREDICT = "predict"
    IDENTIFY = "identify"
    ENSEMBLE = "ensemble"


@dataclass(frozen=True)
class Pace:
    """Periods, and how large an ensemble is.

    Attributes:
        predict: between flights ahead [s]
        identify: between identifications [s]
        ensemble: between ensembles [s]
        renew: between predictions that begin at the newest position without being flown anew; inf: none [s]
        members: flights of an ensemble
        span: how far ahead they fly; beyond, doubt grows as the method's law has it [s]
    """

    predict: float = 1.0
    identify: float = 1.0
    ensemble: float = 10.0
    renew: float = float("inf")
    members: int = 24
    span: float = 180.0


_LIMITS = {"members": (12, 1000), "span": (10.0, 180.0)}  # of others: periods
_PERIODS = (0.02, 3600.0)  # [s]


def read_pace(text: str) -> Pace:
    """Read `--pace predict=2,identify=5,members=50`.

    Raises:
        argparse.ArgumentTypeError: when it names no such work, or no time; argparse shows the sentence.
    """
    names = [field.name for field in fields(Pace)]
    found = {}
    for part in text.split(","):
        name, _, seconds = part.partition("=")
        try:
            found[name] = float(seconds)
        except ValueError:
            found[name] = float("nan")
        low, high = _LIMITS.get(name, _PERIODS)
        if name not in names or not low <= found[name] <= high:
            said = (
                f"found {part!r}, expected one of {', '.join(names)}, {low:g} to {high:g}, e.g. identify=5; correct it"
            )
            raise argparse.ArgumentTypeError(said)
    members = int(found.pop("members", Pace.members))
    return Pace(**found, members=members)  # type: ignore[arg-type]
