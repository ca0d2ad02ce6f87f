"""Diagnose one flight with the calibrated simulation: locate, isolate, estimate and validate effects."""

import time
from collections.abc import Callable, Sequence

import numpy as np

from fleet.effects import Onset, Stage, catalogue
from twin_worker.diagnosis.data.card import ALWAYS, FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.data.flight import FlightData, decimated
from twin_worker.diagnosis.inference.isolation.decision import Decision, decide
from twin_worker.diagnosis.inference.isolation.evidence import TURBULENCE
from twin_worker.diagnosis.inference.isolation.isolate import MIN_R2, ScoredHypothesis
from twin_worker.diagnosis.inference.isolation.search import Search, turbulence_evidence
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
from twin_worker.diagnosis.inference.validation.cross_validate import CrossValidation, free_form, high_segments
from twin_worker.diagnosis.inference.validation.force_prediction import (
    free_run_errors,
    held_out_gain,
    is_in_forces,
)
from twin_worker.diagnosis.inference.validation.spread import covariances, recommend_manoeuvre, reported_sigma
from twin_worker.diagnosis.model.baseline import CHANNEL_OF, CHANNELS, Baseline
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.weather import own_weather

# least probability that effects of the catalogue, and nothing else, act; and of each from held-out data alone [-]
NAMED_PROBABILITY = 0.5
SUSPECTED_PROBABILITY = 0.1  # the same, for a suspicion of separable effects [-]
MAX_CLASS = 4  # largest number of effects that a name may stand for
MAX_RATIO = 3.0  # largest mean square of a channel over its usual without a better explanation [-]
_MAX_SPEED_RATIO = 1.7  # a larger speed ratio means another aircraft
_N_STATED = 5  # sets of effects whose probability a report states
_INTENSITY_SIGMA = 0.2  # relative standard deviation of a turbulence intensity
_JUDGED_CHANNELS = [
    CHANNELS.index(name) for name in ("force_x", "side", "lift", "roll", "pitch", "yaw", "airspeed", "baro")
]

ReportProgress = Callable[[str], None]


def diagnose(
    flight: FlightData,
    base: Baseline,
    progress: ReportProgress = lambda message: None,
    *,
    fault_odds: float | None = None,
) -> Report:
    """Diagnose one flight.

    Args:
        flight: recorded flight
        base: calibrated simulation
        progress: callback for progress messages
        fault_odds: prior odds of a fault in this flight [-]; None: those of the flights of the decision table
    Raises:
        ValueError: if the flight cannot belong to this aircraft; the message names the reason.
    """
    started = time.perf_counter()
    _check_same_aircraft(flight, base)
    modelled = ModelledFlight(flight, base)
    weather = own_weather(modelled)
    whitened = WhitenedResiduals(modelled, weather)
    before, white_before = whitened.mean_square() / base.usual, _profiled_residuals(whitened)
    progress("searching for explanations")
    search = Search(whitened)
    search.run(progress)
    decision = decide(search.explanations, search.weights, fault_odds)
    progress("validating on held-out data")
    named, validation, confirmed = _validated(search, decision, before)
    whitened.condition_on((*weather, *decision.nominal, *(member.hypothesis for member in named)))
    after, white_after = whitened.mean_square() / base.usual, _profiled_residuals(whitened)
    if decision.best is not None and decision.best.change == TURBULENCE:
        findings: tuple[DiagnosisFinding, ...] = (_turbulence_finding(whitened, decision),)
        outcome = _outcome(decision, confirmed=True, fits=True)
    else:
        findings = _findings(whitened, weather, named, validation, decision)
        outcome = _outcome(decision, confirmed, _fits(before, after))
    measured, simulated, with_effects = force_prediction.predict_forces(modelled, weather, validation.fitted)
    errors = [force_prediction.rms(modelled, measured - x) for x in (simulated, with_effects)]
    if outcome is ReportOutcome.NAMED and any(is_in_forces(finding.hypothesis) for finding in findings):
        gain, _, _ = held_out_gain(modelled, measured, (simulated, with_effects))
        outcome = ReportOutcome.SUSPECTED if gain <= 0.0 else outcome
    if outcome is not ReportOutcome.NAMED:
        whitened.condition_on(weather)
    where: tuple[str, tuple[tuple[float, float], ...]] = ("", ())
    terms: dict[str, float] = {}
    if outcome is ReportOutcome.UNKNOWN:
        anomaly = decision.anomaly
        judged = _JUDGED_CHANNELS[int(np.argmax(after[_JUDGED_CHANNELS]))]
        channel = CHANNELS.index(anomaly.channel) if anomaly and decision.unmodelled > decision.none else judged
        where = (CHANNELS[channel], high_segments(modelled.t, white_after[:, channel], whitened.ok))
        terms = free_form(modelled, weather, channel)
    free_runs = free_run_errors(modelled, [weather, *([(*weather, *validation.fitted)] if validation.fitted else [])])
    report = Report(
        flight=flight.name,
        outcome=outcome,
        sentence="",
        findings=() if outcome is ReportOutcome.NONE else findings,
        ratio_before=dict(zip(CHANNELS, before.tolist(), strict=True)),
        ratio_after=dict(zip(CHANNELS, after.tolist(), strict=True)),
        fit_before=validation.before,
        fit_after=validation.after,
        force_before=errors[0],
        force_after=errors[1],
        free_run_error_before=float(np.degrees(free_runs[0])),
        free_run_error_after=float(np.degrees(free_runs[-1])),
        where=where,
        terms=terms,
        ranking=_ranking(search.ranking, decision.best.members if decision.best else ()),
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
        posterior=_stated(decision),
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
    """Describe the axes and surfaces that the nominal flights did not calibrate."""
    surfaces = {"L": "aileron", "M": "elevator", "N": "rudder"}
    axes = tuple(
        f"{CHANNEL_OF[name]} not covered: the calibration explains {base.r2.get(name, 0.0):.0%} of its variance; "
        f"calibrate on flights with {surface} doublets"
        for name, surface in surfaces.items()
        if base.r2.get(name, 1.0) <= MIN_R2
    )
    if not base.undetermined:
        return axes
    names = " and ".join(base.undetermined)
    effect = "their effects are" if len(base.undetermined) > 1 else "its effect is"
    return (*axes, f"{names} not covered: {effect} not determined, as if moved together with another surface")


def _ranking(ranked: Sequence[ScoredHypothesis], named: Sequence[ScoredHypothesis]) -> tuple[RankedCandidate, ...]:
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


def _stated(decision: Decision) -> dict[str, float]:
    """Return the probability of the most probable sets of effects, of `none`, and of `unknown`."""
    ranked = [(names, p) for names, p in decision.sets.items() if names][:_N_STATED]
    out = {" + ".join(sorted(names)): p for names, p in ranked}
    return out | {"none": decision.none, "unknown": decision.unmodelled}


def _validated(
    search: Search, decision: Decision, before: np.ndarray
) -> tuple[tuple[ScoredHypothesis, ...], CrossValidation, bool]:
    """Return the effects of the best explanation that held-out data confirm, their cross-validation, and True.

    Where held-out data confirm none of them, the last one and False.
    """
    named = decision.best.members if decision.best and decision.effects > SUSPECTED_PROBABILITY else ()
    while named:
        named = search.estimated(named)
        hypotheses = tuple(member.hypothesis for member in named)
        proof = cross_validate.fit_and_validate(search.whitened, hypotheses, before, search.blocks, search.weights)
        probability = [proof.probability(k) for k in range(len(named))]
        weakest = int(np.argmin(probability))
        if probability[weakest] > NAMED_PROBABILITY or len(named) == 1:
            return named, proof, probability[weakest] > NAMED_PROBABILITY
        named = (*named[:weakest], *named[weakest + 1 :])
    return (), CrossValidation(np.nan, np.nan, (), ()), False


def _findings(
    whitened: WhitenedResiduals,
    weather: tuple[FaultHypothesis, ...],
    named: tuple[ScoredHypothesis, ...],
    validation: CrossValidation,
    decision: Decision,
) -> tuple[DiagnosisFinding, ...]:
    if not named:
        return ()
    body = whitened.base.card.body
    findings = []
    all_covariances = covariances(whitened, weather, [selected.hypothesis for selected in named])
    for k, (selected, covariance) in enumerate(zip(named, all_covariances, strict=True)):
        hypothesis = selected.hypothesis
        rivals = [rival.hypothesis for rival in selected.rivals]
        findings.append(
            DiagnosisFinding(
                hypothesis=hypothesis,
                gain=selected.gain,
                reported=hypothesis.effect.values(np.array(hypothesis.par), body),
                sigma=reported_sigma(hypothesis, covariance, body),
                parameter_sigma=tuple(np.sqrt(np.diag(covariance)).tolist()),
                rivals=tuple(rival.effect.name for rival in rivals),
                manoeuvres=tuple(recommend_manoeuvre(whitened, hypothesis, rival) for rival in rivals),
                channel=hypothesis.effect.channel,
                surface=hypothesis.target if hypothesis.effect.stage is Stage.DELTA else "",
                segments=(_segment(hypothesis, float(whitened.modelled.t[0]), float(whitened.modelled.t[-1])),),
                onset_interval=selected.onset_interval,
                held_out_share=validation.held_out_gains[k] / max(selected.gain, 1e-9),
                probability=decision.probability((hypothesis.effect.name, *(rival.effect.name for rival in rivals))),
                name_probability=decision.probability((hypothesis.effect.name,)),
            )
        )
    return tuple(findings)


def _segment(hypothesis: FaultHypothesis, first: float, last: float) -> tuple[float, float]:
    if hypothesis.onset.kind is Onset.ALWAYS:
        return first, last
    if hypothesis.onset.kind is Onset.BUMP:
        return hypothesis.onset.t0, hypothesis.onset.t0 + hypothesis.onset.T
    return max(hypothesis.onset.t0, first), last


def _turbulence_finding(whitened: WhitenedResiduals, decision: Decision) -> DiagnosisFinding:
    """Return turbulence as a finding; its intensity follows from the scatter of sideslip."""
    gain, variance_ratio, onset = turbulence_evidence(whitened)
    first, last = float(whitened.modelled.t[0]), float(whitened.modelled.t[-1])
    after = whitened.ok & (whitened.modelled.t >= (first if onset is None else onset))
    profile = ALWAYS if onset is None else OnsetProfile(Onset.STEP, onset)
    effect = catalogue()["turbulence"]
    eq_terms = whitened.modelled.equation_terms(whitened.conditions)
    beta = np.radians(whitened.modelled.residuals(whitened.conditions)[after][:, CHANNELS.index("side")])
    intensity = float(np.sqrt(1.0 - 1.0 / variance_ratio) * beta.std() * np.median(eq_terms.flow.Va))
    reported = effect.values(np.array([intensity]), whitened.base.card.body)
    return DiagnosisFinding(
        hypothesis=FaultHypothesis(effect, "", (intensity,), profile),
        gain=float(gain.sum()),
        reported=reported,
        sigma={name: _INTENSITY_SIGMA * x for name, x in reported.items()},
        parameter_sigma=(_INTENSITY_SIGMA * intensity,),
        rivals=(),
        manoeuvres=(),
        channel="air",
        surface="",
        segments=((first if onset is None else onset, last),),
        held_out_share=1.0,
        probability=decision.probability((TURBULENCE,)),
        name_probability=decision.probability((TURBULENCE,)),
    )


def _fits(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether every channel is as usual with the effects, or they explain the greater part of what was not.

    Args:
        before, after: mean square of each channel over its usual, without and with the effects, (c,)
    """
    excess = [np.maximum(x[_JUDGED_CHANNELS] - 1.0, 0.0).sum() for x in (before, after)]
    least = np.minimum(before, after)[_JUDGED_CHANNELS]  # what is as usual needs no explanation
    return bool(least.max() < MAX_RATIO or excess[1] < 0.5 * excess[0])


def _outcome(decision: Decision, confirmed: bool, fits: bool) -> ReportOutcome:
    """Decide the outcome.

    Args:
        decision: posterior of the explanations
        confirmed: held-out data confirm an effect of the best set
        fits: the residuals with these effects are as usual
    """
    if decision.unmodelled > max(decision.effects, decision.none) or not fits:
        return ReportOutcome.UNKNOWN
    members = decision.best.members if decision.best else ()
    separable = all(1 + len(member.rivals) <= MAX_CLASS for member in members)
    if confirmed and separable and decision.effects > NAMED_PROBABILITY * (1.0 - decision.missed):
        return ReportOutcome.NAMED
    least = SUSPECTED_PROBABILITY if separable else NAMED_PROBABILITY
    return ReportOutcome.SUSPECTED if decision.effects > least else ReportOutcome.NONE
