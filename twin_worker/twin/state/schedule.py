"""Periods of each kind of work, in data time."""

import argparse
from dataclasses import dataclass, fields
from enum import StrEnum

SOON = 0.9  # share of a period after which dependent work is due, so that jitter does not skip a cycle [-]


class Work(StrEnum):
    """Kinds of work in order of priority, highest first."""

    RENEW = "renew"
    PREDICT = "predict"
    IDENTIFY = "identify"
    ENSEMBLE = "ensemble"


@dataclass(frozen=True)
class Pace:
    """Periods of work, and the size of an ensemble.

    Attributes:
        predict: between rollouts [s]
        identify: between identifications [s]
        ensemble: between ensembles [s]
        renew: between predictions extrapolated from the newest position without a new rollout; inf: none [s]
        members: rollouts per ensemble
        span: look-ahead of ensemble rollouts; beyond it, the spread grows by the method's growth law [s]
    """

    predict: float = 1.0
    identify: float = 1.0
    ensemble: float = 10.0
    renew: float = float("inf")
    members: int = 24
    span: float = 180.0


_LIMITS = {"members": (12, 1000), "span": (10.0, 180.0)}  # of all other fields: `_PERIOD_LIMITS`
_PERIODS = (0.02, 3600.0)  # [s]


def read_pace(text: str) -> Pace:
    """Parse `--pace predict=2,identify=5,members=50`.

    Raises:
        argparse.ArgumentTypeError: when a name or a value is invalid; argparse prints the message.
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
