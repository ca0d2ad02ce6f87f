"""The paper's experiment on a tiny scale, its figures and its command; the DaISy bench with our method alone."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from fleet.cli import main as fleet
from fleet.contract import Outcome
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from tests.support.flights import linear_flight, truth
from twin_worker.identification.linear.linear_model import AXES
from twin_worker.paper_experiments import __main__, experiment
from twin_worker.paper_experiments.experiment import (
    STATE_NAMES,
    Experiment,
    ExperimentPlan,
    RecordedFlight,
    both_steps,
    read_flights,
)
from twin_worker.telemetry.flight_phase import PHASES, phase_of


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording of two aircraft."""
    path = tmp_path_factory.mktemp("paper") / "flight.tlog"
    to_tlog(path, [SimulatedUav(i, 5, wind=2.0, turbulence=1) for i in (0, 1)], seconds=110, loss=0.01, seed=5)
    return path


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
    start, better = both_steps(axis, window, first, 8.0)
    known = truth()[AXES.index(axis)]
    n = len(known.states)
    wanted = np.sort(np.abs(np.linalg.eigvals(known.D[:, :n])))
    assert np.sort(np.abs(np.linalg.eigvals(better.D[:, :n]))) == pytest.approx(wanted, abs=0.03)
    assert start.states == better.states == known.states


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
    flight = ["--uavs", "0-1", "--for", "100", "--first", "pbsid"]
    assert fleet(["paper", "identify", *flight, "--out", str(out), "--json", str(numbers)]) == 0
    said = capfd.readouterr()
    rows = json.loads(numbers.read_text())["first_step"]["pbsid"]
    assert rows and set(rows) <= set(PHASES)
    for mode, row in rows.items():
        assert mode in said.out
        assert sum(row["verdicts"].values()) == row["n"] and row["sentence"]
        assert set(row["states"]) == set(STATE_NAMES)
        assert all(-100 <= q <= 100 for state in row["states"].values() for q in (*state["first"], *state["refined"]))
        assert (out / f"fig7_pbsid_{mode}.png").stat().st_size > 10_000
    assert (out / "fig8_pbsid.png").stat().st_size > 10_000 and (out / "fig8_pbsid_seen.png").exists()


def test_the_paired_gain_is_of_pairs():
    """Two pairs gain 10 each where the medians of the steps lie 90 apart: the pairs count."""

    def one(first: float, refined: float) -> Experiment:
        fit = np.array([np.full(9, first), np.full(9, refined)])
        runs = np.zeros((3, 9))
        return Experiment(1, 0.0, "turn", "turn", np.zeros(3), runs, runs, runs, fit, fit, Outcome.VERIFIED, "good")

    rows = __main__.summary([one(-80, -70), one(80, 90), one(-60, 70)])
    assert rows["turn"]["paired_gain"] == 10.0 and rows["turn"]["share_better"] == 1.0
    assert rows["turn"]["fit"] == {"first": -60.0, "refined": 70.0}
    assert list(rows) == ["turn"] and rows["turn"]["sentence"] == "good"


def test_what_cannot_be_identified_is_said_and_not_done(recorded):
    one = next(read_flights(recorded))
    one.recording.u[:] = 0.3
    told = list(experiment.run_experiments([one], "projection", ExperimentPlan(every_s=20.0)))
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
    assert fleet(["paper", "identify", *words]) == 2
    said = capfd.readouterr().err
    assert sentence in said and "Traceback" not in said


def test_too_short_a_recording_is_said(tmp_path, capfd):
    path = tmp_path / "short.tlog"
    to_tlog(path, [SimulatedUav(0, 5)], seconds=30, loss=0.0, seed=5)
    assert __main__.main(["identify", str(path)]) == 2
    assert "no 48 s of data without gaps; record longer" in capfd.readouterr().err


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
