"""Diagnose one flight with the calibrated simulation: locate, isolate, estimate and validate effects."""

import time
from collections.abc import Callable
from copy import copy
from dataclasses import replace

import numpy as np

from fleet.effects import Onset, Stage, catalogue
from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.data.flight import FlightData, decimated
from twin_worker.diagnosis.inference.isolation.isolate import MIN_R2, ScoredHypothesis
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.select_hypotheses import select_hypotheses, turbulence_evidence
from twin_worker.diagnosis.inference.isolation.unmodelled import find_anomalies, first_unexplained
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.inference.report import (
    DiagnosisFinding,
    FigureSeries,
    RankedCandidate,
    Report,
    ReportOutcome,
    describe_onset,
    with_sentence,
)
from twin_worker.diagnosis.inference.validation import cross_validate, force_prediction
from twin_worker.diagnosis.inference.validation.cross_validate import (
    MIN_RMS_DROP,
    CrossValidation,
    free_form,
    high_segments,
)
from twin_worker.diagnosis.inference.validation.force_prediction import free_run_errors
from twin_worker.diagnosis.inference.validation.spread import covariances, recommend_manoeuvre, reported_sigma
from twin_worker.diagnosis.model.baseline import CHANNEL_OF, CHANNELS, Baseline
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.weather import own_weather

_MIN_FORCE_DROP = 0.10  # or of the error of predicted forces
_MIN_HELD_OUT_SHARE = 0.15  # least share of an effect's gain on held-out data
_STRONG_SHARE, _STRONG_GAIN = 0.4, 450.0  # or a strong gain: least share of it on held-out data, and least gain
_CHANCE_FACTOR, _MIN_STRONG_GAIN = 5.0, 150.0  # least strong gain: multiple of the chance gain, lower limit
_MAX_RATIO = 3.0  # largest ratio of mean square to usual without an explanation
_MAX_RATIO_NAMED = 2.6  # the same limit with the named effects included
_MIN_EXPLAINED = 0.6  # least share of the excess that named effects explain
_MIN_SIGMAS = 2.0  # a parameter below this many standard deviations is not significant
_MAX_SPEED_RATIO = 1.7  # a larger speed ratio means another aircraft
_INTENSITY_SIGMA = 0.2  # relative standard deviation of a turbulence intensity
_MIN_GUST_GAIN = 450.0  # least gain of turbulence
_JUDGED_CHANNELS = [
    CHANNELS.index(name) for name in ("force_x", "side", "lift", "roll", "pitch", "yaw", "airspeed", "baro")
]

ReportProgress = Callable[[str], None]


def diagnose(flight: FlightData, base: Baseline, progress: ReportProgress = lambda message: None) -> Report:
    """Diagnose one flight.

    Args:
        flight: recorded flight
        base: calibrated simulation
        progress: callback for progress messages
    Raises:
        ValueError: if the flight cannot belong to this aircraft; the message names the reason.
    """
    started = time.perf_counter()
    _check_same_aircraft(flight, base)
    modelled = ModelledFlight(flight, base)
    weather = own_weather(modelled)
    whitened = WhitenedResiduals(modelled, weather)
    before, white_before = whitened.mean_square() / base.usual, _profiled_residuals(whitened)
    gust_gain, _ = turbulence_evidence(whitened)
    progress("selecting effects")
    unconditioned = copy(whitened)
    named, ranked = select_hypotheses(whitened, weather, progress)
    if gust_gain > _MIN_GUST_GAIN and gust_gain > sum(selected.gain for selected in named):
        named = []
    progress("validating on held-out data")
    named, validation, findings = _cross_validated(unconditioned, named, before)
    whitened.condition_on((*weather, *(selected.hypothesis for selected in named)))
    after, white_after = whitened.mean_square() / base.usual, _profiled_residuals(whitened)
    if not any(map(_is_significant, findings)):
        findings = ()
    if not named and (turbulence := _turbulence_finding(whitened)) is not None:
        findings = (turbulence,)
    measured, simulated, with_effects = force_prediction.predict_forces(modelled, weather, validation.fitted)
    errors = [force_prediction.rms(modelled, measured - x) for x in (simulated, with_effects)]
    strong_gain = sum(_strong_gain(base, finding) for finding in findings)
    outcome = _outcome(findings, validation, (1.0 - errors[1] / errors[0], strong_gain), before, after)
    accepted = findings if outcome is ReportOutcome.NAMED else ()
    if not accepted:
        whitened.condition_on(weather)
    turbulent = any(finding.hypothesis.effect.variance for finding in findings)
    anomalies = [] if turbulent else find_anomalies(whitened, unconditioned)
    accepted_gain = sum(finding.gain for finding in accepted)
    anomaly = first_unexplained(anomalies, base, accepted_gain, still_high=after.max() > _MAX_RATIO_NAMED)
    if anomaly is not None:
        outcome = ReportOutcome.UNKNOWN
    where: tuple[str, tuple[tuple[float, float], ...]] = ("", ())
    terms: dict[str, float] = {}
    if outcome is ReportOutcome.UNKNOWN:
        judged = _JUDGED_CHANNELS[int(np.argmax(after[_JUDGED_CHANNELS]))]
        channel = CHANNELS.index(anomaly.channel) if anomaly else judged
        where = (CHANNELS[channel], high_segments(modelled.t, white_after[:, channel], whitened.ok))
        terms = free_form(modelled, weather, channel)
    free_runs = free_run_errors(modelled, [weather, *([(*weather, *validation.fitted)] if validation.fitted else [])])
    report = Report(
        flight=flight.name,
        outcome=outcome,
        sentence="",
        findings=findings,
        ratio_before=dict(zip(CHANNELS, before.tolist(), strict=True)),
        ratio_after=dict(zip(CHANNELS, after.tolist(), strict=True)),
        fit_before=validation.before,
        fit_after=validation.after,
        force_before=errors[0],
        force_after=errors[1],
        free_run_error_before=float(np.degrees(free_runs[0])),
        free_run_error_after=float(np.degrees(free_runs[-1])),
        where=where,
        anomaly_ratio={entry.kind: entry.net_gain / entry.limit(base) for entry in anomalies},
        terms=terms,
        ranking=_ranking(ranked, named),
        limitations=(*flight.limitations, *uncovered_axes(base)),
        series=FigureSeries(
            t=modelled.t,
            ok=modelled.ok,
            position=decimated(np.column_stack([flight.position, flight.readings["h"]])),
            before=white_before,
            after=white_after,
            measured=measured,
            base=simulated,
            model=with_effects,
            held_out=force_prediction.blocks(modelled.t, odd=True),
        ),
        seconds=time.perf_counter() - started,
    )
    return with_sentence(report)


def _check_same_aircraft(flight: FlightData, base: Baseline) -> None:
    """Reject a flight that cannot belong to the aircraft of this simulation."""
    if base.vane and not flight.vane:
        raise ValueError(
            f"{flight.name}: found no accelerometer at 18 Hz or more, expected one as on the nominal flights; "
            "calibrate on flights recorded like this one"
        )
    speed = float(np.median(np.hypot(flight.readings["v_n"], flight.readings["v_e"])[flight.ok]))
    if not 1 / _MAX_SPEED_RATIO < speed / base.speed < _MAX_SPEED_RATIO:
        raise ValueError(
            f"{flight.name}: found {speed:.0f} m/s, expected about {base.speed:.0f} m/s as on the nominal flights; "
            "use the model of this aircraft"
        )


def uncovered_axes(base: Baseline) -> tuple[str, ...]:
    """Describe the axes that the nominal flights did not calibrate."""
    surfaces = {"L": "aileron", "M": "elevator", "N": "rudder"}
    return tuple(
        f"{CHANNEL_OF[name]} not covered: the calibration explains {base.r2.get(name, 0.0):.0%} of its variance; "
        f"calibrate on flights with {surface} doublets"
        for name, surface in surfaces.items()
        if base.r2.get(name, 1.0) <= MIN_R2
    )


def _ranking(ranked: list[ScoredHypothesis], named: list[ScoredHypothesis]) -> tuple[RankedCandidate, ...]:
    """List every hypothesis tested, named and rival ones included, once per label with its best onset."""
    best: dict[str, RankedCandidate] = {}
    for scored in (*ranked, *(alternative for n in named for alternative in (n, *n.rivals))):
        label = scored.hypothesis.label
        if label not in best or scored.gain > best[label].gain:
            best[label] = RankedCandidate(label, describe_onset(scored.hypothesis.onset), scored.gain)
    return tuple(sorted(best.values(), key=lambda candidate: -candidate.gain))


def _profiled_residuals(whitened: WhitenedResiduals) -> np.ndarray:
    e = whitened.raw + whitened.Jn @ whitened.xn
    return np.where(whitened.ok[:, None], e, np.nan)


def _cross_validated(
    unconditioned: WhitenedResiduals, named: list[ScoredHypothesis], before: np.ndarray
) -> tuple[list[ScoredHypothesis], CrossValidation, tuple[DiagnosisFinding, ...]]:
    """Cross-validate the selected effects; remove those after the first that held-out data do not confirm."""
    whitened, weather = copy(unconditioned), unconditioned.conditions
    while named:
        hypotheses = tuple(selected.hypothesis for selected in named)
        proof = cross_validate.fit_and_validate(unconditioned, hypotheses, before)
        findings = _findings(whitened, weather, named, proof)
        order = sorted(range(len(named)), key=lambda k: -named[k].gain)
        weak = [
            k for k in order[1:] if findings[k].held_out_share < _MIN_HELD_OUT_SHARE or not _is_significant(findings[k])
        ]
        if not weak:
            return named, proof, findings
        named = [selected for k, selected in enumerate(named) if k != weak[-1]]
        for i, selected in enumerate(named):
            whitened.condition_on((*weather, *(other.hypothesis for k, other in enumerate(named) if k != i)))
            named[i] = replace(refine(whitened, selected.hypothesis), rivals=selected.rivals)
    return [], CrossValidation(np.nan, np.nan, (), ()), ()


def _findings(
    whitened: WhitenedResiduals,
    weather: tuple[FaultHypothesis, ...],
    named: list[ScoredHypothesis],
    validation: CrossValidation,
) -> tuple[DiagnosisFinding, ...]:
    body = whitened.base.card.body
    findings = []
    all_covariances = covariances(whitened, weather, [selected.hypothesis for selected in named])
    for selected, covariance, held_out_gain in zip(named, all_covariances, validation.held_out_gains, strict=True):
        hypothesis = selected.hypothesis
        rivals = [rival.hypothesis for rival in selected.rivals]
        findings.append(
            DiagnosisFinding(
                hypothesis=hypothesis,
                gain=selected.gain,
                reported=hypothesis.effect.reported(hypothesis.effect, np.array(hypothesis.par), body),
                sigma=reported_sigma(hypothesis, covariance, body),
                parameter_sigma=tuple(np.sqrt(np.diag(covariance)).tolist()),
                rivals=tuple(rival.effect.name for rival in rivals),
                manoeuvres=tuple(recommend_manoeuvre(whitened, hypothesis, rival) for rival in rivals),
                channel=hypothesis.effect.channel,
                surface=hypothesis.target if hypothesis.effect.stage is Stage.DELTA else "",
                segments=(_segment(hypothesis, float(whitened.modelled.t[0]), float(whitened.modelled.t[-1])),),
                held_out_share=held_out_gain / max(selected.gain, 1e-9),
            )
        )
    return tuple(findings)


def _segment(hypothesis: FaultHypothesis, first: float, last: float) -> tuple[float, float]:
    if hypothesis.onset.kind is Onset.ALWAYS:
        return first, last
    if hypothesis.onset.kind is Onset.BUMP:
        return hypothesis.onset.t0, hypothesis.onset.t0 + hypothesis.onset.T
    return max(hypothesis.onset.t0, first), last


def _turbulence_finding(whitened: WhitenedResiduals) -> DiagnosisFinding | None:
    """Return turbulence as a finding if the residuals scatter as gusts do."""
    gain, variance_ratio = turbulence_evidence(whitened)
    if gain < _MIN_GUST_GAIN:
        return None
    effect = catalogue()["turbulence"]
    eq_terms = whitened.modelled.equation_terms(whitened.conditions)
    beta = np.radians(whitened.modelled.residuals(whitened.conditions)[whitened.ok][:, CHANNELS.index("side")])
    intensity = float(np.sqrt(1.0 - 1.0 / variance_ratio) * beta.std() * np.median(eq_terms.flow.Va))
    reported = effect.reported(effect, np.array([intensity]), whitened.base.card.body)
    return DiagnosisFinding(
        hypothesis=FaultHypothesis(effect, "", (intensity,)),
        gain=gain,
        reported=reported,
        sigma={name: _INTENSITY_SIGMA * x for name, x in reported.items()},
        parameter_sigma=(_INTENSITY_SIGMA * intensity,),
        rivals=(),
        manoeuvres=(),
        channel="air",
        surface="",
        segments=((float(whitened.modelled.t[0]), float(whitened.modelled.t[-1])),),
        held_out_share=1.0,
    )


def _outcome(
    findings: tuple[DiagnosisFinding, ...],
    validation: CrossValidation,
    force_evidence: tuple[float, float],
    before: np.ndarray,
    after: np.ndarray,
) -> ReportOutcome:
    """Decide the outcome; `force_evidence`: relative drop of the held-out force error, and least strong gain."""
    force_drop, strong_gain = force_evidence
    turbulent = any(finding.hypothesis.effect.variance for finding in findings)
    strong = (
        all(finding.held_out_share >= _STRONG_SHARE for finding in findings)
        and sum(finding.gain for finding in findings) > strong_gain
    )
    gained = validation.rms_drop >= MIN_RMS_DROP or (
        validation.rms_drop > 0.0 and (force_drop >= _MIN_FORCE_DROP or strong)
    )
    significant = all(
        finding.held_out_share >= _MIN_HELD_OUT_SHARE and _is_significant(finding) and not _at_bound(finding)
        for finding in findings
    )
    proven = turbulent or (gained and significant)
    excess = [np.maximum(x[_JUDGED_CHANNELS] - 1.0, 0.0).sum() for x in (before, after)]
    explained = 1.0 - excess[1] / max(excess[0], 1e-9)
    if findings and proven:
        unexplained = after[_JUDGED_CHANNELS].max() > _MAX_RATIO_NAMED and explained < _MIN_EXPLAINED and not turbulent
        return ReportOutcome.UNKNOWN if unexplained else ReportOutcome.NAMED
    if before[_JUDGED_CHANNELS].max() > _MAX_RATIO:
        return ReportOutcome.UNKNOWN
    return ReportOutcome.SUSPECTED if findings else ReportOutcome.NONE


def _strong_gain(base: Baseline, finding: DiagnosisFinding) -> float:
    """Return the gain that counts as strong for an effect, from the gain that nominal flights reach by chance."""
    if not base.vane:
        return _STRONG_GAIN
    chance = max((x for kind, x in base.chance.items() if kind.startswith(f"{finding.hypothesis.label}|")), default=0.0)
    return min(max(_CHANCE_FACTOR * chance, _MIN_STRONG_GAIN), _STRONG_GAIN)


def _is_significant(finding: DiagnosisFinding) -> bool:
    """Return whether any parameter except nuisances is significantly different from zero."""
    counted = zip(finding.hypothesis.effect.parameters, finding.hypothesis.par, finding.parameter_sigma, strict=True)
    return any(abs(x) > _MIN_SIGMAS * sigma and not p.nuisance for p, x, sigma in counted)


def _at_bound(finding: DiagnosisFinding) -> bool:
    """Return whether a parameter except nuisances is at its physical bound; a share of 1 is allowed there."""
    counted = zip(finding.hypothesis.effect.parameters, finding.hypothesis.par, strict=True)
    return any(x and x in (p.low, p.high) and x != 1.0 and not p.nuisance for p, x in counted)
