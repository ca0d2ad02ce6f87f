"""The paper's experiment on a tiny scale, its figures and its command; the DaISy bench with our method alone."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from conftest import exit_code

from fleet.airframes import GENERIC, load
from fleet.cli import main as fleet
from fleet.contract import Outcome
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.missions import WAYPOINT, paper_mission
from tests.support.flights import linear_flight, truth
from twin_worker.identification.fixed_wing.derivatives_model import identify
from twin_worker.identification.linear.linear_model import AXES
from twin_worker.identification.linear.prediction_error_method import free_run
from twin_worker.paper_experiments import __main__, experiment
from twin_worker.paper_experiments.experiment import (
    MODELS,
    STATE_NAMES,
    Experiment,
    ExperimentPlan,
    RecordedFlight,
    both_steps,
    choose_starts,
    read_flights,
)
from twin_worker.paper_experiments.free_run import coupled_free_run, linear_free_run
from twin_worker.telemetry.flight_phase import PHASES, phase_of
from twin_worker.validation.verify import fit_percent, verify_free_run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording of two aircraft."""
    path = tmp_path_factory.mktemp("paper") / "flight.tlog"
    to_tlog(path, [SimulatedUav(i, 5, wind=2.0, turbulence=1) for i in (0, 1)], seconds=110, loss=0.01, seed=5)
    return path


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    """One aircraft on the paper's mission in calm air."""
    path = tmp_path_factory.mktemp("calm") / "flight.tlog"
    uav = SimulatedUav(0, 907, wind=0.0, turbulence=0, plan=paper_mission(907))
    to_tlog(path, [uav], seconds=150, loss=0.01, seed=907)
    return next(read_flights(path))


def test_the_mission_climbs_stays_level_turns_and_descends(calm):
    plan = ExperimentPlan(every_s=1.0, each=10_000)
    modes = [phase_of(calm.recording.part(start, start + 100)) for _, start in choose_starts([calm], plan)]
    assert min(modes.count(mode) for mode in PHASES) >= 5
    items, start = paper_mission(907)
    heights = [entry.alt_m for entry in items if entry.command == WAYPOINT][1:]
    assert (
        heights[2] - heights[-1] > 20
        and heights[2] == heights[4]
        and heights[-1] == pytest.approx(-start.p[2], abs=0.1)
    )


@pytest.mark.parametrize(
    ("phi", "up", "mode"), [(0.0, 0, "level"), (0.1, 2, "climb"), (0.1, -2, "descent"), (-0.5, 2, "turn")]
)
def test_modes_are_told_apart(phi, up, mode):
    stretch = linear_flight(4.0)
    stretch.x[:, 6], stretch.v[:, 2] = phi, -up
    assert phase_of(stretch) == mode and mode in PHASES


@pytest.mark.parametrize("first", experiment.FIRST_STEPS)
@pytest.mark.parametrize("axis", AXES)
def test_both_steps_find_a_known_aircraft(axis, first):
    window = linear_flight(60.0, noise=0.01)
    start, better = both_steps(axis, window, first)
    known = truth()[AXES.index(axis)]
    n = len(known.states)
    wanted = np.sort(np.abs(np.linalg.eigvals(known.D[:, :n])))
    assert np.sort(np.abs(np.linalg.eigvals(better.D[:, :n]))) == pytest.approx(wanted, abs=0.03)
    assert start.states == better.states == known.states


@pytest.mark.parametrize("axis", AXES)
def test_a_constant_sensor_error_is_no_error_of_the_model(axis):
    """Measured angles are off by 0.25 deg: the run with bias follows them, the run from the measured state does not."""
    window = linear_flight(20.0, noise=0.002)
    window.x[:, 6:8] += 0.0044
    model = truth()[AXES.index(axis)]
    fitted, shown = slice(300, 325), slice(325, 425)
    estimated = linear_free_run(model, window, fitted, shown)
    y, u = model.scaled(window)
    measured_start = np.empty((100, len(model.states)))
    free_run(model.D, y[325], np.ascontiguousarray(u[325:425]), measured_start)
    actual = window.columns(model.states)[shown]
    of_bias, of_measured = (
        fit_percent(actual, run) for run in (estimated, measured_start * model.y_scale + model.y_mean)
    )
    assert of_bias.min() > 80 and 100 - of_bias.mean() < 0.5 * (100 - of_measured.mean())


def test_the_coupled_model_runs_from_an_estimated_start(calm):
    """Over its own data the coupled model of a calm flight fits every state better than its mean."""
    start = next(iter(calm.starts(40.0, 4.0, 5.0)))
    window = calm.window(start, 40.0, 4.0)
    model = identify(window.part(0, 1000), calm.wind[start], load(GENERIC))
    rows = slice(800, 1000)
    run = coupled_free_run(model, window, rows, rows, calm.wind[start])
    assert run.shape == (200, 9) and fit_percent(window.x[rows], run).min() > 0
    odd = coupled_free_run(model, window, slice(801, 1000), rows, calm.wind[start])  # 199 rows are 50 groups, one short
    assert odd.shape == (200, 9) and np.abs(odd - run).max() < 0.5


def test_the_experiments_of_a_mode_are_limited_and_spread(calm):
    plan = ExperimentPlan(every_s=1.0, each=3)
    starts = [start for _, start in choose_starts([calm], plan)]
    unseen = round(plan.unseen_s / calm.recording.dt)
    modes = [phase_of(calm.recording.part(start, start + unseen)) for start in starts]
    assert {mode: modes.count(mode) for mode in modes} == dict.fromkeys(modes, 3) and len(set(modes)) >= 3
    every = {start for _, start in choose_starts([calm], ExperimentPlan(every_s=1.0, each=10_000))}
    assert set(starts) < every


def test_in_calm_air_refined_and_coupled_beat_the_first_step(calm):
    plan = ExperimentPlan(every_s=4.0, each=6)
    results = list(experiment.run_experiments(choose_starts([calm], plan), "pbsid", plan))
    fit, seen = (np.array([getattr(result, name) for result in results]).mean(axis=2) for name in ("fit", "fit_seen"))
    assert len(results) >= 15 and (fit[:, 1] > fit[:, 0]).mean() > 0.8
    assert np.median(seen[:, 1]) > 60 and (np.median(seen, axis=0)[1:] > np.median(seen[:, 0])).all()
    assert np.median(fit[:, 2]) > np.median(fit[:, 0]) + 20


def test_a_run_verifies_above_the_threshold_and_persistence_does_not():
    window = linear_flight(10.0)
    y = window.x[100:200]
    assert verify_free_run(y, y, window)[0] is Outcome.VERIFIED
    outcome, reason = verify_free_run(y, np.repeat(y[:1], len(y), axis=0), window)
    assert outcome is Outcome.BELOW_THRESHOLD and "is needed" in reason
    assert verify_free_run(y, 0.5 * (y + y[0]), window)[0] is Outcome.VERIFIED


def test_the_wind_is_taken_out(recorded):
    one = next(read_flights(recorded))
    assert isinstance(one, RecordedFlight) and one.uav == 1
    start = next(iter(one.starts(40.0, 8.0, 5.0)))
    window = one.window(start, 40.0, 8.0)
    assert len(window) == 1200
    speed = {
        name: np.linalg.norm(w.columns(("u", "v", "w")), axis=1)
        for name, w in (("air", window), ("ground", one.recording))
    }
    assert speed["air"].std() < speed["ground"].std()


def test_the_command_flies_identifies_and_draws(tmp_path, capfd):
    out, numbers = tmp_path / "figures", tmp_path / "paper.json"
    flight = ["--uavs", "0", "--for", "100", "--first", "pbsid"]
    assert fleet(["paper", "identify", *flight, "--out", str(out), "--json", str(numbers)]) == 0
    said = capfd.readouterr()
    rows = json.loads(numbers.read_text())["first_step"]["pbsid"]
    assert rows and set(rows) <= set(PHASES) and json.loads(numbers.read_text())["air"] == "calm air"
    for mode, row in rows.items():
        assert mode in said.out
        assert sum(row["verdicts"].values()) == row["n"] and row["sentence"]
        states = row["unseen"]["states"]
        assert set(states) == set(STATE_NAMES) and {tuple(state) for state in states.values()} == {MODELS}
        assert all(-100 <= quartile <= 100 for state in states.values() for fit in state.values() for quartile in fit)
        assert (out / f"fig7_pbsid_{mode}.png").stat().st_size > 10_000
    assert (out / "fig8_pbsid.png").stat().st_size > 10_000 and (out / "fig8_pbsid_seen.png").exists()


def test_the_paired_gain_is_of_pairs():
    """Two pairs gain 10 each where the medians of the steps lie 90 apart: the pairs count."""

    def one(first: float, refined: float) -> Experiment:
        fit = np.array([np.full(9, first), np.full(9, refined), np.full(9, 50.0)])
        actual, runs = np.zeros((3, 9)), np.zeros((3, 3, 9))
        return Experiment(1, 0.0, "turn", "turn", np.zeros(3), actual, runs, fit, fit, Outcome.VERIFIED, "good")

    rows = __main__.summary([one(-80, -70), one(80, 90), one(-60, 70)])
    assert rows["turn"]["paired_gain"] == 10.0 and rows["turn"]["share_better"] == 1.0
    assert rows["turn"]["unseen"]["mean"] == {"first": -60.0, "refined": 70.0, "coupled": 50.0}
    assert list(rows) == ["turn"] and rows["turn"]["sentence"] == "good"


def test_what_cannot_be_identified_is_said_and_not_done(recorded):
    one = next(read_flights(recorded))
    one.recording.u[:] = 0.3
    plan = ExperimentPlan(every_s=20.0)
    told = list(experiment.run_experiments(choose_starts([one], plan), "projection", plan))
    assert told and all("input 0 is constant" in sentence for sentence in told)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--for", "10"], "found 10 s, expected 70..3600"),
        (["missing.tlog"], "missing.tlog"),
        (["--turbulence", "wild"], "wild"),
    ],
)
def test_wrong_use_is_one_sentence(words, sentence, capfd):
    assert exit_code(lambda: fleet(["paper", "identify", *words])) == 2
    said = capfd.readouterr().err
    assert sentence in said and "Traceback" not in said


def test_no_experiment_of_a_mode_is_an_error(capfd):
    assert __main__.main(["identify", "flight.tlog", "--each", "0"]) == 2
    assert "--each: found 0, expected 1 or more" in capfd.readouterr().err


def test_too_short_a_recording_is_said(tmp_path, capfd):
    path = tmp_path / "short.tlog"
    to_tlog(path, [SimulatedUav(0, 5)], seconds=30, loss=0.0, seed=5)
    assert __main__.main(["identify", str(path)]) == 2
    assert "no 44 s of data without gaps; record longer" in capfd.readouterr().err


def test_ctrl_c_ends_it_cleanly(recorded, tmp_path):
    numbers = tmp_path / "paper.json"
    command = [sys.executable, "-m", "fleet.cli", "paper", "identify", str(recorded), "--json", str(numbers)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert "reading" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert process.returncode == 130 and "Traceback" not in rest and "stopped" in rest
    assert not numbers.exists()


def test_the_bench_runs_our_method_on_daisy(recordings, tmp_path):
    numbers = tmp_path / "daisy.json"
    command = [
        sys.executable,
        "-m",
        "tests.bench.daisy",
        "--sets",
        "dryer",
        "--methods",
        "ours",
        "--json",
        str(numbers),
    ]
    subprocess.run(command, check=True, capture_output=True, env=os.environ | {"PARAUAV_RECORDINGS": str(recordings)})
    assert json.loads(numbers.read_text())["daisy"]["dryer"]["ours"] > 85
