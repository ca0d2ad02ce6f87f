"""Decision and report of one multirotor.

The posterior of the explanations gives the probability of every effect. A class is the smallest set of effects that
holds 95 % of the probability of one place in the best explanation. An effect is named if its class is that probable.
Where a channel remains noisier than on any nominal flight although the best explanation is part of the model, the
outcome is unknown, with that channel and time.
"""

import time
from collections.abc import Sequence

import numpy as np

from fleet.effects import Onset
from twin_worker.diagnosis.data.card import ALWAYS, FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.report import (
    DiagnosisFinding,
    FigureSeries,
    RankedCandidate,
    Report,
    ReportOutcome,
    describe_onset,
    with_sentence,
)
from twin_worker.diagnosis.multirotor.baseline import RotorBaseline
from twin_worker.diagnosis.multirotor.control_loss import ControlLoss
from twin_worker.diagnosis.multirotor.effects import rotor_effects
from twin_worker.diagnosis.multirotor.flight import RotorFlight
from twin_worker.diagnosis.multirotor.linearise import ActiveEffect, LinearFlight, combined
from twin_worker.diagnosis.multirotor.model import CHANNELS, STEP, modelled_force, smoothed
from twin_worker.diagnosis.multirotor.search import EffectSet, block_scales, search

NAMED, SUSPECTED = 0.95, 0.1  # probability of a class
_MAX_CLASS = 4
_EXPLAINED = 0.6  # share of the excess variance of all channels that effects explain which leaves no unknown
_FORCE_HZ = np.full(3, 2.0)
_WORDS = {
    **dict.fromkeys(("f_x", "f_y"), "horizontal specific force"),
    "f_z": "vertical specific force",
    "p_dot": "roll moment",
    "q_dot": "pitch moment",
    "r_dot": "yaw moment",
    **dict.fromkeys(("v_n_dot", "v_e_dot", "v_d_dot"), "velocity against force"),
    **dict.fromkeys(("phi_dot", "theta_dot", "psi_dot"), "attitude against rates"),
    "baro": "pressure height",
}


def diagnose_rotors(flight: RotorFlight, baseline: RotorBaseline) -> Report:
    """Diagnose one flight against the calibrated rotor model.

    Raises:
        ValueError: if the number of motors differs from that of the model.
    """
    begun = time.process_time()
    if flight.inputs.shape[1] != baseline.motors:
        count = flight.inputs.shape[1]
        raise ValueError(f"{flight.name}: found {count} motors, expected {baseline.motors} like the model; use its own")
    linear = LinearFlight(flight, baseline.noise)
    explanations = search(linear, baseline)
    best = explanations[0]
    posterior = _posterior(explanations)
    findings, outcome = _findings(linear, baseline, explanations, posterior)
    none = next(one for one in explanations if not one.active)
    channel, segments = _unusual(linear, baseline, none, best)
    if channel:
        outcome = ReportOutcome.UNKNOWN
    before, after = _rms(none, linear), _rms(best, linear)
    series, force = _series(linear, none, best)
    ratios = [{n: float(x) for n, x in zip(CHANNELS, _squares(one, linear), strict=True)} for one in (none, best)]
    report = Report(
        flight=flight.name,
        outcome=outcome,
        sentence="",
        findings=tuple(findings),
        ratio_before=ratios[0],
        ratio_after=ratios[1],
        fit_before=before if findings else float("nan"),
        fit_after=after if findings else float("nan"),
        force_before=force[0],
        force_after=force[1],
        free_run_error_before=float("nan"),
        free_run_error_after=float("nan"),
        where=(channel, segments),
        terms={},
        ranking=_ranking(explanations),
        limitations=flight.limitations,
        series=series,
        seconds=time.process_time() - begun,
        posterior=posterior,
    )
    return with_sentence(report)


def _posterior(explanations: Sequence[EffectSet]) -> dict[str, float]:
    """Return the probability of each set of effects; sets of the same effects count as one."""
    evidence = np.array([one.evidence for one in explanations])
    weights = np.exp(evidence - evidence.max())
    out: dict[str, float] = {}
    for one, weight in zip(explanations, weights / weights.sum(), strict=True):
        key = " + ".join(sorted(one.names)) or "none"
        out[key] = out.get(key, 0.0) + float(weight)
    return out


def _findings(
    linear: LinearFlight, baseline: RotorBaseline, explanations: Sequence[EffectSet], posterior: dict[str, float]
) -> tuple[list[DiagnosisFinding], ReportOutcome]:
    best = explanations[0]
    if not best.active:
        return [], ReportOutcome.NONE
    findings, k = [], 0
    for active in best.active:
        m = len(active.values)
        sigma = np.sqrt(np.diag(best.solution.covariance[k : k + m, k : k + m]))
        k += m
        others = {one.one.label for one in best.active if one is not active}
        findings.append(_finding(linear, baseline, active, sigma, _class(active.one.label, others, posterior)))
    findings = sorted(findings, key=lambda one: -one.probability)
    named = [one for one in findings if one.probability >= NAMED]
    if named:
        return named, ReportOutcome.NAMED
    suspected = [one for one in findings if one.probability >= SUSPECTED]
    return suspected, ReportOutcome.SUSPECTED if suspected else ReportOutcome.NONE


def _class(label: str, others: set[str], posterior: dict[str, float]) -> dict[str, float]:
    """Return the probability of every effect in the place of `label`, that of `label` first, then falling."""
    shares: dict[str, float] = {label: 0.0}
    for key, p in posterior.items():
        names = set(key.split(" + ")) - {"none"}
        if label in names:
            shares[label] += p
            continue
        for name in names - others:
            shares[name] = shares.get(name, 0.0) + p / max(len(names - others), 1)
    first = shares.pop(label)
    out = {label: first}
    for name, p in sorted(shares.items(), key=lambda pair: -pair[1])[: _MAX_CLASS - 1]:
        if sum(out.values()) < NAMED:
            out[name] = p
    return out


def _finding(
    linear: LinearFlight, baseline: RotorBaseline, active: ActiveEffect, sigma: np.ndarray, members: dict[str, float]
) -> DiagnosisFinding:
    one, end = active.one, float(linear.t[linear.valid][-1])
    chance = np.sqrt(baseline.chance.get(one.group, 1.0))
    nominal = baseline.sizes.get(one.group, 0.0)
    spread = np.sqrt((chance * sigma) ** 2 + nominal**2)
    tau = float(baseline.parameters[2])
    profile = ALWAYS if active.onset is None else OnsetProfile(Onset.STEP, active.onset)
    surface = one.target if one.effect.name == "motor_thrust_loss" else ""
    first, *rivals = members
    names = tuple(dict.fromkeys(name.split(":")[0] for name in rivals if name.split(":")[0] != one.effect.name))
    return DiagnosisFinding(
        hypothesis=FaultHypothesis(one.effect, one.target, tuple(active.values.tolist()), profile),
        gain=0.0,
        reported=one.reported(active.values, tau),
        sigma=one.reported_sigma(spread),
        parameter_sigma=tuple(spread.tolist()),
        rivals=names,
        manoeuvres=("",) * len(names),
        channel=one.effect.channel,
        surface=surface,
        segments=((active.onset if active.onset is not None else float(linear.t[0]), end),),
        onset_interval=None if active.onset is None else (active.onset - 1.0, active.onset + 1.0),
        probability=min(sum(members.values()), 1.0),
        name_probability=members[first],
    )


def _unusual(
    linear: LinearFlight, baseline: RotorBaseline, none: EffectSet, best: EffectSet
) -> tuple[str, tuple[tuple[float, float], ...]]:
    """Return the channel that is noisier than nominal flights are, and when; empty if there is none."""
    blocks, times = block_scales(best.solution.white, linear)
    usual = np.maximum(baseline.excess, 1.0)
    ratio = blocks / usual
    before, after = (
        float(np.nansum(np.maximum((scales / usual) ** 2 - 1.0, 0.0)))
        for scales in (block_scales(none.solution.white, linear)[0], blocks)
    )
    if not (np.nanmax(ratio) > 1.0) or after < (1 - _EXPLAINED) * before:
        return "", ()
    c = int(np.argmax(np.nanmax(ratio, axis=0)))
    rows = np.flatnonzero(ratio[:, c] > 1.0)
    return _WORDS[CHANNELS[c]], tuple((float(times[k]), float(times[k + 1])) for k in rows)


def _squares(one: EffectSet, linear: LinearFlight) -> np.ndarray:
    return np.asarray((one.solution.white[linear.valid] ** 2).mean(axis=0))


def _rms(one: EffectSet, linear: LinearFlight) -> float:
    return float(np.sqrt(_squares(one, linear)[linear.channels].mean()))


def _series(linear: LinearFlight, none: EffectSet, best: EffectSet) -> tuple[FigureSeries, tuple[float, float]]:
    """Return the series of the figures, and the rms error of the predicted force before and after [m/s2].

    The prediction before the effects has the parameters of the model, and wind and biases of the fit with effects.
    """
    flight, fit = linear.flight, best.solution.fit
    wind = linear.hats @ fit.wind
    measured = smoothed(flight.force, _FORCE_HZ)
    base = modelled_force(flight, fit.parameters, wind, {})
    model = modelled_force(flight, fit.parameters, wind, combined(best.active, {}, flight.t))
    if any(not one.one.in_forces for one in best.active):
        model = np.full(model.shape, np.nan)
    ok = linear.ok
    error = tuple(float(np.sqrt(((x - measured)[ok] ** 2).sum(axis=1).mean())) for x in (base, model))
    series = FigureSeries(
        t=linear.t,
        ok=ok,
        position=flight.position[::STEP],
        before=none.solution.white,
        after=best.solution.white,
        measured=measured,
        base=base,
        model=model,
        held_out=np.zeros(len(linear.t), bool),
    )
    return series, (error[0], error[1])


def _ranking(explanations: Sequence[EffectSet]) -> tuple[RankedCandidate, ...]:
    rows = []
    for one in explanations:
        if one.active:
            onset = one.active[-1].onset
            profile = ALWAYS if onset is None else OnsetProfile(Onset.STEP, onset)
            rows.append(RankedCandidate(" + ".join(one.names), describe_onset(profile), one.gain))
    return tuple(rows)


def loss_report(name: str, loss: ControlLoss | None, limitations: tuple[str, ...] = ()) -> Report:
    """Return the report of a loss of control; without one, that none was found and what was not judged."""
    findings: tuple[DiagnosisFinding, ...] = ()
    sentence = "no loss of control: the frame turned as its motor outputs demanded; its physics are not judged"
    where: tuple[str, tuple[tuple[float, float], ...]] = ("", ())
    outcome = ReportOutcome.NONE
    if loss is not None:
        sentence, outcome = loss.sentence, ReportOutcome.UNKNOWN
        where = "roll and pitch moment", ((loss.t, loss.t),)
    if loss is not None and loss.motors:
        outcome, one = ReportOutcome.NAMED, rotor_effects(loss.motors[0] + 1)[loss.motors[0]]
        onset = OnsetProfile(Onset.STEP, loss.t)
        place = " or ".join(f"motor{k + 1}" for k in loss.motors)
        findings = (
            DiagnosisFinding(
                *(FaultHypothesis(one.effect, place, (1.0,), onset), 0.0, {"loss": 1.0}, {}, (), (), ()),
                *("actuator", place, ((loss.t, loss.t),)),
            ),
        )
    empty = np.zeros((0, len(CHANNELS)))
    vectors = np.zeros((0, 3))
    nan = float("nan")
    return Report(
        *(name, outcome, sentence, findings, {}, {}, nan, nan, nan, nan, nan, nan, where, {}, (), limitations),
        series=FigureSeries(
            np.zeros(0), np.zeros(0, bool), vectors, empty, empty, vectors, vectors, vectors, np.zeros(0, bool)
        ),
    )
