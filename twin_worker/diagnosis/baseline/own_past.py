"""Diagnose a flight against its own past: find changes after a trusted first part."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from fleet.process.sanitise import format_below
from twin_worker.diagnosis.baseline import hidden
from twin_worker.diagnosis.baseline.past import CONTEXT_S, calibrate_past, part_after, part_before
from twin_worker.diagnosis.baseline.tracking_loss import TrackingLoss, find_tracking_loss
from twin_worker.diagnosis.data.card import AircraftCard
from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.inference.words import with_sentence

MIN_AFTER_S = 10.0  # least length of valid flight to diagnose
_ONSET_MARGIN_S = 5.0  # onsets may precede the end of the trusted past by this

ReportProgress = Callable[[str], None]


@dataclass(frozen=True)
class OwnPast:
    """Reference of a diagnosis: the trusted first part of each flight itself.

    Attributes:
        until: end of the trusted past [s, on the flight's own clock]
        card: the aircraft, or `card.UNKNOWN`
    """

    until: float
    card: AircraftCard

    def diagnose(
        self, flight: FlightData, progress: ReportProgress = lambda message: None, conceal: Sequence[str] = ()
    ) -> Report:
        """Diagnose the flight after `until` with a calibration before it; calibrate coefficients with all channels.

        Raises:
            ValueError: if there is too little flight before or after; the message gives its length.
        """
        after = part_after(flight, self.until).seconds
        if after < MIN_AFTER_S:
            raise ValueError(
                f"{flight.name}: found {format_below(after, MIN_AFTER_S)} s of trusted flight after "
                f"{self.until:.0f} s, "
                f"expected {MIN_AFTER_S:.0f} s at least to diagnose; trust a shorter past"
            )
        visible = hidden.conceal_channels(flight, conceal, part_before(flight, self.until))
        base = calibrate_past(flight, self.until, self.card, progress, visible if conceal else None)
        limitation = (
            f"calibrated on {flight.seconds - after:.0f} s of its own past: effects present from the start and a mean "
            "wind count as nominal; the barometer is not checked"
        )
        report = diagnose(
            replace(part_after(visible, self.until - CONTEXT_S), limitations=(*visible.limitations, limitation)),
            base,
            progress,
        )
        return only_new_findings(report, find_tracking_loss(flight, self.until), self.until)


def only_new_findings(report: Report, tracking_loss: TrackingLoss | None, until: float) -> Report:
    """Return the report without mismatches in the trusted past alone, and with a tracking loss after it.

    An effect that starts in the trusted past contradicts the assumption: the outcome is suspected instead of named.
    Turbulence has no onset and varies between minutes: it counts as weather, like the wind.
    """
    if any(finding.hypothesis.effect.variance for finding in report.findings):
        report = replace(report, outcome=ReportOutcome.NONE, findings=())
    if (
        any(finding.segments[0][0] < until - _ONSET_MARGIN_S for finding in report.findings)
        and report.outcome is ReportOutcome.NAMED
    ):
        report = replace(report, outcome=ReportOutcome.SUSPECTED)
    channel, segments = report.where
    segments = tuple(pair for pair in segments if pair[1] > until)
    if report.outcome is ReportOutcome.NAMED or segments:
        return with_sentence(replace(report, where=(channel, segments)))
    if tracking_loss is not None:
        where = (tracking_loss.signal, ((tracking_loss.since, float(report.series.t[-1])),))
        return with_sentence(replace(report, outcome=ReportOutcome.UNKNOWN, findings=(), terms={}, where=where))
    if report.outcome is ReportOutcome.UNKNOWN:
        return with_sentence(replace(report, outcome=ReportOutcome.NONE, findings=(), terms={}, where=("", ())))
    return with_sentence(report)
