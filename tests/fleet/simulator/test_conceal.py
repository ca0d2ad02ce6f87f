"""The concealer: every effect acts, names and order say nothing, the same seed makes the same bytes."""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fleet.contract import Mission, Params, Sample
from fleet.effects import Body, catalogue
from fleet.simulator.conceal import acts as acting
from fleet.simulator.conceal import exam as examination
from fleet.simulator.conceal import paths as planning
from fleet.simulator.conceal import record as recording
from fleet.simulator.conceal.effects import BOTH, HIDDEN, UNKNOWN, reported_values, scaled_values
from fleet.simulator.conceal.exam import are_separable, counts, draw_jobs, simulate_exam
from fleet.simulator.conceal.paths import FlightJob, PlannedFlight, draw_flight
from fleet.simulator.conceal.record import fly, rejection_reason
from fleet.telemetry.recording.recordings import replay_messages

KINDS = HIDDEN | UNKNOWN
SHORT_S = 7.0


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short flights, in which everything comes at once."""
    for module in (planning, recording):
        monkeypatch.setattr(module, "SETTLE_S", 4.0)
    monkeypatch.setattr(planning, "_ONSET_S", (2.0, 2.0))
    monkeypatch.setattr(planning, "_TRANSIENT_START_S", (1.0, 1.0))


def short(name: str, airframe: str, attempt: int = 0) -> PlannedFlight:
    number = list(KINDS).index(name) if name else 99
    planned = draw_flight(FlightJob("x", airframe, "single", (name,) if name else (), number), 5, attempt)
    return planned._replace(seconds=SHORT_S)


@pytest.mark.parametrize("name", KINDS)
def test_every_effect_acts(name: str, soon: None) -> None:
    airframe = KINDS[name].airframes[-1]
    for attempt in range(8):  # one that acts too little is drawn again
        planned = short(name, airframe, attempt)
        (fault,) = planned.hidden_faults
        log, _ = fly(planned, planned.hidden_faults)
        found = acting.effect_strength(planned, fault, log)
        if found["over_noise"] > acting.MIN_OVER_NOISE:  # type: ignore[operator]
            break
    else:
        pytest.fail(f"{name} acts {found}")


def test_smaller_effects_are_of_the_same_kind() -> None:
    job = FlightJob("x", "small", "single", ("airspeed_scale",), 3)
    usual, small = draw_flight(job, 5, 0), draw_flight(job._replace(smallest=0.1), 5, 0)
    (one,), (other,) = usual.hidden_faults, small.hidden_faults
    share = (other.values["scale"] - 1.0) / (one.values["scale"] - 1.0)
    assert 0.1 <= share < 1.0 and (one.part, one.t0) == (other.part, other.t0)
    assert draw_flight(job._replace(smallest=0.1), 5, 0) == small
    assert scaled_values("wind_steady", {"speed_mps": 4.0, "from_deg": 90.0}, 0.5) == {
        "speed_mps": 2.0,
        "from_deg": 90.0,
    }
    assert scaled_values("actuator_rate_limit", {"rate_per_s": 0.2}, 0.5) == {"rate_per_s": 0.4}  # less of a fault
    assert scaled_values("_gyro_scale", {"scale": 0.2}, 0.5) == {"scale": 0.2}


def test_a_label_uses_the_names_of_a_report() -> None:
    effects = catalogue("")
    for name, hidden in HIDDEN.items():
        for airframe in hidden.airframes:
            values = hidden.draw(np.random.default_rng(1), airframe == "small")
            effect = effects[name]
            told = effect.reported(effect, np.array(effect.examples[0]), Body())
            assert set(reported_values(name, airframe, values)) <= set(told), name


def test_an_effect_of_size_nothing_does_not_act(soon: None) -> None:
    planned = short("drag_increase", "small")
    (fault,) = planned.hidden_faults
    nothing = fault._replace(values={"dCD": 0.0})
    planned = planned._replace(hidden_faults=(nothing,))
    found = acting.effect_strength(planned, nothing, fly(planned, planned.hidden_faults)[0])
    assert found["over_noise"] < acting.MIN_OVER_NOISE / 2 and found["flown_over_noise"] == 0.0  # type: ignore[operator]


@pytest.mark.parametrize("airframe", BOTH)
def test_one_seed_one_recording(airframe: str, soon: None, tmp_path: Path) -> None:
    one, two, other = (tmp_path / name for name in ("one", "two", "other"))
    fly(short("", airframe), (), one)
    fly(short("", airframe), (), two)
    fly(short("", airframe, attempt=1), (), other)
    assert one.read_bytes() == two.read_bytes() != other.read_bytes()


def test_flights_share_the_aircraft_and_nothing_else() -> None:
    first, second = (draw_flight(FlightJob("x", "small", "control", (), k), 5, 0).build_uav(()) for k in (1, 2))
    own = ["vary/C_m_alpha", "vary/thrust", "inertia/weight-lbs"]
    assert [first.aircraft[x] for x in own] == [second.aircraft[x] for x in own]
    assert first.params == second.params
    assert first._sensors.airspeed_scale == second._sensors.airspeed_scale
    assert first.items != second.items and first.boot_s != second.boot_s


def test_roles_have_their_shares() -> None:
    assert counts(140) == {"control": 60, "single": 50, "compound": 16, "unknown": 14}
    assert counts(12) == {"control": 4, "single": 5, "compound": 2, "unknown": 1}
    assert all(min(counts(n).values()) >= 1 and sum(counts(n).values()) == n for n in range(6, 60))
    with pytest.raises(ValueError, match="expected 6 at least"):
        counts(5)


def test_names_and_order_say_nothing() -> None:
    """Over many examinations each place in the order of names holds each role as often as any other place."""
    places: dict[str, list[float]] = {}
    for seed in range(60):
        jobs = [job for job in draw_jobs(seed, 24) if job.role != "nominal"]
        assert [job.name for job in jobs] == sorted({job.name for job in jobs})
        for place, job in enumerate(jobs):
            places.setdefault(job.role, []).append(place / (len(jobs) - 1))
            places.setdefault(job.airframe, []).append(place / (len(jobs) - 1))
    for x in places.values():
        assert np.mean(x) == pytest.approx(0.5, abs=3.5 * 0.3 / np.sqrt(len(x)))


def test_a_large_examination_asks_everything() -> None:
    jobs = draw_jobs(3, 140)
    assert len({job.name for job in jobs}) == len(jobs) == 150
    assert {name for job in jobs if job.role == "single" for name in job.effects} > set(HIDDEN) - {"nothing"} - lone(
        jobs
    )
    assert len({job.effects for job in jobs if job.role == "unknown"}) >= 6
    assert all(are_separable(*job.effects) for job in jobs if job.role == "compound")
    assert all(job.airframe in KINDS[name].airframes for job in jobs for name in job.effects)
    halves = Counter(job.airframe for job in jobs)
    assert abs(halves["small"] - halves["c172p"]) <= 2
    assert all(not draw_flight(job, 3, 0).hidden_faults for job in jobs if job.role in ("control", "nominal"))


def lone(jobs: list[FlightJob]) -> set[str]:
    """Effects of one airframe only: there may be more of them than single flights."""
    return {name for name, hidden in HIDDEN.items() if len(hidden.airframes) == 1}


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("wind_steady", "airspeed_bias"),
        ("drag_increase", "thrust_loss"),
        ("actuator_lag", "prop_torque"),
        ("turbulence", "baro_bias"),
        ("mass_change", "accel_bias"),
    ],
)
def test_effects_that_hide_each_other_do_not_go_together(a: str, b: str) -> None:
    assert not are_separable(a, b)
    assert are_separable("wind_steady", "actuator_offset")


def test_a_dive_is_not_sane(soon: None) -> None:
    planned = short("", "small")
    log, _ = fly(planned, ())
    assert rejection_reason(planned, log) == ""
    assert rejection_reason(planned, log._replace(height=log.height - 100)) == "too low"
    assert rejection_reason(planned, log._replace(alpha=log.alpha + 0.2)) == "stalled"
    assert rejection_reason(planned, log._replace(t=log.t[:40])) == "too short"


# --- a whole one -----------------------------------------------------------------------------------------------------


@dataclass
class Held:
    labels: dict
    folder: Path
    said: list[str]


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Held:
    """An examination of six, flown short."""
    folder = tmp_path_factory.mktemp("exam")
    said: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("NOMINAL_S", 30.0), ("EXAMINED_S", 45.0), ("_ONSET_S", (12.0, 20.0))):
            patch.setattr(planning, name, value)
        patch.setattr(planning, "_TRANSIENT_START_S", (5.0, 12.0))
        patch.setattr(examination, "NOMINAL_EXCITATION", (1.0,))
        labels = simulate_exam(4, 6, folder, lambda name, done, of: said.append(f"{name} {done}/{of}"), processes=1)
    return Held(labels, folder, said)


def test_an_examination_is_complete(held: Held) -> None:
    roles = Counter(label["role"] for label in held.labels.values())
    assert roles == {"nominal": 2, "control": 1, "single": 3, "compound": 1, "unknown": 1}
    files = {path.stem for path in held.folder.rglob("*.tlog")}
    assert files == set(held.labels)
    assert all((held.folder / x["airframe"] / f"{name}.tlog").is_file() for name, x in held.labels.items())
    assert held.said[-1].endswith("8/8")
    assert json.loads(json.dumps(held.labels)) == held.labels


def test_labels_say_what_when_and_how_strongly(held: Held) -> None:
    for label in held.labels.values():
        hides = label["role"] in ("single", "compound", "unknown")
        assert bool(label["effects"]) == bool(label["acts"]) == hides
        assert all(0 < x.get("t0", 15.0) < label["flown_s"] for x in label["effects"])
        assert all(x["over_noise"] >= acting.MIN_OVER_NOISE for x in label["acts"])


def test_recordings_hold_all_telemetry(held: Held) -> None:
    name, label = next((n, x) for n, x in held.labels.items() if x["role"] == "control")
    messages = list(replay_messages(held.folder / label["airframe"] / f"{name}.tlog"))
    assert any(isinstance(m, Mission) and len(m.items) > 10 for m in messages)
    params = {key: value for m in messages if isinstance(m, Params) for key, value in m.values.items()}
    assert params["SERVO1_FUNCTION"] == 4
    samples = [m for m in messages if isinstance(m, Sample)]
    for kind, hertz in (("attitude", 25), ("imu", 25), ("servo", 25), ("velocity", 10), ("pressure", 10), ("gnss", 5)):
        found = sum(rows.t.shape[0] for m in samples if (rows := getattr(m, kind)) is not None)
        assert 0.85 * hertz < found / label["flown_s"] < 2.05 * hertz, kind


@pytest.mark.parametrize("airframe", BOTH)
def test_the_card_is_what_an_operator_knows(airframe: str, held: Held) -> None:
    card = json.loads((held.folder / airframe / f"{airframe}.card.json").read_text())
    mass, span = {"small": (11.0, 2.8956), "c172p": (898.0, 10.91)}[airframe]
    assert card["m"] == pytest.approx(mass, rel=0.002) and card["b"] == pytest.approx(span, rel=1e-3)
    assert card["Ixz"] == pytest.approx({"small": 0.1204, "c172p": 24.95}[airframe], rel=0.02)
    assert set(card["surface_full_deg"]) == {"aileron", "elevator", "rudder"}


def test_wrong_use_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="found 3, expected 6 at least"):
        examination.simulate_exam(1, 3, tmp_path)
