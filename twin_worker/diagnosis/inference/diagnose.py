"""Diagnose one flight with the calibrated simulation: locate, isolate, estimate and validate effects."""

import time
from collections.abc import Callable
from copy import copy
from dataclasses import replace

import numpy as np

from fleet.effects import Onset, Stage, catalogue
from twin_worker.diagnosis.data.fault_hypothesis import ALWAYS, Guess
from twin_worker.diagnosis.data.flight import Flight
from twin_worker.diagnosis.data.smooth import thinned
from twin_worker.diagnosis.inference.isolation.isolate import WELL, Found
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.select_hypotheses import Named, decide, turbulent
from twin_worker.diagnosis.inference.isolation.unmodelled import oddities, strange
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.inference.report import Finding, Outcome, Report, Series, Tried
from twin_worker.diagnosis.inference.validation import cross_validate, force_prediction
from twin_worker.diagnosis.inference.validation.cross_validate import HELD, Proof
from twin_worker.diagnosis.inference.validation.discriminating_manoeuvre import manoeuvre
from twin_worker.diagnosis.inference.validation.free_run import stray
from twin_worker.diagnosis.inference.validation.spread import covariances, told_sigma
from twin_worker.diagnosis.inference.validation.unexplained import free_form, stretches
from twin_worker.diagnosis.inference.words import sentence, since
from twin_worker.diagnosis.model.baseline import CHANNELS, SHOWN_BY, Baseline
from twin_worker.diagnosis.model.residual import Case
from twin_worker.diagnosis.model.weather import own_weather

_TOLD = 0.10  # or of the error of predicted forces
_KEPT = 0.15  # least share of an effect's gain on held-out data
_BORNE, _MUCH = 0.4, 450.0  # or a strong gain: least share of it on held-out data, and least gain
_RARE, _LITTLE = 5.0, 150.0  # least strong gain: multiple of the chance gain, lower limit
_STRANGE = 3.0  # largest ratio of mean square to usual without an explanation
_LEFT = 2.6  # the same limit with the named effects included
_EXPLAINED = 0.6  # least share of the excess that named effects explain
_DOUBT = 2.0  # a parameter below this many standard deviations is not significant
_OTHER = 1.7  # a larger speed ratio means another aircraft
_GUESSED = 0.2  # relative standard deviation of a turbulence intensity
_GUSTY = 450.0  # least gain of turbulence
_TELLING = [CHANNELS.index(name) for name in ("force_x", "side", "lift", "roll", "pitch", "yaw", "airspeed", "baro")]

Say = Callable[[str], None]


def diagnose(flight: Flight, base: Baseline, say: Say = lambda word: None) -> Report:
    """Diagnose one flight.

    Args:
        flight: recorded flight
        base: calibrated simulation
        progress: callback for progress messages
    Raises:
        ValueError: if the flight cannot belong to this aircraft; the message names the reason.
    """
    begun = time.perf_counter()
    _fits(flight, base)
    case = Case(flight, base)
    weather = own_weather(case)
    sight = Sight(case, weather)
    before, white_before = sight.left() / base.usual, _profiled(sight)
    gusts, _ = turbulent(sight)
    say("selecting effects")
    plain = copy(sight)
    named, ranked = decide(sight, weather, say)
    if gusts > _GUSTY and gusts > sum(one.found.gain for one in named):
        named = []
    say("validating on held-out data")
    named, proof, findings = _proven(plain, named, before)
    sight.grant((*weather, *(one.found.guess for one in named)))
    after, white_after = sight.left() / base.usual, _profiled(sight)
    if not any(map(_significant, findings)):
        findings = ()
    if (gust := _gusts(sight, not named)) is not None:
        findings = (*findings, gust)
    force = force_prediction.forces(case, weather, proof.fitted)
    errors = [force_prediction.rms(case, force.measured - x) for x in (force.base, force.model)]
    much = sum(_much(base, one) for one in findings)
    outcome = _outcome(findings, proof, (1.0 - errors[1] / errors[0], much), before, after)
    believed = findings if outcome is Outcome.NAMED else ()
    if not believed:
        sight.grant(weather)
    odds = [] if any(one.guess.effect.variance for one in findings) else oddities(sight, plain)
    odd = strange(odds, base, sum(one.gain for one in believed), loud=after.max() > _LEFT)
    if odd is not None:
        outcome = Outcome.UNKNOWN
    series = _series(case, white_before, white_after, force)
    where: tuple[str, tuple[tuple[float, float], ...]] = ("", ())
    terms: dict[str, float] = {}
    if outcome is Outcome.UNKNOWN:
        channel = CHANNELS.index(odd.channel) if odd else _TELLING[int(np.argmax(after[_TELLING]))]
        where = (CHANNELS[channel], stretches(case.t, white_after[:, channel], sight.ok))
        terms = free_form(case, weather, channel)
    report = Report(
        flight=flight.name,
        outcome=outcome,
        sentence="",
        findings=findings,
        ratio_before=dict(zip(CHANNELS, before.tolist(), strict=True)),
        ratio_after=dict(zip(CHANNELS, after.tolist(), strict=True)),
        fit_before=proof.before,
        fit_after=proof.after,
        force_before=errors[0],
        force_after=errors[1],
        stray_before=float(np.degrees(stray(case, weather))),
        stray_after=float(np.degrees(stray(case, (*weather, *proof.fitted)))),
        where=where,
        odd={one.kind: one.worth / one.limit(base) for one in odds},
        terms=terms,
        tried=_ranking(ranked, named),
        lacks=(*flight.lacks, *uncovered(base)),
        series=series,
        seconds=time.perf_counter() - begun,
    )
    return sentence(report)


def _fits(flight: Flight, base: Baseline) -> None:
    """Reject a flight that cannot belong to the aircraft of this simulation."""
    if base.vane and not flight.vane:
        raise ValueError(
            f"{flight.name}: found no accelerometer at 18 Hz or more, expected one as on the nominal flights; "
            "calibrate on flights recorded like this one"
        )
    speed = float(np.median(np.hypot(flight.readings["v_n"], flight.readings["v_e"])[flight.ok]))
    if not 1 / _OTHER < speed / base.speed < _OTHER:
        raise ValueError(
            f"{flight.name}: found {speed:.0f} m/s, expected about {base.speed:.0f} m/s as on the nominal flights; "
            "use the model of this aircraft"
        )


def uncovered(base: Baseline) -> tuple[str, ...]:
    """Describe the axes that the nominal flights did not calibrate."""
    cure = {"L": "aileron", "M": "elevator", "N": "rudder"}
    return tuple(
        f"{SHOWN_BY[name]} not covered: the calibration explains {base.r2.get(name, 0.0):.0%} of its variance; "
        f"calibrate on flights with {surface} doublets"
        for name, surface in cure.items()
        if base.r2.get(name, 1.0) <= WELL
    )


def _ranking(ranked: list[Found], named: list[Named]) -> tuple[Tried, ...]:
    """List every hypothesis tested, named and rival ones included, once per label with its best onset."""
    best: dict[str, Found] = {}
    for one in (*ranked, *(found for n in named for found in (n.found, *n.rivals))):
        if one.guess.label not in best or one.gain > best[one.guess.label].gain:
            best[one.guess.label] = one
    found = sorted(best.values(), key=lambda one: -one.gain)
    return tuple(Tried(one.guess.label, since(one.guess.when), one.gain) for one in found)


def _profiled(sight: Sight) -> np.ndarray:
    e = sight.raw + sight.Jn @ sight.xn
    return np.where(sight.ok[:, None], e, np.nan)


def _proven(plain: Sight, named: list[Named], before: np.ndarray) -> tuple[list[Named], Proof, tuple[Finding, ...]]:
    """Cross-validate the selected effects; remove those after the first that held-out data do not confirm."""
    sight, weather = copy(plain), plain.granted
    while True:
        if not named:
            return [], Proof(np.nan, np.nan, (), ()), ()
        proof = cross_validate.held_out(plain, tuple(one.found.guess for one in named), before)
        findings = _findings(sight, weather, named, proof)
        order = sorted(range(len(named)), key=lambda k: -named[k].found.gain)
        weak = [k for k in order[1:] if findings[k].held < _KEPT or not _significant(findings[k])]
        if not weak:
            return named, proof, findings
        named = [one for k, one in enumerate(named) if k != weak[-1]]
        for i, one in enumerate(named):
            sight.grant((*weather, *(other.found.guess for k, other in enumerate(named) if k != i)))
            named[i] = replace(one, found=refine(sight, one.found.guess))


def _findings(sight: Sight, weather: tuple[Guess, ...], named: list[Named], proof: Proof) -> tuple[Finding, ...]:
    guesses = [one.found.guess for one in named]
    if not named:
        return ()
    body = sight.base.card.body
    out = []
    for i, (one, covariance) in enumerate(zip(named, covariances(sight, weather, guesses), strict=True)):
        guess = one.found.guess
        rivals = [rival.guess for rival in one.rivals]
        surface = guess.of if guess.effect.stage is Stage.DELTA else ""
        out.append(
            Finding(
                guess=guess,
                gain=one.found.gain,
                told=guess.effect.told(guess.effect, np.array(guess.par), body),
                sigma=told_sigma(guess, covariance, body),
                doubt=tuple(np.sqrt(np.diag(covariance)).tolist()),
                rivals=tuple(rival.effect.name for rival in rivals),
                apart=tuple(manoeuvre(sight, guess, rival) for rival in rivals),
                channel=guess.effect.channel,
                surface=surface,
                segments=(_segment(guess, float(sight.case.t[0]), float(sight.case.t[-1])),),
                held=proof.kept[i] / max(one.found.gain, 1e-9),
            )
        )
    return tuple(out)


def _segment(guess: Guess, first: float, last: float) -> tuple[float, float]:
    if guess.when.kind is Onset.ALWAYS:
        return first, last
    if guess.when.kind is Onset.BUMP:
        return guess.when.t0, guess.when.t0 + guess.when.T
    return max(guess.when.t0, first), last


def _gusts(sight: Sight, alone: bool) -> Finding | None:
    """Return turbulence as a finding if the residuals scatter as gusts do."""
    gain, louder = turbulent(sight)
    if gain < _GUSTY or not alone:
        return None
    effect = catalogue()["turbulence"]
    made = sight.case.terms(sight.granted)
    beta = np.radians(sight.case.residuals(sight.granted)[sight.ok][:, CHANNELS.index("side")])
    intensity = float(np.sqrt(1.0 - 1.0 / louder) * beta.std() * np.median(made.flow.Va))
    guess = Guess(effect, "", (intensity,), ALWAYS)
    whole = (float(sight.case.t[0]), float(sight.case.t[-1]))
    told = effect.told(effect, np.array([intensity]), sight.base.card.body)
    sigma = {name: _GUESSED * x for name, x in told.items()}
    return Finding(guess, gain, told, sigma, (_GUESSED * intensity,), (), (), "air", "", (whole,), 1.0)


def _outcome(
    findings: tuple[Finding, ...], proof: Proof, enough: tuple[float, float], before: np.ndarray, after: np.ndarray
) -> Outcome:
    """Decide the outcome; `force_evidence`: relative drop of the held-out force error, and least strong gain."""
    told, much = enough
    gusty = any(one.guess.effect.variance for one in findings)
    borne_out = all(one.held >= _BORNE for one in findings) and sum(one.gain for one in findings) > much
    gained = proof.gain >= HELD or (proof.gain > 0.0 and (told >= _TOLD or borne_out))
    sound = all(one.held >= _KEPT and _significant(one) and not _at_its_end(one) for one in findings)
    proven = gusty or (gained and sound)
    excess = [np.maximum(x[_TELLING] - 1.0, 0.0).sum() for x in (before, after)]
    explained = 1.0 - excess[1] / max(excess[0], 1e-9)
    if findings and proven:
        lost = after[_TELLING].max() > _LEFT and explained < _EXPLAINED and not gusty
        return Outcome.UNKNOWN if lost else Outcome.NAMED
    if before[_TELLING].max() > _STRANGE:
        return Outcome.UNKNOWN
    return Outcome.SUSPECTED if findings else Outcome.NONE


def _much(base: Baseline, one: Finding) -> float:
    """Return the gain that counts as strong for an effect, from the gain that nominal flights reach by chance."""
    if not base.vane:
        return _MUCH
    chance = max((x for kind, x in base.chance.items() if kind.startswith(f"{one.guess.label}|")), default=0.0)
    return min(max(_RARE * chance, _LITTLE), _MUCH)


def _significant(one: Finding) -> bool:
    """Return whether any parameter except nuisances is significantly different from zero."""
    counted = zip(one.guess.effect.parameters, one.guess.par, one.doubt, strict=True)
    return any(abs(x) > _DOUBT * doubt and not p.aside for p, x, doubt in counted)


def _at_its_end(one: Finding) -> bool:
    """Return whether a parameter except nuisances is at its physical bound; a share of 1 is allowed there."""
    counted = zip(one.guess.effect.parameters, one.guess.par, strict=True)
    return any(x and x in (p.low, p.high) and x != 1.0 and not p.aside for p, x in counted)


def _series(case: Case, before: np.ndarray, after: np.ndarray, force: force_prediction.Forces) -> Series:
    place = thinned(np.column_stack([case.flight.place, case.flight.readings["h"]]))
    return Series(
        t=case.t,
        ok=case.ok,
        place=place,
        before=before,
        after=after,
        measured=force.measured,
        base=force.base,
        model=force.model,
        held=force_prediction.blocks(case.t, odd=True),
    )
