"""Periods of each kind of work, in data time."""

import argparse
from dataclasses import dataclass, fields
from enum import StrEnum

EARLY_FRACTION = 0.9  # share of a period after which dependent work is due, so that jitter does not skip a cycle [-]


class Work(StrEnum):
    """Kinds of work in order of priority, highest first."""

    RENEW = "renew"
    PREDICT = "predict"
    IDENTIFY = "identify"
    ENSEMBLE = "ensemble"


@dataclass(frozen=True)
class Schedule:
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
_PERIOD_LIMITS = (0.02, 3600.0)  # [s]


def parse_schedule(text: str) -> Schedule:
    """Parse `--pace predict=2,identify=5,members=50`.

    Raises:
        argparse.ArgumentTypeError: when a name or a value is invalid; argparse prints the message.
    """
    names = [field.name for field in fields(Schedule)]
    values = {}
    for part in text.split(","):
        name, _, seconds = part.partition("=")
        try:
            values[name] = float(seconds)
        except ValueError:
            values[name] = float("nan")
        low, high = _LIMITS.get(name, _PERIOD_LIMITS)
        if name not in names or not low <= values[name] <= high:
            error_text = (
                f"found {part!r}, expected one of {', '.join(names)}, {low:g} to {high:g}, e.g. identify=5; correct it"
            )
            raise argparse.ArgumentTypeError(error_text)
    members = int(values.pop("members", Schedule.members))
    return Schedule(**values, members=members)  # type: ignore[arg-type]
