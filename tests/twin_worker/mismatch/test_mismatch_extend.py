"""Predicting with what was named: the models go back to before the onset, take it in, and count nothing twice."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleet.contract import Message, Model, Prediction, Sample
from fleet.effects import catalogue
from fleet.frames import to_ned
from fleet.physics import point_mass as H
from fleet.physics.wrench import NAMES, WIND
from fleet.simulator.faults.kinds import parse_fault
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.identification.fixed_wing.point_mass_model import EffectIncrements, with_effects
from twin_worker.mismatch.adapt_models import adapt_models, adapted_derivatives, wind_with_effects
from twin_worker.mismatch.effect_increments import EffectOutputs, actual_deflections
from twin_worker.twin.state.models import MAX_CHECKPOINTS, latest_before
from twin_worker.twin.state.state import Twin
from twin_worker.twin.step import advance
from twin_worker.twin.steps import rollouts

FAULT_S, NAMED_S, END_S = 70.0, 100.0, 150.0


def push(twin: Twin, onset: float, **more) -> EffectOutputs:
    """Nothing at all, at the newest minute's rows."""
    t = np.arange(twin.telemetry.history.newest - 30.0, twin.telemetry.history.newest - 1.0, 0.5)
    window = twin.window(60.0)
    command = np.column_stack([np.interp(t, window.t, window.u[:, k]) for k in range(4)])
    nothing = EffectOutputs(t, np.zeros((len(t), 6)), command, command.copy(), np.zeros(3), 1.0, onset)
    return replace(nothing, **more)


def par_of(plant, name: str) -> float:
    return float(plant.par[NAMES.index(name)])


@pytest.fixture
def known(twin):
    """A twin, its newest mark with a model, and a fault that began half a minute ago."""
    onset = twin.telemetry.history.newest - 30.0
    mark = latest_before(twin.models.checkpoints, onset)
    plant = mark.derivatives_model or twin.models.active_model
    return twin, replace(mark, derivatives_model=plant, point_mass=mark.point_mass or twin.models.point_mass), onset


def test_marks_are_kept_as_far_back_as_telemetry(flown):
    twin = flown[0]
    t = np.array([mark.t for mark in twin.models.checkpoints])
    assert 5 <= len(t) <= MAX_CHECKPOINTS and (np.diff(t) >= 10.0).all()
    assert (
        latest_before(twin.models.checkpoints, t[0]) is None and latest_before(twin.models.checkpoints, t[2]).t == t[1]
    )


def test_a_servo_that_does_half_halves_its_derivatives_alone(known):
    twin, mark, onset = known
    loss = FaultHypothesis(catalogue()["control_effectiveness_loss"], "aileron", (0.5,))
    pushed = push(twin, onset)
    pushed = replace(pushed, actual=actual_deflections([loss], pushed.command))
    found = adapted_derivatives(mark.derivatives_model, pushed, twin.window(60.0))
    for name in ("Y_da", "L_da", "N_da"):
        assert par_of(found, name) == pytest.approx(0.5 * par_of(mark.derivatives_model, name), rel=1e-6)
    for name in ("L_v", "L_p", "M_de", "X_dt", "N_dr"):
        assert par_of(found, name) == pytest.approx(par_of(mark.derivatives_model, name))


def test_a_servo_s_offset_becomes_a_moment(known):
    twin, mark, onset = known
    offset = FaultHypothesis(catalogue()["actuator_offset"], "elevator", (0.1,))
    pushed = push(twin, onset)
    pushed = replace(pushed, actual=actual_deflections([offset], pushed.command))
    found = adapted_derivatives(mark.derivatives_model, pushed, twin.window(60.0))
    gained = par_of(found, "M_0") - par_of(mark.derivatives_model, "M_0")
    assert gained == pytest.approx(0.1 * par_of(mark.derivatives_model, "M_de"), rel=1e-6)
    assert par_of(found, "M_de") == pytest.approx(par_of(mark.derivatives_model, "M_de"), rel=1e-6)


def test_a_lag_or_what_has_passed_moves_no_steady_command(twin):
    command = np.linspace(-0.4, 0.4, 28).reshape(7, 4)
    lag = FaultHypothesis(catalogue()["actuator_lag"], "elevator", (0.3,))
    assert np.array_equal(actual_deflections([lag], command), command)


def test_a_force_is_spread_over_the_derivatives_that_make_it(known):
    """A tenth of the weight pulling back shows in X, as flown, and nowhere else."""
    twin, mark, onset = known
    wrench = np.zeros((len(push(twin, onset).t), 6))
    wrench[:, 0] = -1.0
    found = adapted_derivatives(mark.derivatives_model, push(twin, onset, wrench=wrench), twin.window(60.0))
    changed = found.par - mark.derivatives_model.par
    assert np.abs(changed[NAMES.index("Z_0") : WIND]).max() < 1e-9 and np.abs(changed[:6]).max() > 0.1
    assert (np.diag(found.covariance) >= np.diag(mark.derivatives_model.covariance) - 1e-9).all()  # and it is in doubt
    assert not found.fisher_information.any()  # nothing of the flight before counts as seen again


def test_power_takes_the_force_along_the_flight(known):
    twin, mark, _ = known
    n = 60
    air = np.tile([20.0, 0.0, 1.0], (n, 1))
    added = EffectIncrements(np.tile([-0.4, 0.0, 0.0], (n, 1)), air, np.zeros(n), np.full(n, 0.5), (False, False))
    short = twin.window(5.0)
    found = with_effects(mark.point_mass, short, twin.telemetry.history, 1.0, added)
    at = np.array([1.0, 0.5 - found.parameters[H.T_0], np.hypot(20.0, 1.0) - found.parameters[H.V_0], 0.0])
    gained = (found.parameters - mark.point_mass.parameters)[H.C_0 : H.C_N + 1] @ at
    assert gained == pytest.approx(-0.4, abs=0.02)
    assert np.array_equal(found.parameters[: H.C_0], mark.point_mass.parameters[: H.C_0])  # lags, turn and lift stay


def test_wind_and_airspeed_sensor_jump_at_the_onset_and_the_mark_stays(known):
    twin, mark, _ = known
    jumped, before_, wind = copy.deepcopy(mark.wind_filter), mark.wind_filter.scale, mark.wind_filter.wind.copy()
    jumped.inflate_after_step(np.array([3.0, -2.0, 0.0]), 1.25, 0.3)
    assert jumped.scale == pytest.approx(1.25 * before_)
    assert jumped.wind - wind == pytest.approx([3.0, -2.0, 0.0])
    onset = twin.telemetry.history.newest - 1.5
    calm, _ = wind_with_effects(twin, push(twin, onset), mark)
    told, t = wind_with_effects(twin, push(twin, onset, airspeed_scale=0.8), mark)
    assert told.scale > calm.scale + 0.01  # what is flown since pulls it back: nothing is wrong with this sensor
    assert twin.environment.wind_t <= t <= twin.telemetry.history.newest and mark.wind_filter.scale == before_


def test_nothing_changes_without_a_mark_from_before(twin):
    twin.models.checkpoints.clear()
    kept = twin.models.active_model, twin.models.point_mass, twin.environment.wind
    tried = adapt_models(twin, push(twin, twin.telemetry.history.newest - 30.0), "thrust_loss")
    assert not tried.used and "no flight to compare" in tried.message
    assert (
        twin.models.active_model,
        twin.models.point_mass,
        twin.environment.wind,
    ) == kept and twin.models.active_effect is None


def test_an_effect_that_is_not_there_is_not_flown_with(twin):
    tried = adapt_models(twin, push(twin, twin.telemetry.history.newest - 30.0, airspeed_scale=0.6), "airspeed_scale")
    assert not tried.used and twin.models.active_effect is None
    assert "the identified model is used unchanged" in tried.message


@pytest.fixture(scope="module")
def faulty(tmp_path_factory) -> tuple[Message, ...]:
    """A pretend aircraft whose airspeed reads a fifth too little from 70 s on."""
    path: Path = tmp_path_factory.mktemp("faulty") / "flight.tlog"
    fault = parse_fault(f"airspeed_scale,scale=0.8,at={FAULT_S}", "small")
    to_tlog(path, [SimulatedUav(0, 3, wind=3.0, turbulence=2, faults=(fault,))], seconds=int(END_S), loss=0.01, seed=3)
    return tuple(replay_messages(path))


def test_with_what_was_named_predictions_are_nearer_than_without(faulty, monkeypatch):
    """Both receive the same; one learns at 100 s what happened at 70 s. Methods without identified model: left out."""
    monkeypatch.setattr(rollouts, "simple_paths", lambda *_: {})
    monkeypatch.setattr(rollouts, "predict_without_model", lambda *_: rollouts.no_prediction(""))
    begin = next(m.t for m in faulty if isinstance(m, Sample))
    twin, plain, said = Twin.of(1), None, {"with": [], "without": []}
    for message in faulty:
        told = advance(twin, (message,))
        if plain is None and message.t > begin + NAMED_S:
            plain = copy.deepcopy(twin)
            tried = adapt_models(twin, push(twin, begin + FAULT_S, airspeed_scale=0.8), "airspeed_scale")
            assert tried.used and tried.adapted_error < 0.95 * tried.present_error
        elif plain is not None:
            said["with"] += told
            said["without"] += advance(plain, (message,))
    miss = {who: missed([m for m in told if isinstance(m, Prediction)], faulty) for who, told in said.items()}
    assert miss["with"] < 0.7 * miss["without"]
    assert any("flown with airspeed_scale since" in m.sentence for m in said["with"] if isinstance(m, Prediction))
    assert all("flown with" not in m.sentence for m in said["without"] if isinstance(m, Prediction))
    assert any(m.active_effect.startswith("airspeed_scale since") for m in said["with"] if isinstance(m, Model))
    assert twin.identification.data_from == pytest.approx(begin + FAULT_S)


def missed(made: list[Prediction], heard: tuple[Message, ...], ahead: float = 20.0) -> float:
    """Mean distance between where it was predicted to be and where it was [m]."""
    rows = [m.position for m in heard if isinstance(m, Sample) and m.position is not None]
    t = np.concatenate([row.t.numpy() for row in rows])
    p = to_ned(made[0].ned_origin(), *np.concatenate([row.x.numpy() for row in rows]).astype(float).T)
    found = []
    for one in made:
        if one.t + ahead < t[-1]:
            at = [np.interp(ahead, one.ahead.numpy(), one.path.numpy()[:, k]) for k in range(3)]
            found.append(np.linalg.norm([np.interp(one.t + ahead, t, p[:, k]) - at[k] for k in range(3)]))
    assert len(found) > 15
    return float(np.mean(found))
