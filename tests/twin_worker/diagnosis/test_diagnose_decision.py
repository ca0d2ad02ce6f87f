"""What decides: the posterior over explanations, classes, held-out blocks, and changes that no effect stands for."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from fleet.effects import Onset, catalogue
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.diagnose import _outcome
from twin_worker.diagnosis.inference.isolation.decision import CLASS_PROBABILITY, decide, smallest_set
from twin_worker.diagnosis.inference.isolation.evidence import TURBULENCE, Explanation, Weights, load_table
from twin_worker.diagnosis.inference.isolation.isolate import ScoredHypothesis
from twin_worker.diagnosis.inference.isolation.onset import onset_posterior
from twin_worker.diagnosis.inference.isolation.search import _variance_onset
from twin_worker.diagnosis.inference.isolation.unmodelled import Anomaly, ChannelEquation, find_tones
from twin_worker.diagnosis.inference.report import ReportOutcome
from twin_worker.diagnosis.inference.validation.cross_validate import CrossValidation
from twin_worker.diagnosis.inference.validation.force_prediction import held_out_gain, is_in_forces
from twin_worker.diagnosis.model.baseline import CHANNELS, unit_noise

STEP = OnsetProfile(Onset.STEP, 60.0)
WEIGHTS = Weights(
    rows_per_sample=20.0,
    model_error=0.005,
    nats_per_parameter=1.0,
    nats_per_onset=1.0,
    chance=1.0,
    block_weight=0.2,
    further=(-3.0, -3.0, -3.0),
    changes=dict.fromkeys(("odd", "shift", "one", "tone", TURBULENCE), -5.0),
)


def explained(gains: dict[str, float], *names: str, chance: float = 0.0, **others: Any) -> Explanation:
    """An explanation with a gain in some channels."""
    effects = [catalogue()[name] for name in names]
    members = tuple(ScoredHypothesis(0.0, FaultHypothesis(e, "", (0.1,) * e.n_parameters, STEP)) for e in effects)
    gain = np.zeros(len(CHANNELS) + 1)
    for channel, x in gains.items():
        gain[CHANNELS.index(channel)] = x
    return Explanation(members, gain, parameters=len(members), chance=chance, **others)


def test_a_gain_that_nominal_flights_reach_is_no_evidence() -> None:
    loss = explained({"force_x": 600.0}, "thrust_loss")
    assert decide([loss], WEIGHTS).none < 0.05
    assert decide([replace(loss, chance=500.0)], WEIGHTS).none > 0.95


def test_the_class_holds_what_is_close_and_leaves_out_what_is_not() -> None:
    found = [
        explained({"force_x": 5000.0}, "thrust_loss"),
        explained({"force_x": 4950.0}, "drag_increase"),
        explained({"force_x": 2000.0}, "icing"),
    ]
    decision = decide(found, WEIGHTS)
    assert decision.best is not None
    (member,) = decision.best.members
    assert member.hypothesis.effect.name == "thrust_loss"
    assert [rival.hypothesis.effect.name for rival in member.rivals] == ["drag_increase"]
    assert decision.probability(("thrust_loss", "drag_increase", "icing")) == pytest.approx(1.0 - decision.none)
    assert 0.5 < decision.probability(("thrust_loss",)) < decision.probability(("thrust_loss", "drag_increase"))
    both = explained({"force_x": 5000.0}, "thrust_loss", "drag_increase")
    assert decide([both], WEIGHTS).probability(("thrust_loss", "drag_increase")) <= 1.0  # one set counts once


def test_no_statement_is_more_certain_than_the_search() -> None:
    found = [explained({"force_x": 5000.0}, "thrust_loss")]
    decision = decide(found, msgspec.structs.replace(WEIGHTS, missed=(1.0, 0.3, 6.0)))
    missed = 1.0 / (1.0 + np.exp(1.0 + 0.3 * 6.0))  # log odds above 6 count as 6
    assert decision.probability(("thrust_loss",)) == pytest.approx(1.0 - missed, abs=1e-6)
    assert decision.effects == pytest.approx(1.0 - missed, abs=1e-6) and decision.missed == pytest.approx(missed)


def test_an_outcome_that_barely_prevails_was_more_often_missed() -> None:
    """Onsets of one set, and changes without an effect, are one outcome each."""
    loss = explained({"force_x": 5000.0}, "thrust_loss")
    later = replace(loss, channel_gain=loss.channel_gain - 1.0)
    drag = explained({"force_x": 4990.0}, "drag_increase")
    weights = msgspec.structs.replace(WEIGHTS, missed=(1.0, 0.3, 6.0))
    barely, clearly = decide([loss, later, drag], weights), decide([loss, later], weights)
    odds = (barely.sets[frozenset({"thrust_loss"})]) / barely.sets[frozenset({"drag_increase"})]
    assert barely.missed == pytest.approx(1.0 / (1.0 + np.exp(1.0 + 0.3 * np.log(odds))), abs=1e-3)
    assert barely.missed > clearly.missed == pytest.approx(1.0 / (1.0 + np.exp(1.0 + 0.3 * 6.0)))


def test_a_change_beside_effects_has_its_own_prior() -> None:
    loss = explained({"roll": 3000.0}, "roll_damping")
    rate = replace(loss, change="odd", anomaly=Anomaly(600.0, "gyro_roll", 60.0), channel_gain=loss.channel_gain.copy())
    rate.channel_gain[CHANNELS.index("gyro_roll")] = 600.0
    assert decide([loss, rate], WEIGHTS).unmodelled > 0.9
    unlikely = msgspec.structs.replace(WEIGHTS, beside=-20.0)
    assert decide([loss, rate], unlikely).unmodelled < 0.1


def test_a_second_effect_is_judged_in_its_own_channel() -> None:
    """A tenth of the first gain is decisive in a channel that the first effect leaves alone, and little in its own."""
    first = explained({"force_x": 8000.0}, "thrust_loss")
    own = explained({"force_x": 8000.0, "airspeed": 800.0}, "thrust_loss", "airspeed_scale")
    same = explained({"force_x": 8160.0}, "thrust_loss", "drag_increase")
    sets = decide([first, own, same], WEIGHTS).sets
    assert sets[own.names] > 0.99 and sets[first.names] > sets[same.names]


def test_a_larger_set_needs_more_than_its_prior() -> None:
    one = explained({"force_x": 800.0}, "thrust_loss")
    two = explained({"force_x": 900.0}, "thrust_loss", "drag_increase")
    assert decide([one, two], WEIGHTS).best is not None
    assert decide([one, two], WEIGHTS).sets[one.names] > 0.5
    three = explained({"force_x": 1200.0}, "thrust_loss", "drag_increase")
    assert decide([one, three], WEIGHTS).sets[three.names] > 0.5


def test_a_change_without_an_effect_is_unknown_and_a_close_effect_is_not() -> None:
    hum = explained({"pitch": 900.0}, change="tone", anomaly=Anomaly(900.0, "pitch", 60.0, "tone"))
    lag = explained({"pitch": 300.0}, "actuator_lag")
    decision = decide([hum, lag], WEIGHTS)
    assert decision.unmodelled > 0.95 and decision.anomaly is not None and decision.anomaly.channel == "pitch"
    assert _outcome(decision, confirmed=True, fits=True) is ReportOutcome.UNKNOWN
    named = decide([hum, replace(lag, channel_gain=4.0 * lag.channel_gain)], WEIGHTS)
    assert _outcome(named, confirmed=True, fits=True) is ReportOutcome.NAMED
    assert _outcome(named, confirmed=False, fits=True) is ReportOutcome.SUSPECTED
    assert _outcome(named, confirmed=True, fits=False) is ReportOutcome.UNKNOWN


def test_a_constant_difference_of_nominal_flights_is_no_effect() -> None:
    drag = explained({"force_x": 4000.0}, "drag_increase")
    nominal = Explanation((), drag.channel_gain, nominal_nats=2.0)
    assert decide([drag], WEIGHTS).none < 0.01
    assert decide([drag, nominal], WEIGHTS).none > 0.8
    assert decide([drag, replace(nominal, nominal_nats=15.0)], WEIGHTS).none < 0.01


def test_no_explanation_is_none() -> None:
    decision = decide([], WEIGHTS)
    assert decision.none == 1.0 and decision.best is None
    assert _outcome(decision, confirmed=False, fits=True) is ReportOutcome.NONE


def test_a_class_is_the_smallest_set_with_its_probability() -> None:
    assert smallest_set({"a": 0.6, "b": 0.36, "c": 0.04}, CLASS_PROBABILITY) == ["a", "b"]
    assert smallest_set({"a": 0.96, "b": 0.04}, CLASS_PROBABILITY) == ["a"]


def test_held_out_blocks_confirm_only_what_predicts_them() -> None:
    proof = CrossValidation(1.0, 0.9, (), (), ((0.6,) * 5, (0.5, -0.4, 0.1), (-2.0, 0.5), ()))
    assert proof.probability(0) == pytest.approx(np.exp(3.0) / (1.0 + np.exp(3.0)))
    assert proof.probability(1) < 0.6 and proof.probability(2) < 0.2 and proof.probability(3) == 0.5


def test_where_faults_are_rare_the_same_evidence_says_less() -> None:
    loss = explained({"force_x": 400.0}, "thrust_loss")
    usual, rare = decide([loss], WEIGHTS, 1.0), decide([loss], WEIGHTS, 1.0 / 300.0)
    assert usual == decide([loss], WEIGHTS)
    odds = [one.effects / one.none for one in (usual, rare)]
    assert odds[0] / odds[1] == pytest.approx(300.0)
    assert rare.best is not None and usual.best is not None and rare.best.names == usual.best.names


def test_the_table_tells_what_it_was_fitted_on() -> None:
    table = load_table()
    assert {"fitted_on", "flights", "command"} <= set(table.provenance)
    weights = table.weights
    assert weights.fault_odds == pytest.approx((51 + 13 + 23) / 32)  # as its provenance says
    assert weights.rows_per_sample > 1.0 and weights.model_error > 0.0 and max(weights.further) < 0.0


_STEP_S, ONSET_S = 0.2, 90.0
HEARD = 200.0  # peak over the mean power, of 2 x 1000 rows of a pure tone
T = np.arange(1000) * _STEP_S


class Sight(SimpleNamespace):
    """Whitened residuals, as far as the finders look at them."""

    @property
    def nuisance_covariance(self) -> np.ndarray:
        return np.linalg.inv(self.Ann)


def quiet(seed: int) -> Any:
    """Give a sight of noise alone, all that the finders look at."""
    n = len(T)
    return Sight(
        modelled=SimpleNamespace(t=T),
        base=SimpleNamespace(r2={}),
        noise=unit_noise(),
        ok=np.ones(n, bool),
        e=np.random.default_rng(seed).standard_normal((n, len(CHANNELS))),
        Jn=np.zeros((n, len(CHANNELS), 1)),
        xn=np.zeros(1),
        Ann=np.eye(1),
        bn=np.zeros(1),
    )


def with_added(sight: Any, channel: str, x: np.ndarray) -> Any:
    """Add a course, (n,), to one channel's residual."""
    sight.e[:, CHANNELS.index(channel)] += x
    return sight


@pytest.mark.parametrize("onset", [STEP, OnsetProfile(Onset.RAMP, 45.0, 60.0)], ids=["step", "ramp"])
def test_the_onset_is_a_change_point_with_an_interval(onset: OnsetProfile) -> None:
    sight = quiet(7)
    shape = np.zeros((len(T), len(CHANNELS)))
    shape[:, CHANNELS.index("force_x")] = 3.0 * np.random.default_rng(8).standard_normal(len(T))
    sight.e -= onset.gate(T)[:, None] * shape
    sight.raw = sight.e
    sight.residuals = lambda hypotheses: sight.raw + shape
    effect = catalogue()["icing"]
    effect = replace(effect, onsets=(Onset.STEP, Onset.RAMP))
    found = onset_posterior(sight, FaultHypothesis(effect, "", (0.1,) * 3, STEP), WEIGHTS)
    assert found is not None and found.mode.kind is onset.kind
    assert abs(found.mode.t0 - onset.t0) <= (1.0 if onset is STEP else 10.0)
    assert found.interval[0] <= onset.t0 <= found.interval[1] + 1.0 and found.probability.sum() == pytest.approx(1.0)
    assert onset_posterior(sight, FaultHypothesis(replace(effect, onsets=(Onset.ALWAYS,)), "", ()), WEIGHTS) is None


def test_turbulence_begins_where_the_variance_changes() -> None:
    square = np.random.default_rng(9).standard_normal((len(T), 3)) ** 2
    assert _variance_onset(T, square, 28.0) is None
    square[T >= ONSET_S] *= 5.0
    found = _variance_onset(T, square, 28.0)
    assert found is not None and abs(found - ONSET_S) < 3.0


def test_the_interval_of_a_force_gain_holds_zero_where_the_effect_predicts_nothing() -> None:
    noise = np.random.default_rng(10).standard_normal((2, len(T), 3))
    sight: Any = SimpleNamespace(t=T, ok=np.ones(len(T), bool))
    loss = FaultHypothesis(catalogue()["thrust_loss"], "", (0.2,), STEP)
    offset = np.where(STEP.t0 < T, 2.0, 0.0)[:, None] * np.ones(3)
    measured = noise[0] + offset
    gain, low, high = held_out_gain(sight, measured, (np.zeros_like(measured), offset))
    assert 0.3 < low < gain < high < 0.9
    gain, low, high = held_out_gain(sight, measured, (offset, offset + 0.1 * noise[1]))
    assert low < 0.0 and gain < 0.05
    assert np.isnan(held_out_gain(sight, measured, (measured, measured))[0])
    assert is_in_forces(loss) and not is_in_forces(FaultHypothesis(catalogue()["gyro_bias"], "p", (0.1,)))


@pytest.mark.parametrize("hertz", [0.17, 0.93])
def test_a_hum_is_heard_in_its_channel_and_noise_is_none(hertz: float) -> None:
    hum = 1.6 * np.sin(2 * np.pi * hertz * T + 1.0) * (T > ONSET_S)
    heard = {one.channel: one for one in find_tones(with_added(quiet(1), "pitch", hum))}
    assert heard["pitch"].net_gain > HEARD and abs(heard["pitch"].t0 - ONSET_S) < 20.0
    assert max(one.net_gain for name, one in heard.items() if name != "pitch") < 0.4 * HEARD


def test_a_constant_term_does_not_drown_the_others() -> None:
    rate = np.random.default_rng(2).standard_normal(len(T))
    sight = with_added(quiet(3), "airspeed", 0.8 * rate * (T > ONSET_S))
    equation = ChannelEquation(sight, "airspeed", {"1": np.ones_like(T), "lagging": rate})
    (_, alone), (worth, t0, _) = next(equation.gain_per_term()), equation.gain_of_all()
    assert alone[0] > 250.0 and worth > alone[0] - 20.0 and abs(t0 - ONSET_S) < 3.0
    assert equation.gain_in_flight()[0] > 100.0


def test_what_is_wrong_throughout_did_not_change_in_flight() -> None:
    rate = np.random.default_rng(4).standard_normal(len(T))
    equation = ChannelEquation(
        with_added(quiet(5), "gyro_yaw", 0.8 * rate), "gyro_yaw", {"1": np.ones_like(T), "rate": rate}
    )
    assert equation.gain_of_all()[0] > 250.0 and equation.gain_in_flight()[0] < 20.0
