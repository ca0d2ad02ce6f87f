"""Diagnose a flight against its own past: find changes after a trusted first part."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from fleet.process.sanitise import below
from twin_worker.diagnosis.baseline import hidden
from twin_worker.diagnosis.baseline.past import BEFORE_S, before, calibrate_past, since
from twin_worker.diagnosis.baseline.tracking_loss import Lost, lost
from twin_worker.diagnosis.data.card import Card
from twin_worker.diagnosis.data.flight import Flight
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.report import Outcome, Report
from twin_worker.diagnosis.inference.words import sentence

LEAST_AFTER_S = 10.0  # least length of valid flight to diagnose
_EARLIER_S = 5.0  # onsets may precede the end of the trusted past by this

Say = Callable[[str], None]


@dataclass(frozen=True)
class OwnPast:
    """Reference of a diagnosis: the trusted first part of each flight itself.

    Attributes:
        until: end of the trusted past [s, on the flight's own clock]
        card: the aircraft, or `card.UNKNOWN`
    """

    until: float
    card: Card

    def diagnose(self, flight: Flight, say: Say = lambda word: None, conceal: Sequence[str] = ()) -> Report:
        """Diagnose the flight after `until` with a calibration before it; calibrate coefficients with all channels.

        Raises:
            ValueError: if there is too little flight before or after; the message gives its length.
        """
        after = since(flight, self.until).seconds
        if after < LEAST_AFTER_S:
            raise ValueError(
                f"{flight.name}: found {below(after, LEAST_AFTER_S)} s of trusted flight after {self.until:.0f} s, "
                f"expected {LEAST_AFTER_S:.0f} s at least to diagnose; trust a shorter past"
            )
        shown = hidden.concealed(flight, conceal, before(flight, self.until))
        base = calibrate_past(flight, self.until, self.card, say, shown if conceal else None)
        told = (
            f"calibrated on {flight.seconds - after:.0f} s of its own past: effects present from the start and a mean "
            "wind count as nominal; the barometer is not checked"
        )
        report = diagnose(replace(since(shown, self.until - BEFORE_S), lacks=(*shown.lacks, told)), base, say)
        return later(report, lost(flight, self.until), self.until)


def later(report: Report, gone: Lost | None, until: float) -> Report:
    """Return the report without mismatches in the trusted past alone, and with a tracking loss after it.

    An effect that starts in the trusted past contradicts the assumption: the outcome is suspected instead of named.
    Turbulence has no onset and varies between minutes: it counts as weather, like the wind.
    """
    if any(one.guess.effect.variance for one in report.findings):
        report = replace(report, outcome=Outcome.NONE, findings=())
    if any(one.segments[0][0] < until - _EARLIER_S for one in report.findings) and report.outcome is Outcome.NAMED:
        report = replace(report, outcome=Outcome.SUSPECTED)
    channel, stretches = report.where
    stretches = tuple(pair for pair in stretches if pair[1] > until)
    if report.outcome is Outcome.NAMED or stretches:
        return sentence(replace(report, where=(channel, stretches)))
    if gone is not None:
        where = (gone.what, ((gone.since, float(report.series.t[-1])),))
        return sentence(replace(report, outcome=Outcome.UNKNOWN, findings=(), terms={}, where=where))
    if report.outcome is Outcome.UNKNOWN:
        return sentence(replace(report, outcome=Outcome.NONE, findings=(), terms={}, where=("", ())))
    return sentence(report)
