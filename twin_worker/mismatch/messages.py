"""Build the published mismatch message: times on the fleet clock, finite numbers."""

from dataclasses import replace
from math import inf, isfinite

import msgspec

from fleet.contract import Cause, Found, Mismatch
from twin_worker.diagnosis.inference.report import Finding, Outcome, Report
from twin_worker.diagnosis.inference.words import sentence

_WILDEST = 100.0  # larger errors come from a diverged simulation and are not published [m/s2]


def message(uav: int, report: Report, begin: float, end: float) -> Mismatch:
    """Return the message of a report.

    Args:
        uav: UAV id
        report: its times count from `begin`
        begin, end: flight of the diagnosis [s since 1970]
    """
    causes = tuple(_cause(one, begin) for one in report.findings)
    if report.outcome is Outcome.UNKNOWN:
        channel, where = report.where
        causes = (Cause(name="unknown", channel=channel, segments=_on_the_clock(begin, where)), *causes)
    proven = report.outcome is not Outcome.NONE
    return Mismatch(
        uav=uav,
        t=end,
        outcome=Found(report.outcome.value),
        causes=causes if proven else (),
        fit_before=_or_none(report.fit_before),
        fit_after=_or_none(report.fit_after),
        force_before=_or_none(report.force_before, _WILDEST),
        force_after=_or_none(report.force_after, _WILDEST),
        stray_before=_or_none(report.stray_before),
        stray_after=_or_none(report.stray_after),
        seen_t0=begin,
        sentence=report.sentence,
    )


def since(report: Report, shift: float) -> Report:
    """Return the report with the times in its sentence shifted by `shift` [s]."""
    moved = [replace(one, guess=replace(one.guess, when=one.guess.when.moved(shift))) for one in report.findings]
    channel, segments = report.where
    where = channel, tuple((a + shift, b + shift) for a, b in segments)
    said = sentence(replace(report, findings=tuple(moved), where=where)).sentence
    return replace(report, sentence=said)


def unconfirmed(found: Mismatch) -> Mismatch:
    """Mark a mismatch as suspected until a second diagnosis confirms it."""
    return msgspec.structs.replace(
        found, outcome=Found.SUSPECTED, sentence=f"detected once, not confirmed: {found.sentence}"
    )


def word(found: Mismatch | None) -> str:
    """Return a short summary for the fleet table; empty if there is no mismatch."""
    if found is None or found.outcome is Found.NONE:
        return ""
    names = " and ".join(_place(one) for one in found.causes if one.name != "unknown")
    if found.outcome is Found.UNKNOWN:
        return f"unknown, in {found.causes[0].channel}" if found.causes else "unknown"
    return f"{found.outcome.value} {names}".rstrip()


def judged(found: Mismatch, said: str, *, used: bool) -> Mismatch:
    """Add to a mismatch whether predictions use the adapted model."""
    return msgspec.structs.replace(found, adapted=used, sentence=f"{found.sentence}; {said}")


def _place(one: Cause) -> str:
    return f"{one.name} of the {one.surface}" if one.surface else one.name


def _cause(one: Finding, begin: float) -> Cause:
    told = {name: float(x) for name, x in one.told.items() if isfinite(x)}
    return Cause(
        name=one.guess.effect.name,
        channel=one.channel,
        surface=one.surface,
        rivals=one.rivals,
        segments=_on_the_clock(begin, one.segments),
        parameters=told,
        sigma={name: float(x) for name, x in one.sigma.items() if name in told and isfinite(x)},
    )


def _on_the_clock(begin: float, stretches: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    return tuple((float(begin + a), float(begin + b)) for a, b in stretches)


def _or_none(x: float, most: float = inf) -> float | None:
    return float(x) if isfinite(x) and x < most else None
