"""Periods of each kind of work, in data time."""

import argparse
from dataclasses import dataclass, fields
from enum import StrEnum

import msgspec
import numpy as np

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


class Timer(msgspec.Struct):
    """When a task was last done. It is due after its period, and also when the clock was set back.

    Attributes:
        last: time of the last run [s since 1970]; -inf before any
    """

    last: float = -np.inf

    def due(self, now: float, period: float) -> bool:
        """Return whether the task is due at `now`, `period` after its last run [s]."""
        return not self.last <= now < self.last + period

    def restart(self, now: float) -> None:
        """Start a period at `now`."""
        self.last = now

    def expire(self) -> None:
        """Make the task due at once."""
        self.last = -np.inf
