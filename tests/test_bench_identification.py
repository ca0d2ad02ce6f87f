"""The identification bench's own pieces: the yardstick flies, the scores are right, nobody sees what comes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleet.frames import body_to_ned
from tests.bench.identification import gusty, yardstick
from tests.bench.identification.__main__ import main
from tests.bench.identification.flight import Case, Flight
from tests.bench.identification.measure import foretold, over, run, summary
from tests.bench.identification.ours import Ours
from tests.bench.identification.plain import Hold, WindowMean
from tests.bench.identification.score import KEYS, fit_percent, scores
from tests.bench.identification.windows import spans

DT = 0.04


@pytest.fixture(scope="module")
def calm() -> list[Case]:
    return gusty.cases("calm", 3)[:2]


def made_up(x: np.ndarray, u: np.ndarray | None = None, name: str = "made-up") -> Flight:
    n = len(x)
    inputs = np.zeros((n, 4)) if u is None else u
    return Flight(name, 0, DT, DT * np.arange(n), x, inputs, np.full(n, np.nan), np.ones(n, bool), 2.0)


# --- the yardstick ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_every_built_aircraft_trims_and_stays_there(seed):
    airframe = yardstick.built(np.random.default_rng(seed))
    x, trim = yardstick.trimmed(airframe)
    assert np.abs(yardstick.derivative(airframe, x, trim, np.zeros(3))).max() < 1e-6
    assert 0 < trim[3] < 1 and abs(trim[1]) < 0.6
    flown = yardstick.replay(airframe, x, trim, np.tile(trim, (50, 1)), np.zeros(2))
    assert np.allclose(flown[-1], x, atol=1e-6)


@pytest.mark.parametrize(("surface", "rate"), [(0, 3), (1, 4), (2, 5)], ids=["aileron", "elevator", "rudder"])
def test_surfaces_of_the_yardstick_have_the_signs_of_the_house(surface, rate):
    airframe = yardstick.Airframe()
    x, trim = yardstick.trimmed(airframe)
    pushed = trim.copy()
    pushed[surface] += 0.1
    flown = yardstick.replay(airframe, x, trim, np.tile(pushed, (6, 1)), np.zeros(2))
    assert flown[-1, rate] > 0.01


def test_throttle_of_the_yardstick_pushes_forward():
    airframe = yardstick.Airframe()
    x, trim = yardstick.trimmed(airframe)
    trim_and_more = np.tile(trim + np.array([0, 0, 0, 0.1]), (10, 1))
    flown = yardstick.replay(airframe, x, trim, trim_and_more, np.zeros(2))
    assert flown[-1, 0] > x[0] + 0.1


def test_a_yardstick_flight_follows_its_commands_and_gusts_have_their_strength():
    case = gusty.cases("gust", 1)[0]
    f = case.flight
    assert np.isfinite(f.x).all() and len(f) == round(gusty.SECONDS / DT)
    assert abs(np.mean(f.Va) - yardstick.CRUISE) < 2.0
    assert np.abs(f.x[:, 6]).max() < 1.2 and np.ptp(f.x[:, 8]) > 0.5
    assert np.all(np.abs(f.u[:, :3]) <= 1) and np.all((f.u[:, 3] >= 0) & (f.u[:, 3] <= 1))
    again = gusty.cases("gust", 1)[0].flight
    assert np.array_equal(f.x, again.x)
    assert not np.array_equal(f.x, gusty.cases("gust", 2)[0].flight.x)


def test_dryden_gusts_have_the_deviation_asked_for():
    rng, sigma = np.random.default_rng(0), np.array([1.0, 2.0, 0.5])
    gusts = np.zeros(5)
    flown = [yardstick.blow(gusts, white, sigma) for white in rng.standard_normal((200_000, 3))]
    assert np.std(flown, axis=0) == pytest.approx(sigma, rel=0.15)


def test_velocities_are_over_ground_and_not_through_the_air():
    f = gusty.cases("gust", 1)[1].flight
    ground = body_to_ned(*f.x[:, 6:9].T, f.x[:, :3])
    tail = np.linalg.norm(ground, axis=1) - f.Va  # wind along the track
    assert 2.0 < np.abs(tail).max() < 8.0


def test_the_oracle_knows_the_calm_and_starts_where_the_flight_is(calm):
    case = calm[0]
    told = case.oracle.forecast(1000, 1000)
    assert np.abs(told[0] - case.flight.x[1000]).max() < 0.5
    ahead = case.flight.x[1000:2000]
    assert np.median(fit_percent(ahead, told, np.ones(1000, bool))) > 50
    each = case.oracle.kstep(1000, 1100, 10)
    assert np.allclose(each[7], case.oracle.forecast(1007, 11)[10])


# --- windows and scores ----------------------------------------------------------------------------------------------


def test_the_fit_of_known_signals():
    y = np.column_stack([np.sin(np.arange(100.0)), np.arange(100.0), np.ones(100)])
    ok = np.ones(100, bool)
    mean = np.tile(y.mean(axis=0), (100, 1))
    assert fit_percent(y, y, ok) == pytest.approx([100, 100, 100])
    assert fit_percent(y, mean, ok)[:2] == pytest.approx([0, 0], abs=1e-9)
    assert fit_percent(y, 0.5 * (y + mean), ok)[:2] == pytest.approx([50, 50])
    assert fit_percent(y, y + 1e9, ok) == pytest.approx([-100] * 3)
    broken = y.copy()
    broken[3, 0] = np.nan
    assert fit_percent(y, broken, ok)[:2] == pytest.approx([-100, 100])
    ok[3] = False
    assert fit_percent(y, broken, ok)[0] == pytest.approx(100)


class Perfect:
    """Knows the flight by heart."""

    def __init__(self, flight: Flight) -> None:
        self.flight = flight

    def identify(self, known: Flight, start: int) -> "Perfect":
        assert np.shares_memory(known.x, self.flight.x) and start < len(known)
        return self

    def forecast(self, known: Flight, u: np.ndarray) -> np.ndarray:
        at = len(known)
        assert np.array_equal(u, self.flight.u[at : at + len(u)])
        return self.flight.x[at : at + len(u)]

    def kstep(self, flight: Flight, k: int) -> np.ndarray:
        return flight.x[k:]


def test_a_perfect_model_scores_hundred_and_a_shifted_one_does_not(calm):
    flight = calm[0].flight
    assert scores(Perfect(flight), flight, 1000, 2000) == pytest.approx(dict.fromkeys(KEYS, 100.0))
    shifted = made_up(np.roll(flight.x, 20, axis=0), flight.u)
    found = scores(Perfect(shifted), flight, 1000, 2000)
    assert found["lon40"] < 90 and found["lat40"] < 90 and found["lon4"] == 100


def test_holding_still_is_scored_at_every_horizon():
    t = DT * np.arange(2000)
    x = np.column_stack([np.sin(2 * np.pi * t / 8.0)] * 9)
    found = scores(Hold().identify(made_up(x), 0), made_up(x), 1000, 2000)
    assert found["lon4"] == pytest.approx(-100)  # half a period later: the opposite
    assert found["lon_step"] == pytest.approx(100 * (1 - 2 * np.sin(np.pi * DT / 8.0)), abs=0.5)
    assert found["lat1"] == pytest.approx(100 * (1 - 2 * np.sin(np.pi / 8.0)), abs=3)


def test_windows_lie_behind_each_other_and_are_shared_fairly(calm):
    laid = spans(calm, 40.0, 40.0, None)
    assert [(s.start, s.at, s.stop) for s in laid[0][:2]] == [(0, 1000, 2000), (1000, 2000, 3000)]
    assert len(laid[0]) == 5 and laid[0][-1].stop == 6000 == len(calm[0].flight)
    few = spans(calm, 40.0, 20.0, 3)
    assert [len(found) for found in few] == [2, 1] and few[0][1].at == 1500
    short, whole = spans(calm, 20.0, 40.0, None), [s.at for s in laid[0]]
    assert [s.at for s in short[0]] == whole and short[0][0].start == 500


class Moody:
    """Fails in every other window, in the way some packages do."""

    def __init__(self) -> None:
        self.calls = 0

    def identify(self, known: Flight, start: int):
        self.calls += 1
        if self.calls % 2 == 0:
            raise SystemExit("gave up")
        return WindowMean().identify(known, start)


def test_a_method_that_gives_up_has_failed_and_the_reason_is_kept(calm):
    laid = spans(calm, 40.0, 40.0, 6)
    moody, mean = run(Moody, calm, laid), run(WindowMean, calm, laid)
    found = summary(moody)
    assert found["failed"] == 2 and found["n"] == 6 and found["trouble"] == ["SystemExit: gave up"]
    assert [row["lon40"] for row in moody.rows].count(-100.0) >= 2
    assert over(mean, moody, "lat40")["won"] == pytest.approx(2 / 6, abs=1e-3)
    assert over(mean, mean, "lat40") == {"median": 0.0, "quartiles": [0.0, 0.0], "won": 0.0}


def test_the_oracle_beats_the_window_mean(calm):
    laid = spans(calm, 40.0, 40.0, None)
    best, mean = foretold(calm, laid), run(WindowMean, calm, laid)
    assert all(over(best, mean, key)["median"] > 20 for key in ("lon40", "lat40", "lon4", "lat4"))
    assert foretold([Case(calm[0].flight)], laid[:1]) is None


def test_ours_runs_end_to_end_and_sees_nothing_of_what_comes(calm):
    case, ours = calm[0], Ours()
    flight = case.flight
    broken = replace(flight, x=flight.x.copy(), u=flight.u.copy(), Va=flight.Va.copy())
    for rows in (broken.x, broken.u, broken.Va):
        rows[2000:] = np.nan
    models = [Ours().identify(f.part(0, 2000), 1000) for f in (flight, broken)]
    runs = [model.forecast(flight.part(0, 2000), flight.u[2000:3000]) for model in models]
    assert np.array_equal(*runs) and runs[0].shape == (1000, 9)
    known = ours.identify(flight.part(0, 2000), 1000)
    held = Hold().identify(flight.part(0, 2000), 1000)
    assert scores(known, flight, 2000, 3000)["lat4"] > scores(held, flight, 2000, 3000)["lat4"]
    assert known.kstep(flight.part(2000, 2100), 25).shape == (75, 9)


def test_the_command_writes_the_keys_that_were_promised(tmp_path: Path, capsys):
    path = tmp_path / "found.json"
    asked = ["--scenario", "calm", "--method", "window_mean", "--method", "oracle", "--windows", "3"]
    assert main([*asked, "--json", str(path)]) == 0
    row = json.loads(path.read_text())["calm"]["window_mean"]
    assert {"lon40", "lat40", "lon4", "lat4", "lon1", "lat1", "ms_cold", "ms_warm", "n"} <= set(row)
    assert row["n"] == 3 and row["ms_cold"] > 0
    assert "oracle over the window mean" in capsys.readouterr().out
