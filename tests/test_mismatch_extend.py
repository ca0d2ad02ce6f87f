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
from fleet.simulator.faults.kinds import read
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import PretendUav
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.identification.fixed_wing.point_mass_with_effects import Added, extended
from twin_worker.mismatch.adapt_models import extend, extended_plant, wind_since
from twin_worker.mismatch.effect_increments import Push, moved
from twin_worker.twin.state.checkpoint import MOST, before
from twin_worker.twin.state.state import Twin
from twin_worker.twin.step import advance

FAULT_S, NAMED_S, END_S = 70.0, 100.0, 150.0


def push(twin: Twin, onset: float, **more) -> Push:
    """Nothing at all, at the newest minute's rows."""
    t = np.arange(twin.history.newest - 30.0, twin.history.newest - 1.0, 0.5)
    window = twin.window(60.0)
    command = np.column_stack([np.interp(t, window.t, window.u[:, k]) for k in range(4)])
    nothing = Push(t, np.zeros((len(t), 6)), command, command.copy(), np.zeros(3), 1.0, onset)
    return replace(nothing, **more)


def par_of(plant, name: str) -> float:
    return float(plant.par[NAMES.index(name)])


@pytest.fixture
def known(twin):
    """A twin, its newest mark with a model, and a fault that began half a minute ago."""
    onset = twin.history.newest - 30.0
    mark = before(twin.marks, onset)
    plant = mark.plant or twin.plant
    return twin, replace(mark, plant=plant, hybrid=mark.hybrid or twin.hybrid), onset


def test_marks_are_kept_as_far_back_as_telemetry(flown):
    twin = flown[0]
    t = np.array([mark.t for mark in twin.marks])
    assert 5 <= len(t) <= MOST and (np.diff(t) >= 10.0).all()
    assert before(twin.marks, t[0]) is None and before(twin.marks, t[2]).t == t[1]


def test_a_servo_that_does_half_halves_its_derivatives_alone(known):
    twin, mark, onset = known
    loss = Guess(catalogue()["control_effectiveness_loss"], "aileron", (0.5,))
    pushed = push(twin, onset)
    pushed = replace(pushed, moved=moved([loss], pushed.command))
    found = extended_plant(mark.plant, pushed, twin.window(60.0))
    for name in ("Y_da", "L_da", "N_da"):
        assert par_of(found, name) == pytest.approx(0.5 * par_of(mark.plant, name), rel=1e-6)
    for name in ("L_v", "L_p", "M_de", "X_dt", "N_dr"):
        assert par_of(found, name) == pytest.approx(par_of(mark.plant, name))


def test_a_servo_s_offset_becomes_a_moment(known):
    twin, mark, onset = known
    offset = Guess(catalogue()["actuator_offset"], "elevator", (0.1,))
    pushed = push(twin, onset)
    pushed = replace(pushed, moved=moved([offset], pushed.command))
    found = extended_plant(mark.plant, pushed, twin.window(60.0))
    gained = par_of(found, "M_0") - par_of(mark.plant, "M_0")
    assert gained == pytest.approx(0.1 * par_of(mark.plant, "M_de"), rel=1e-6)
    assert par_of(found, "M_de") == pytest.approx(par_of(mark.plant, "M_de"), rel=1e-6)


def test_a_lag_or_what_has_passed_moves_no_steady_command(twin):
    command = np.linspace(-0.4, 0.4, 28).reshape(7, 4)
    lag = Guess(catalogue()["actuator_lag"], "elevator", (0.3,))
    assert np.array_equal(moved([lag], command), command)


def test_a_force_is_spread_over_the_derivatives_that_make_it(known):
    """A tenth of the weight pulling back shows in X, as flown, and nowhere else."""
    twin, mark, onset = known
    wrench = np.zeros((len(push(twin, onset).t), 6))
    wrench[:, 0] = -1.0
    found = extended_plant(mark.plant, push(twin, onset, wrench=wrench), twin.window(60.0))
    changed = found.par - mark.plant.par
    assert np.abs(changed[NAMES.index("Z_0") : WIND]).max() < 1e-9 and np.abs(changed[:6]).max() > 0.1
    assert (np.diag(found.covariance) >= np.diag(mark.plant.covariance) - 1e-9).all()  # and it is in doubt
    assert not found.information.any()  # nothing of the flight before counts as seen again


def test_power_takes_the_force_along_the_flight(known):
    twin, mark, _ = known
    n = 60
    air = np.tile([20.0, 0.0, 1.0], (n, 1))
    added = Added(np.tile([-0.4, 0.0, 0.0], (n, 1)), air, np.zeros(n), np.full(n, 0.5), (False, False))
    short = twin.window(5.0)
    found = extended(mark.hybrid, short, twin.history, 1.0, added)
    at = np.array([1.0, 0.5 - found.body[H.T_0], np.hypot(20.0, 1.0) - found.body[H.V_0], 0.0])
    gained = (found.body - mark.hybrid.body)[H.C_0 : H.C_N + 1] @ at
    assert gained == pytest.approx(-0.4, abs=0.02)
    assert np.array_equal(found.body[: H.C_0], mark.hybrid.body[: H.C_0])  # lags, turn and lift stay


def test_wind_and_airspeed_sensor_jump_at_the_onset_and_the_mark_stays(known):
    twin, mark, _ = known
    jumped, before_, wind = copy.deepcopy(mark.wind), mark.wind.scale, mark.wind.wind.copy()
    jumped.jump(np.array([3.0, -2.0, 0.0]), 1.25, 0.3)
    assert jumped.scale == pytest.approx(1.25 * before_)
    assert jumped.wind - wind == pytest.approx([3.0, -2.0, 0.0])
    onset = twin.history.newest - 1.5
    calm, _ = wind_since(twin, push(twin, onset), mark)
    told, t = wind_since(twin, push(twin, onset, scale=0.8), mark)
    assert told.scale > calm.scale + 0.01  # what is flown since pulls it back: nothing is wrong with this sensor
    assert twin.wind_t <= t <= twin.history.newest and mark.wind.scale == before_


def test_nothing_changes_without_a_mark_from_before(twin):
    twin.marks.clear()
    kept = twin.plant, twin.hybrid, twin.wind
    tried = extend(twin, push(twin, twin.history.newest - 30.0), "thrust_loss")
    assert not tried.used and "no flight to compare" in tried.said
    assert (twin.plant, twin.hybrid, twin.wind) == kept and twin.extended is None


def test_an_effect_that_is_not_there_is_not_flown_with(twin):
    tried = extend(twin, push(twin, twin.history.newest - 30.0, scale=0.6), "airspeed_scale")
    assert not tried.used and tried.extended > tried.present and twin.extended is None
    assert "the identified model is used unchanged" in tried.said


@pytest.fixture(scope="module")
def faulty(tmp_path_factory) -> tuple[Message, ...]:
    """A pretend aircraft whose airspeed reads a fifth too little from 70 s on."""
    path: Path = tmp_path_factory.mktemp("faulty") / "flight.tlog"
    fault = read(f"airspeed_scale,scale=0.8,at={FAULT_S}", "small")
    to_tlog(path, [PretendUav(0, 3, wind=3.0, turbulence=2, faults=(fault,))], seconds=int(END_S), loss=0.01, seed=3)
    return tuple(replay_messages(path))


def test_with_what_was_named_predictions_are_nearer_than_without(faulty):
    """Both hear the same; one is told at 100 s what happened at 70 s."""
    begin = next(m.t for m in faulty if isinstance(m, Sample))
    twin, plain, said = Twin(1), None, {"with": [], "without": []}
    for message in faulty:
        told = advance(twin, (message,))
        if plain is None and message.t > begin + NAMED_S:
            plain = copy.deepcopy(twin)
            tried = extend(twin, push(twin, begin + FAULT_S, scale=0.8), "airspeed_scale")
            assert tried.used and tried.extended < 0.95 * tried.present
        elif plain is not None:
            said["with"] += told
            said["without"] += advance(plain, (message,))
    miss = {who: missed([m for m in told if isinstance(m, Prediction)], faulty) for who, told in said.items()}
    assert miss["with"] < 0.7 * miss["without"]
    assert any("flown with airspeed_scale since" in m.sentence for m in said["with"] if isinstance(m, Prediction))
    assert all("flown with" not in m.sentence for m in said["without"] if isinstance(m, Prediction))
    assert any(m.extended.startswith("airspeed_scale since") for m in said["with"] if isinstance(m, Model))
    assert twin.learn_from == pytest.approx(begin + FAULT_S)


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
