"""Windows of a scenario: identify on one stretch, score on the next 40 s."""

from dataclasses import dataclass

from .flight import Case
from .score import AHEAD_S


@dataclass(frozen=True)
class Span:
    """One window of one case: identified on rows start .. at, scored on rows at .. stop."""

    start: int
    at: int
    stop: int


def spans(cases: list[Case], seconds: float, hop_s: float, most: int | None) -> list[list[Span]]:
    """Lay windows of `seconds` every `hop_s` into every case, in the order of time.

    With a limit every case gives its first windows alike, so that no aircraft speaks for all.
    """
    laid = [_laid(case, seconds, hop_s) for case in cases]
    turns = [(k, i) for i, found in enumerate(laid) for k in range(len(found))]
    kept = set(sorted(turns)[:most])
    return [[span for k, span in enumerate(found) if (k, i) in kept] for i, found in enumerate(laid)]


def _laid(case: Case, seconds: float, hop_s: float) -> list[Span]:
    dt = case.flight.dt
    n, hop, ahead = round(seconds / dt), round(hop_s / dt), round(AHEAD_S / dt)
    first = max(n, ahead)  # the same windows are scored whatever their length, up to 40 s
    ends = range(first, len(case.flight) - ahead + 1, hop)
    return [Span(at - n, at, at + ahead) for at in ends]
