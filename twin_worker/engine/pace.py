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
    """Periods.

    Attributes:
        predict: between flights ahead [s]
        identify: between identifications [s]
        ensemble: between ensembles [s]
        renew: between predictions that begin at the newest position without being flown anew; inf: none [s]
    """

    predict: float = 1.0
    identify: float = 1.0
    ensemble: float = 10.0
    renew: float = float("inf")


def read_pace(text: str) -> Pace:
    """Read `--pace predict=2,identify=5`.

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
        if name not in names or not 0.02 <= found[name] <= 3600.0:
            said = f"found {part!r}, expected one of {', '.join(names)} and seconds, e.g. identify=5; correct it"
            raise argparse.ArgumentTypeError(said)
    return Pace(**found)
