"""Faults concealed in recordings: the motion stays, inputs and readings are those of a faulty aircraft."""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import exit_code

from fleet.airframes.airframe import servo_map
from fleet.blind_test.inject.faults import FAULTS, InjectedAircraft, InjectedFault, inject, possible_faults
from fleet.blind_test.inject.injector import (
    PAST_S,
    Source,
    area_per_mass,
    conceal,
    draw,
    draw_fault,
    read_sources,
    write_recordings,
)
from fleet.blind_test.inject.recorded import FlightRecording, common_servo_map, read_recorded, write_recorded
from fleet.blind_test.inject.thrust import ThrustCurve, airspeed, density, fit_thrust_curves
from fleet.bus.codec import encode, encoding
from fleet.cli import main as fleet
from fleet.contract import Array, Rows, Sample
from fleet.telemetry.recording.fleet_log import BusRecord
from fleet.telemetry.recording.options import NO_OPTIONS

T0_S = 1_700_000_000.0
ONSET_S = 60.0
CURVE = ThrustCurve(k_t=0.005, k_motor=50.0, c_0=0.012, r2=1.0)
SERVOS = servo_map({})


def record(path: Path, seconds: float = 120.0) -> Path:
    """Write a flight that obeys `CURVE`: throttle and climb vary, airspeed follows from the balance of energy."""
    dt = 0.1
    t = np.arange(0.0, seconds, dt)
    delta_t = 0.45 + 0.2 * np.sin(0.3 * t) + 0.1 * np.sin(0.11 * t)
    climb = 1.5 * np.sin(0.17 * t)
    h = 300.0 + np.cumsum(climb) * dt
    Va = np.full(len(t), 20.0)
    for k in range(1, len(t)):
        at = (delta_t[k - 1 : k], Va[k - 1 : k], density(h[k - 1 : k]))
        drag = 0.5 * at[2][0] * Va[k - 1] ** 2 * CURVE.c_0 + 0.04 * 2.0 * 9.81**2 / (at[2][0] * Va[k - 1] ** 2)
        Va[k] = Va[k - 1] + dt * (float(CURVE.thrust(*at)[0]) - drag - 9.81 * climb[k - 1] / Va[k - 1])
    zero = np.zeros(len(t))
    servo = np.full((len(t), 8), 1500.0)
    servo[:, 0] += 120.0 * np.sin(0.9 * t)
    servo[:, 1] += 80.0 * np.sin(0.7 * t) + 20.0
    servo[:, 2] = 1100.0 + 800.0 * delta_t
    servo[:, 3] += 60.0 * np.sin(0.5 * t)
    north = np.cumsum(Va) * dt / 111_000.0 * 1e7
    kinds = {
        "attitude": (np.column_stack([0.1 * np.sin(t), zero, zero, zero, zero, zero]), "<f4"),
        "velocity": (np.column_stack([np.sqrt(Va**2 - climb**2), zero, -climb]), "<f4"),
        "position": (np.column_stack([4e8 + north, zero, h * 1e3]), "<i4"),
        "air": (np.column_stack([Va, delta_t, climb]), "<f4"),
        "servo": (servo, "<f4"),
        "pressure": ((101325.0 * (1.0 - 2.25577e-5 * h) ** 5.2559)[:, None], "<f4"),
        "gnss": (h[:, None] * 1e3, "<i4"),
    }
    with path.open("wb") as file:
        for begin in range(0, len(t), 5):
            part = slice(begin, begin + 5)
            rows = {
                kind: Rows(
                    Array.of(T0_S + t[part], "<f8"), Array.of(np.rint(x[part]) if dtype == "<i4" else x[part], dtype)
                )
                for kind, (x, dtype) in kinds.items()
            }
            message = Sample(uav=1, t=T0_S + float(t[part][-1]), **rows)
            file.write(BusRecord(message.t, encoding(Sample), encode(message)).pack())
    return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> FlightRecording:
    return read_recorded(record(tmp_path_factory.mktemp("recorded") / "monday.parauav"), NO_OPTIONS)


@pytest.fixture(scope="module")
def aircraft(flight: FlightRecording) -> InjectedAircraft:
    return InjectedAircraft(common_servo_map([flight]), CURVE)


def surface(flight: FlightRecording, aircraft: InjectedAircraft, rows: np.ndarray, column: int) -> np.ndarray:
    return aircraft.used_map.inputs(rows[:, :8].astype(float))[:, column]


def after(flight: FlightRecording, kind: str = "servo") -> np.ndarray:
    return flight.t[kind] >= flight.t_start + ONSET_S


def test_a_copy_without_a_fault_is_the_recording(flight: FlightRecording, tmp_path: Path) -> None:
    write_recorded(flight, {}, tmp_path / "copy.parauav")
    copy = read_recorded(tmp_path / "copy.parauav", NO_OPTIONS)
    assert set(copy.x) == set(flight.x)
    for kind, x in flight.x.items():
        assert np.array_equal(copy.x[kind], x) and np.array_equal(copy.t[kind], flight.t[kind])


def test_a_flight_shows_its_thrust_curve(flight: FlightRecording) -> None:
    (curve,) = fit_thrust_curves([flight], SERVOS)
    assert curve.r2 > 0.95
    Va, rho = np.array([18.0, 20.0, 22.0]), np.full(3, 1.19)
    healthy = curve.thrust(np.full(3, 0.4), Va, rho)
    assert np.allclose(curve.throttle(healthy, Va, rho), 0.4)
    truth = CURVE.throttle(CURVE.thrust(np.full(3, 0.4), Va, rho) / 0.8, Va, rho)
    assert np.allclose(curve.throttle(healthy / 0.8, Va, rho), truth, atol=0.01)


def test_thrust_of_the_faulty_aircraft_is_the_recorded_thrust(
    flight: FlightRecording, aircraft: InjectedAircraft
) -> None:
    altered = inject(flight, aircraft, InjectedFault("thrust_loss", "", {"loss": 0.2}, ONSET_S))
    assert altered is not None
    t = flight.t["servo"]
    Va, rho = airspeed(flight, t), density(flight.at("position", t)[:, 2] * 1e-3)
    before, now = (
        CURVE.thrust(surface(flight, aircraft, x, 3), Va, rho) for x in (flight.x["servo"], altered["servo"])
    )
    on = after(flight)
    assert np.allclose(0.8 * now[on], before[on], atol=0.03) and np.array_equal(now[~on], before[~on])
    assert (altered["air"][after(flight, "air"), 1] > flight.x["air"][after(flight, "air"), 1]).all()


def test_more_drag_is_overcome_by_more_thrust(flight: FlightRecording, aircraft: InjectedAircraft) -> None:
    altered = inject(flight, aircraft, InjectedFault("drag_increase", "", {"dCD": 0.003}, ONSET_S))
    assert altered is not None
    t, on = flight.t["servo"], after(flight)
    Va, rho = airspeed(flight, t), density(flight.at("position", t)[:, 2] * 1e-3)
    before, now = (
        CURVE.thrust(surface(flight, aircraft, x, 3), Va, rho) for x in (flight.x["servo"], altered["servo"])
    )
    assert np.allclose((now - before)[on], (0.5 * rho * Va**2 * 0.003)[on], atol=0.03)


@pytest.mark.parametrize("part", ["aileron", "elevator", "rudder"])
@pytest.mark.parametrize("fault", ["actuator_offset", "control_effectiveness_loss", "actuator_delay"])
def test_a_faulty_surface_stands_where_the_recorded_one_stood(
    fault: str, part: str, flight: FlightRecording, aircraft: InjectedAircraft
) -> None:
    key, size = {"actuator_offset": ("offset", 0.1), "control_effectiveness_loss": ("loss", 0.4)}.get(
        fault, ("delay_s", 0.3)
    )
    altered = inject(flight, aircraft, InjectedFault(fault, part, {key: size}, ONSET_S))
    assert altered is not None
    column = ("aileron", "elevator", "rudder").index(part)
    recorded, command = (surface(flight, aircraft, x, column) for x in (flight.x["servo"], altered["servo"]))
    stands = {
        "actuator_offset": command + size,
        "control_effectiveness_loss": (1.0 - size) * command,
        "actuator_delay": np.interp(flight.t["servo"] - size, flight.t["servo"], command),
    }[fault]
    inside = flight.t["servo"] >= flight.t_start + ONSET_S + 1.0
    inside &= flight.t["servo"] < flight.t["servo"][-1] - 1.0
    assert np.allclose(stands[inside], recorded[inside], atol=0.004)  # whole microseconds
    assert np.abs(command - recorded)[inside].max() > 0.02
    others = [k for k in range(4) if k != column]
    for k in others:
        assert np.array_equal(
            surface(flight, aircraft, flight.x["servo"], k), surface(flight, aircraft, altered["servo"], k)
        )


@pytest.mark.parametrize("position", [0.0, 0.4])
def test_a_frozen_output_repeats_one_pulse(
    position: float, flight: FlightRecording, aircraft: InjectedAircraft
) -> None:
    altered = inject(flight, aircraft, InjectedFault("actuator_stuck", "rudder", {"position": position}, ONSET_S))
    assert altered is not None
    frozen = altered["servo"][after(flight), 3]
    assert np.ptp(frozen) == 0 and (position == 0.0 or frozen[0] == 1500.0 + 0.4 * 400.0)


@pytest.mark.parametrize(
    ("name", "part", "size", "kind", "column", "change"),
    [
        ("airspeed_bias", "", 2.0, "air", 0, 2.0),
        ("gyro_bias", "q", 2.0, "attitude", 4, np.radians(2.0)),
        ("heading_bias", "", 10.0, "attitude", 2, np.radians(10.0)),
    ],
)
def test_a_sensor_fault_changes_its_reading_from_the_onset_on(
    name: str,
    part: str,
    size: float,
    kind: str,
    column: int,
    change: float,
    flight: FlightRecording,
    aircraft: InjectedAircraft,
) -> None:
    altered = inject(flight, aircraft, InjectedFault(name, part, {FAULTS[name].key: size}, ONSET_S))
    assert altered is not None
    difference = altered[kind][:, column] - flight.x[kind][:, column]
    assert np.allclose(difference, np.where(after(flight, kind), change, 0.0), atol=1e-6)


def test_scale_pressure_and_latency(flight: FlightRecording, aircraft: InjectedAircraft) -> None:
    scaled = inject(flight, aircraft, InjectedFault("airspeed_scale", "", {"scale": 0.9}, ONSET_S))
    pressed = inject(flight, aircraft, InjectedFault("baro_bias", "", {"bias_m": 10.0}, ONSET_S))
    late = inject(flight, aircraft, InjectedFault("gps_latency", "", {"latency_s": 0.3}, ONSET_S))
    assert scaled and pressed and late
    on = after(flight, "air")
    assert np.allclose(scaled["air"][on, 0], 0.9 * flight.x["air"][on, 0])
    height = [
        (1.0 - (x[:, 0].astype(float) / 101325.0) ** (1 / 5.2559)) / 2.25577e-5
        for x in (flight.x["pressure"], pressed["pressure"])
    ]
    on = after(flight, "pressure")
    assert np.allclose((height[1] - height[0])[on], 10.0, atol=0.01)
    on = after(flight, "velocity")
    assert np.allclose(late["velocity"][on], flight.at("velocity", flight.t["velocity"][on] - 0.3), atol=1e-4)
    assert {"velocity", "position", "gnss"} <= set(late)


def test_a_motion_beyond_the_faulty_aircraft_is_refused(flight: FlightRecording, aircraft: InjectedAircraft) -> None:
    assert inject(flight, aircraft, InjectedFault("thrust_loss", "", {"loss": 0.6}, ONSET_S)) is None


def test_what_a_flight_cannot_show_is_not_concealed(flight: FlightRecording) -> None:
    blind = InjectedAircraft(SERVOS, ThrustCurve(CURVE.k_t, CURVE.k_motor, CURVE.c_0, r2=0.3))
    names = {name for name, _ in possible_faults(flight, blind)}
    assert not names & {"thrust_loss", "drag_increase", "accel_bias"}  # no accelerometer in it
    assert {"baro_bias", "actuator_stuck", "airspeed_scale"} <= names


# --- draws ------------------------------------------------------------------------------------------------------------


def sources(flight: FlightRecording, aircraft: InjectedAircraft, n: int = 3) -> list[Source]:
    return [Source(Path(f"/flights/{k}.tlog"), flight, aircraft) for k in range(n)]


def test_draws_are_balanced_seeded_and_every_flight_is_one_control(
    flight: FlightRecording, aircraft: InjectedAircraft
) -> None:
    of = sources(flight, aircraft)
    drawn = draw(of, 90, np.random.default_rng(3))
    assert drawn == draw(of, 90, np.random.default_rng(3)) != draw(of, 90, np.random.default_rng(4))
    controls = [k for k, name, _, _ in drawn if not name]
    assert sorted(controls) == [0, 1, 2]
    kinds = [(name, part) for _, name, part, _ in drawn if name]
    counts = [kinds.count(kind) for kind in of[0].possible]
    assert max(counts) - min(counts) <= 1
    repeated = max(of[0].possible, key=kinds.count)
    places = sorted(place for _, *kind, place in drawn if tuple(kind) == repeated)
    assert all(k / len(places) <= place <= (k + 1) / len(places) for k, place in enumerate(places))


def test_an_onset_leaves_a_healthy_past(flight: FlightRecording, aircraft: InjectedAircraft) -> None:
    (source,) = sources(flight, aircraft, 1)
    rng = np.random.default_rng(0)
    for name, part in source.possible:
        fault = draw_fault(source, name, part, rng.random(), rng)
        assert source.flight.airborne[0] + PAST_S < source.until < fault.t0 < source.end


def test_a_size_beyond_the_outputs_is_reduced(
    flight: FlightRecording, aircraft: InjectedAircraft, tmp_path: Path
) -> None:
    (source,) = sources(flight, aircraft, 1)
    wanted = InjectedFault("thrust_loss", "", {"loss": 0.6}, ONSET_S)
    written = conceal(source, wanted, tmp_path / "rec.parauav")
    assert written is not None and 0.1 < written.values["loss"] < 0.6 and (tmp_path / "rec.parauav").exists()


def test_files_do_not_betray_their_labels(flight: FlightRecording, aircraft: InjectedAircraft, tmp_path: Path) -> None:
    labels = write_recordings(sources(flight, aircraft, 1), argparse.Namespace(seed=5, flights=20, out=tmp_path))
    files = sorted(tmp_path.glob("*/rec_*"))
    assert {path.stem for path in files} == set(labels) and {label["role"] for label in labels.values()} == {
        "control",
        "single",
    }
    assert len({path.stat().st_size for path in files}) == 1


def test_a_short_flight_is_refused_with_the_least_length(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"brief: found 39 s in the air, expected 65 s.*name a longer flight"):
        read_sources([record(tmp_path / "brief.parauav", 40.0)], NO_OPTIONS, 1.0)


def test_area_per_mass_comes_from_card_or_model(tmp_path: Path) -> None:
    card, model = tmp_path / "card.json", tmp_path / "model.json"
    card.write_text(json.dumps({"S": 0.5, "m": 2.0}))
    model.write_text(json.dumps({"card": {"body": {"S": 0.6, "mass": 2.0}}}))
    assert area_per_mass(card, None) == 0.25 and area_per_mass(None, model) == 0.3 and area_per_mass(None, None) == 1.0
    card.write_text("{}")
    with pytest.raises(ValueError, match=r"card\.json: found .*correct it"):
        area_per_mass(card, None)


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--model", "m.json"], "--model: found it without --inject"),
        (["--inject", "a.tlog", "--smallest", "0.5"], "--smallest: found it with --inject"),
        (["--inject", "a.tlog", "b/a.tlog"], "found two flights of one name"),
        (["--inject", "a.tlog", "--against", "a.tlog", "b.tlog"], "--against: found 1 flights besides"),
        (["--inject", "nowhere.tlog"], "found no file 'nowhere.tlog'"),
        (["--inject", "a.tlog", "--model", "m.json", "--airframe", "c.json"], "expected one of --model and --against"),
        (["--smallest", "2"], "--smallest: found 2"),
    ],
)
def test_wrong_options_are_refused(
    options: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b").mkdir()
    for name in ("a.tlog", "b.tlog", "b/a.tlog", "m.json", "c.json"):
        (tmp_path / name).touch()
    assert exit_code(lambda: fleet(["prove", *options])) == 2
    assert words in capfd.readouterr().err.splitlines()[-1]


def test_faults_in_real_flights_are_graded_after_the_reports(recordings: Path, tmp_path: Path) -> None:
    flights = [
        recordings / "real" / f"alfa_{name}_no_failure.tlog.xz" for name in ("10-05-15-52-12_1", "10-05-15-52-12_2")
    ]
    out = tmp_path / "proof.json"
    options = ["--flights", "6", "--seed", "3", "--jobs", "1", "--json", out, "--report", tmp_path / "proof"]
    done = subprocess.run(
        [sys.executable, "-m", "fleet.cli", "prove", "--inject", *flights, *options], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "left out: alfa_10-05-15-52-12_2_no_failure: found 47 s in the air" in done.stderr
    result = json.loads(out.read_text())
    assert result["injected"]["reference"] == "own past" and len(result["marks"]) == 6
    promised = [k for k, line in enumerate(done.stderr.splitlines()) if "sha256" in line or "decrypted" in line]
    assert len(promised) == 3 and promised == sorted(promised)
    assert result["counts"]["top1_naming"][1] == 5 and result["intervals"]["top1_naming"] is not None
