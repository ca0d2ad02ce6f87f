"""Assessment end to end: as if live and never looking ahead, what counts, what is written, what goes wrong."""

import json
import os
import signal
import subprocess
import sys
from itertools import islice

import numpy as np
import pytest
from conftest import exit_code

from fleet.cli import main as fleet
from fleet.commands.offline.assess import BASELINE_METHODS
from fleet.contract import Message, Mission, Params, Prediction, Status
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.telemetry.recording.recordings import replay_messages
from tests.support.flights import T0, item, messages, turn
from twin_worker.evaluation.__main__ import main
from twin_worker.evaluation.baselines import BASELINES
from twin_worker.evaluation.drive import EvaluationPlan, RecordingDriver
from twin_worker.evaluation.scoring.compare import MIN_EVENT_FREE_S, MIN_FIRST_S
from twin_worker.evaluation.scoring.log import OURS, ReferenceFlight
from twin_worker.evaluation.scoring.summary import short_flights
from twin_worker.evaluation.share import assess_recordings
from twin_worker.evaluation.table import KEYS, covariance, notes

KEYS_OF_A_METHOD = {
    "m1_t10_lq_s",
    "m1_t10_median_s",
    "survive_60",
    "m1_t5_lq_s",
    "m1_t3_lq_s",
    "m2_t10_lq_s",
    "p50_m",
    "p90_m",
    "coverage",
    "half_axes_m",
    "horizon_hit_rate",
    "horizon_rank_corr",
    "starts",
    "flights",
    "phases",
}
SECONDS = 200.0
FEW = EvaluationPlan(every_s=20.0, methods=("cv", "route_wind", "dynamics", "paper"))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two aircraft, long enough for a few starts to count."""
    path = tmp_path_factory.mktemp("assess") / "flight.tlog"
    to_tlog(path, [SimulatedUav(i, 3, wind=3.0, turbulence=2) for i in (0, 1)], seconds=SECONDS, loss=0.01, seed=3)
    return path


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Two aircraft, too short for a start to count."""
    path = tmp_path_factory.mktemp("short") / "short.tlog"
    to_tlog(path, [SimulatedUav(i, 3) for i in (0, 1)], seconds=40, loss=0.0, seed=3)
    return path


@pytest.fixture(scope="module")
def one(recorded):
    """The first of them as the gateway would have published it."""
    return [message for message in replay_messages(recorded) if message.uav == 1]


@pytest.fixture(scope="module")
def driven(one):
    """Its starts, and how many messages had been heard at each."""
    drive, heard = RecordingDriver("flight", FEW), []

    def counted():
        for number, message in enumerate(one):
            known = drive.uavs.get(1)
            heard.extend([number] * (len(known.starts) - len(heard) if known else 0))
            yield message

    return list(drive.run(counted())), heard


@pytest.fixture(scope="module")
def cases(driven):
    return driven[0]


# --- as if live ------------------------------------------------------------------------------------------------------


def test_every_method_is_asked_at_every_start(cases):
    assert 8 <= len(cases) <= 10
    for case in cases:
        assert set(case.start.forecasts) == {OURS, *FEW.methods}
        assert all(one.path.shape == (len(case.start.ahead), 3) for one in case.start.forecasts.values())
    late = cases[-1].start.forecasts
    assert late["cv"].source == "cv" and late["route_wind"].source == "route_wind"
    assert late["paper"].source == "paper" and late["dynamics"].source == "dynamics"
    assert cases[0].start.forecasts["dynamics"].source == "imm"  # nothing identified yet: it stands in and is counted


def test_starts_count_after_the_window_and_with_a_minute_to_follow(cases):
    counted = [case for case in cases if not case.exclusion]
    times = [case.start.first_s for case in counted]
    assert len(counted) == 1 and min(times) >= MIN_FIRST_S and max(times) <= SECONDS - MIN_EVENT_FREE_S
    assert {case.exclusion for case in cases} == {"", "within 120 s of the first sample", "recording ends within 60 s"}
    assert all(np.isfinite(case.positions[case.start.ahead <= MIN_EVENT_FREE_S]).all() for case in counted)
    last = cases[-1]
    known = np.isfinite(last.positions[:, 0])
    assert 0 < known.sum() < len(known) and not known[-1]  # the recording ended first


def test_nothing_later_is_known_at_a_start(one, driven):
    """Cut the recording where a start was asked: every method says the same to the last bit."""
    cases, heard = driven
    chosen = 5
    cut = list(RecordingDriver("flight", FEW).run(islice(one, heard[chosen])))
    assert len(cut) == chosen + 1 and 0 < heard[chosen] < 0.6 * len(one)
    for name, told in cases[chosen].start.forecasts.items():
        again = cut[-1].start.forecasts[name]
        assert np.array_equal(told.path, again.path) and told.source == again.source, name
    assert np.array_equal(cut[-1].start.forecasts[OURS].tube, cases[chosen].start.forecasts[OURS].tube)
    assert np.isnan(cut[-1].positions[2:]).all() and cut[-1].exclusion


def test_ours_is_what_a_twin_publishes(one, cases):
    from twin_worker.evaluation.replay import run_offline

    by_t = {p.t: p.path.numpy() for p in run_offline(one[: len(one) // 3], {}) if isinstance(p, Prediction)}
    for case in cases[:3]:
        assert np.array_equal(by_t[case.start.t], case.start.forecasts[OURS].path)


def test_parameters_can_be_withheld(one):
    plan = EvaluationPlan(every_s=10.0, methods=(), without_params=True)
    drive = RecordingDriver("flight", plan)
    groups = [case.start.group for case in drive.run(one[: len(one) // 5])]
    without = {group.rpartition("/")[2] for group in groups if not group.startswith("imm")}
    assert without and without <= {"absent", "identified"}
    assert drive.uavs[1] is not None and drive.uavs[1].twin.onboard.params is None
    known = list(RecordingDriver("flight", EvaluationPlan(every_s=30.0, methods=())).run(one[: len(one) // 5]))
    assert known and all(case.start.group.endswith("/known") for case in known)


# --- what ends a prediction ------------------------------------------------------------------------------------------


def status(t: float, mode: str = "AUTO", armed: bool = True) -> Status:
    return Status(uav=1, t=t, mode=mode, armed=armed, autopilot="ardupilot", vehicle="fixed_wing")


ROUTE = Mission(uav=1, t=T0, items=(item(0), item(1, north=500.0)), seq=1, complete=True)
LANDING = Mission(uav=1, t=T0, items=(item(0), item(1, 21, north=500.0)), seq=1, complete=True)


def logged(*news: Message) -> ReferenceFlight:
    """A log of 100 s of flight with news at their times."""
    log = ReferenceFlight()
    for message in sorted((*messages(turn(100.0)), *news), key=lambda message: message.t):
        log.add(message)
    return log


@pytest.mark.parametrize(
    ("news", "at", "why"),
    [
        ((), 99.9, "recording ends"),
        ((status(T0), status(T0 + 40, "LOITER")), 40.0, "mode changed"),
        ((status(T0), status(T0 + 30, armed=False)), 30.0, "disarmed"),
        ((ROUTE, Mission(uav=1, t=T0 + 50, items=(*ROUTE.items, item(2)), complete=True)), 50.0, "mission changed"),
        ((Params(uav=1, t=T0, values={"WP_RADIUS": 30.0}), Params(uav=1, t=T0 + 60, values={"WP_RADIUS": 90.0})), 60.0,
         "parameters changed"),
    ],
)  # fmt: skip
def test_an_event_ends_what_can_be_asked(news, at, why):
    end, said = logged(*news).next_event(T0 + 10.0)
    assert said == why and end - T0 == pytest.approx(at, abs=0.2)


def test_what_only_arrives_is_no_event():
    """A mission downloaded again, parameters heard again or counted on, statuses that repeat."""
    again = Mission(uav=1, t=T0 + 30, items=ROUTE.items, seq=1, complete=True)
    half = Mission(uav=1, t=T0 + 20, items=ROUTE.items[:1], complete=False)
    params = [Params(uav=1, t=T0 + k, values={"WP_RADIUS": 30.0, "STAT_RUNTIME": float(k)}) for k in (5, 30)]
    log = logged(status(T0), ROUTE, half, again, *params, status(T0 + 50))
    assert log.next_event(T0 + 10.0)[1] == "recording ends"


def test_a_landing_counts_from_its_item_on():
    assert logged(LANDING).next_event(T0 + 10.0) == (T0 + 11.0, "landing")


def test_a_hole_in_the_positions_is_not_filled():
    laid = turn(100.0)
    t, x = laid["position"]
    keep = (t - T0 < 40.0) | (t - T0 > 52.0)
    log = ReferenceFlight()
    for message in messages(laid | {"position": (t[keep], x[keep])}):
        log.add(message)
    assert log.has_position(T0 + np.array([30.0, 41.0, 45.0, 51.0, 60.0, 140.0])).tolist() == [
        True, True, False, True, True, False,
    ]  # fmt: skip


def test_what_flies_without_a_mission_is_told_apart():
    drive = RecordingDriver("flight", EvaluationPlan(every_s=20.0, methods=("route",)))
    found = list(drive.run(sorted((status(T0, "FBWB"), *messages(turn(100.0))), key=lambda m: m.t)))
    assert found and {case.exclusion for case in found} == {"mode FBWB follows no mission"}
    assert all(case.start.forecasts["route"].source == "imm" for case in found)


def test_a_short_mission_is_scored_as_far_as_it_goes():
    """No start of 40 s in AUTO has a minute: they are scored up to the change of mode, and the flight is listed."""
    flight = turn(220.0)
    news = (status(T0), ROUTE, status(T0 + 175.0, "STABILIZE"))
    drive = RecordingDriver("flight", EvaluationPlan(every_s=5.0, methods=("route",)))
    cases = list(drive.run(sorted((*messages(flight), *news), key=lambda m: m.t)))
    counted = [case for case in cases if not case.exclusion]
    assert counted and all(T0 + 120.0 <= case.start.t <= T0 + 165.0 for case in counted)
    for case in counted:
        known = case.start.ahead[np.isfinite(case.positions).all(axis=1)]
        assert case.start.t + known[-1] <= T0 + 175.5
    assert short_flights(cases) == ["flight:uav-1"]


# --- what is written -------------------------------------------------------------------------------------------------


def test_the_command_scores_draws_and_writes(recorded, tmp_path, capfd):
    out, numbers = tmp_path / "figures", tmp_path / "assess.json"
    options = ["--every", "10", "--jobs", "2", "--out", str(out), "--json", str(numbers)]
    assert fleet(["assess", str(recorded), *options]) == 0
    said = capfd.readouterr()
    told = json.loads(numbers.read_text())
    assert set(told) == {OURS, *BASELINE_METHODS, "compare", "apart", "run"}
    for name in (OURS, *BASELINE_METHODS):
        assert set(told[name]) >= KEYS_OF_A_METHOD, name
        assert told[name]["flights"] == 2 and told[name]["starts"] == told[OURS]["starts"] >= 4
        assert set(told[name]["p50_m"]) >= {"5", "10", "16", "30", "60"}
    assert set(told[OURS]["coverage"]) == set(told[OURS]["half_axes_m"]) == set(told[OURS]["p50_m"])
    assert all(len(axes) == 3 for axes in told[OURS]["half_axes_m"].values())
    assert told["run"]["counted"] == told[OURS]["starts"] and told["run"]["silent"] == 0
    assert told[OURS]["p50_m"]["16"] < told["cv"]["p50_m"]["16"]
    assert set(told["compare"]) == set(BASELINE_METHODS)
    for words in ("starts of 2 flights", "[s]", "[m]", "method of the paper", "excluded:", "ours minus each"):
        assert words in said.out
    for name in (
        "fig9a_route",
        "fig9b_relative_error",
        "fig9c_within_10_percent",
        "coverage",
        "pit",
        "error",
        "phases",
    ):
        assert (out / f"{name}.png").stat().st_size > 10_000
    _check_file(out / "predictions.npz", told[OURS]["starts"])
    assert (out / "predictions_apart.npz").exists()


def _check_file(path, starts: int) -> None:
    """Score the file as a stranger would, by what its keys say."""
    with np.load(path, allow_pickle=False) as file:
        held = {name: file[name] for name in file.files}
    assert set(held) == set(KEYS)
    s, k = held["path"].shape[:2]
    assert s == starts and held["ahead"].shape == (k,) and held["covariance"].shape == (s, k, 3, 3)
    for name in ("t", "latitude", "longitude", "altitude", "length", "predicted_length"):
        assert held[name].shape == (s, k) and np.isfinite(held[name]).all(), name
    assert np.allclose(held["t"], held["t0"][:, None] + held["ahead"])
    for spread in held["spread"]:  # a method without ensemble has none
        assert np.isnan(spread).all() or (spread >= 0).all()
    assert all(word.count("/") == 3 for word in held["group"]) and set(held["uav"]) == {1, 2}
    assert not any(held["apart"]) and np.isfinite(held["flown"][:, : int(MIN_EVENT_FREE_S)]).all()
    metres = np.hypot(*(np.diff(held["latitude"][0, [0, 1]]) * 111_000, np.diff(held["path"][0, [0, 1], 0])))
    assert metres[0] < 60.0  # one second apart


def test_the_covariance_lies_along_the_path():
    east = np.column_stack([np.zeros(5), 20.0 * np.arange(5), np.zeros(5)])
    found = covariance(east, np.tile([30.0, 10.0, 5.0], (5, 1)))
    sigma = np.sqrt(np.diagonal(found, axis1=1, axis2=2))
    assert np.allclose(sigma / sigma[:, 2:], [2.0, 6.0, 1.0]) and np.allclose(found[:, 0, 1], 0.0)
    inside = np.abs(np.random.default_rng(0).standard_normal((100_000, 3)) * sigma[0]) <= [10.0, 30.0, 5.0]
    assert inside.all(axis=1).mean() == pytest.approx(0.9, abs=0.005)


def test_processes_share_the_aircraft_and_change_nothing(short):
    plan = EvaluationPlan(every_s=10.0, methods=("cv",))
    alone, shared = (assess_recordings([short], plan, jobs=jobs).cases for jobs in (1, 2))
    assert [case.start.uav for case in alone] == [case.start.uav for case in shared]
    assert {case.start.uav for case in alone} == {1, 2}
    for one, other in zip(alone, shared, strict=True):
        assert np.array_equal(one.start.forecasts[OURS].path, other.start.forecasts[OURS].path)
        assert np.array_equal(one.positions, other.positions, equal_nan=True)


def test_the_papers_experiment_asks_the_papers_way_beside_ours(short, tmp_path):
    numbers = tmp_path / "paper.json"
    assert fleet(["paper", "predict", str(short), "--json", str(numbers)]) == 1  # no start counts
    told = json.loads(numbers.read_text())
    assert told["run"]["methods"] == ["paper", "route_wind"] and told["run"]["every_s"] == 5.0
    assert told["run"]["counted"] == 0 and told["run"]["apart"] >= 10


# --- wrong use -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["missing.tlog"], "FILE: found no file 'missing.tlog', expected a recording; check the path"),
        (["FILE", "--every", "0"], "--every: found 0 s, expected 1..600"),
        (["FILE", "--methods", "cv,magic"], "--methods: found magic, expected some of"),
        (["FILE", "--jobs", "0"], "--jobs: found 0, expected 1..64; change it"),
        (["FILE", "--json", "nowhere/a.json"], "--json: found no folder 'nowhere', expected one; create it first"),
        (["FILE", "--json", "FILE"], "expected another file; rename it"),
        (["FILE", "--out", "FILE"], "expected a folder; name another"),
        (["TEXT"], "found no recording in it, expected one of"),
    ],
)
def test_wrong_use_is_one_sentence(recorded, tmp_path, capfd, words, sentence):
    text = tmp_path / "notes.txt"
    text.write_text("hello")
    given = [word.replace("FILE", str(recorded)).replace("TEXT", str(text)) for word in words]
    code = exit_code(lambda: fleet(["assess", *given]))
    said = capfd.readouterr().err
    assert code == 2 and sentence in said and "Traceback" not in said


def test_too_short_a_recording_counts_no_start_and_says_so(short, tmp_path, capsys):
    out = tmp_path / "out"
    assert main([str(short), "--methods", "cv", "--out", str(out)]) == 1
    said = capsys.readouterr().out
    assert "no start is included: " in said and "are excluded, see below" in said and "excluded:" in said
    assert [made.name for made in out.iterdir()] == ["predictions_apart.npz"]


@pytest.mark.parametrize(
    ("run", "words"),
    [
        ({"counted": 0, "silent": 7}, "7 on a mission have no prediction"),
        ({"counted": 3, "silent": 0}, "3 lack a prediction of some method"),
        ({"counted": 0, "silent": 0}, "no prediction, and no mission flown after the first 120 s"),
    ],
)
def test_the_table_says_why_it_has_no_figures_as_the_json_does(run, words):
    assert notes({"apart": {}, "compare": {}, "run": run}, []) == [f"no start is included: {words}"]


def test_too_few_starts_for_the_papers_experiment_are_refused(capfd):
    assert fleet(["paper", "predict", "--uavs", "0", "--for", "210"]) == 2
    assert "found time for 6 starts, expected 20" in capfd.readouterr().err


def test_ctrl_c_ends_it_cleanly(recorded, tmp_path):
    numbers = tmp_path / "assess.json"
    command = [sys.executable, "-m", "fleet.cli", "assess", str(recorded), "--json", str(numbers), "--jobs", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ.copy()) as process:
        assert "compiling" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert process.returncode == 130 and "Traceback" not in rest and "stopped" in rest
    assert not numbers.exists()


def test_the_methods_of_the_command_are_those_there_are():
    assert set(BASELINE_METHODS) == {*BASELINES, "paper"}
