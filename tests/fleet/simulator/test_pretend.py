"""The pretend aircraft: it trims, is blown about and flies its mission."""

from math import degrees, hypot

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.cli import main
from fleet.contract import Item
from fleet.frames import to_geodetic, to_ned
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.jsbsim import DT, Aircraft
from fleet.simulator.vehicle.missions import DO_CHANGE_SPEED, DO_JUMP, HOME, LOITER_TURNS, WAYPOINT, draw_mission
from fleet.simulator.vehicle.sensors import Sensors
from fleet.simulator.vehicle.types import CRUISE
from fleet.simulator.vehicle.weather import GaussMarkov, MeanWind, turbulence_level

ALOFT = np.array([100.0, -200.0, -120.0])


def trimmed(seed: int = 3, wind: tuple[float, float] = (0.0, 0.0), turbulence: int = 0) -> tuple[Aircraft, float]:
    aircraft = Aircraft(HOME, seed, turbulence)
    _, delta_e, delta_t = aircraft.start(ALOFT, 1.0, CRUISE, wind)
    aircraft.set_controls(0.0, delta_e, 0.0, delta_t)
    return aircraft, delta_t


def glide(aircraft: Aircraft, seconds: float) -> None:
    for _ in range(round(seconds / DT)):
        aircraft.step()


def heard(frames: list[bytes]) -> list:
    ear = mav.MAVLink(None)
    return [message for frame in frames for message in (ear.parse_buffer(frame) or [])]


@pytest.fixture(scope="module")
def flown() -> tuple[SimulatedUav, list]:
    """Forty seconds of one aircraft, and everything it said."""
    uav = SimulatedUav(4, seed=11, wind=3.0, turbulence=2)
    frames = [frame for k in range(4_000) for frame in uav.step((k + 1) * DT)]
    return uav, heard(frames)


@pytest.mark.parametrize("seed", range(4))
def test_trim_holds_level_flight(seed: int) -> None:
    aircraft, delta_t = trimmed(seed)
    assert 0.2 < delta_t < 0.7
    glide(aircraft, 2.0)
    x = aircraft.truth()
    assert abs(x.p[2] - ALOFT[2]) < 0.5
    assert abs(x.Va - CRUISE) < 0.3
    assert abs(degrees(x.euler[0])) < 10  # hand-built askew, stick fixed: rolls slowly
    assert abs(degrees(x.alpha) - 4) < 4


def test_start_is_where_it_was_put() -> None:
    x = trimmed(wind=(3.0, -2.0))[0].truth()
    assert np.abs(x.p - ALOFT).max() < 0.05
    assert x.euler[2] == pytest.approx(1.0, abs=1e-6)
    assert x.Va == pytest.approx(CRUISE, abs=1e-3)
    assert x.v[:2] == pytest.approx([CRUISE * np.cos(1.0) + 3.0, CRUISE * np.sin(1.0) - 2.0], abs=1e-3)
    assert x.force[2] == pytest.approx(-9.8, abs=0.1)  # specific force of level flight, FRD


def test_wind_carries_the_aircraft() -> None:
    still, blown = trimmed()[0], trimmed(wind=(5.0, 0.0))[0]
    glide(still, 2.0)
    glide(blown, 2.0)
    carried = blown.truth().p - still.truth().p
    assert carried[0] == pytest.approx(10.0, abs=0.5)
    assert abs(carried[1]) < 0.5


def test_turbulence_shakes_more_the_stronger_it_is() -> None:
    def shake(level: int) -> float:
        aircraft = trimmed(turbulence=level)[0]
        felt = []
        for _ in range(300):
            aircraft.step()
            felt.append(aircraft.truth().force[2])
        return float(np.std(felt))

    assert shake(0) < 0.1 < shake(2) < shake(6)


@pytest.mark.parametrize(("surface", "rate", "sign"), [(0, 0, 1), (1, 1, 1), (2, 2, 1)])
def test_positive_commands_roll_right_pitch_up_yaw_right(surface: int, rate: int, sign: int) -> None:
    aircraft = Aircraft(HOME, 3)
    _, delta_e, delta_t = aircraft.start(ALOFT, 1.0, CRUISE, (0.0, 0.0))
    deltas = [0.0, delta_e, 0.0, delta_t]
    deltas[surface] += 0.2
    aircraft.set_controls(*deltas)
    glide(aircraft, 0.4)
    assert sign * degrees(aircraft.truth().rates[rate]) > 3


def test_servos_lag() -> None:
    aircraft, delta_t = trimmed()
    aircraft.set_controls(1.0, 0.0, 0.0, delta_t)
    aircraft.step()
    early = aircraft["fcs/aileron-rad"]
    glide(aircraft, 0.5)
    assert 0 < early < 0.5 * aircraft["fcs/aileron-rad"]
    assert aircraft["fcs/aileron-rad"] == pytest.approx(np.radians(25), rel=0.01)


def test_aircraft_of_two_seeds_differ() -> None:
    one, two = trimmed(1)[0], trimmed(2)[0]
    assert one.payload_kg != two.payload_kg
    assert one["vary/C_m_alpha"] != two["vary/C_m_alpha"]


@pytest.mark.parametrize("seed", range(20))
def test_missions_have_everything_and_stay_near(seed: int) -> None:
    items, start = draw_mission(seed, CRUISE)
    commands = [item.command for item in items]
    assert [item.seq for item in items] == list(range(len(items)))
    assert {WAYPOINT, LOITER_TURNS, DO_CHANGE_SPEED} <= set(commands[1:])
    assert (items[0].lat_e7, items[0].lon_e7, items[-1].command) == (HOME.lat_e7, HOME.lon_e7, DO_JUMP)
    placed = [item for item in items[1:] if item.command in (WAYPOINT, LOITER_TURNS)]
    ned = to_ned(HOME, *np.array([[i.lat_e7, i.lon_e7, HOME.alt_mm] for i in placed]).T)
    assert np.hypot(ned[:, 0], ned[:, 1]).max() < 2_000
    assert all(80 <= item.alt_m <= 200 for item in placed)
    assert hypot(*start.p[:2]) < 2_000
    assert items[start.seq].command == WAYPOINT


def test_it_flies_its_mission_and_turns_at_once(flown: tuple[SimulatedUav, list]) -> None:
    uav, said = flown
    rolls = [abs(degrees(m.roll)) for m in said if m.get_type() == "ATTITUDE"]
    assert max(rolls[: 15 * 25]) > 20
    assert max(rolls) < 65
    assert not uav.crashed
    assert len({m.seq for m in said if m.get_type() == "MISSION_CURRENT"}) > 1


@pytest.mark.parametrize("uav_id", range(3))
def test_the_autopilot_holds_height_speed_and_bank(uav_id: int) -> None:
    uav = SimulatedUav(uav_id, seed=21, wind=4.0, turbulence=2)
    rows = []
    for k in range(1, 900):
        uav.step(k * 0.1)
        f, x = uav._telemetry_state(), uav.aircraft.truth()
        rows.append((f.alt_error, f.Va_error, degrees(f.phi_c - x.euler[0]), degrees(f.theta_c - x.euler[1])))
    alt, Va, phi, theta = np.sqrt(np.mean(np.square(rows), axis=0))
    assert not uav.crashed
    assert alt < 12
    assert Va < 2.5
    assert phi < 8  # most of it in the second after a turn begins
    assert np.median(np.abs(np.array(rows)[:, 2])) < 2.5
    assert theta < 4


def test_one_seed_one_flight_two_seeds_two() -> None:
    def bytes_of(uav_id: int, seed: int) -> bytes:
        return b"".join(SimulatedUav(uav_id, seed).step(3.0))

    assert bytes_of(0, 5) == bytes_of(0, 5)
    assert bytes_of(0, 5) != bytes_of(0, 6)
    assert bytes_of(0, 5)[50:] != bytes_of(1, 5)[50:]


def test_aircraft_of_one_fleet_share_the_mean_wind() -> None:
    drawn = [SimulatedUav(i, 5, wind=6.0, turbulence=0)._wind.step(np.array([0.0, 0.0, -100.0])) for i in range(3)]
    assert np.std(drawn, axis=0).max() < 2.0
    assert np.mean(np.hypot(*np.transpose(drawn))) == pytest.approx(6.0, abs=2.0)


def test_gauss_markov_has_its_deviation_and_memory() -> None:
    process = GaussMarkov(np.random.default_rng(2), np.full(500, 2.0), np.full(500, 1.0), 0.1)
    first = process.x
    for _ in range(10):
        last = process.step()
    assert np.std(last) == pytest.approx(2.0, rel=0.1)
    assert np.corrcoef(first, last)[0, 1] == pytest.approx(np.exp(-1), abs=0.12)


def test_wind_grows_with_height_and_can_be_calm() -> None:
    wind = MeanWind(8.0, np.random.default_rng(3), 0.1, towards=0.0)
    high, low = (wind.step(np.array([0.0, 0.0, -height]))[0] for height in (300.0, 20.0))
    assert high > low > 2
    assert MeanWind(0.0, np.random.default_rng(3), 0.1).step(np.array([0.0, 0.0, -100.0])) == (0.0, 0.0)


def test_sensor_errors_are_small_but_there() -> None:
    truth = trimmed()[0].truth()
    seen = [Sensors(np.random.default_rng(seed), 0.02).measure(truth) for seed in range(200)]
    assert np.std([e.p - truth.p for e in seen]) == pytest.approx(0.5, rel=0.15)
    assert np.std([e.euler - truth.euler for e in seen]) == pytest.approx(np.radians(0.25), rel=0.15)
    assert np.std([e.Va for e in seen]) == pytest.approx(hypot(0.02 * CRUISE, 0.25), rel=0.2)


def test_an_endless_mission_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fleet.simulator.flight.uav._LEGS_AHEAD", 4)
    uav = SimulatedUav(2, seed=9, wind=2.0, turbulence=0)
    seen = []
    for k in range(1, 90):
        uav.step(float(k) * 2)
        seen.append(uav._telemetry_state().seq)
    order = [a for a, b in zip(seen, [None, *seen], strict=False) if a != b]
    assert len(order) > 5
    assert not uav.crashed


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--uavs", "249-250"], "fly fewer aircraft"),
        (["--loss", "1.5"], "write e.g. 0.02"),
        (["--turbulence", "wild"], "choose one"),
        (["--to", "nowhere"], "--to"),
        (["--wind", "40"], "--wind"),
        (["--for", "-1"], "--for"),
    ],
)
def test_bad_options_stop_with_a_sentence(words: list[str], said: str, capsys: pytest.CaptureFixture) -> None:
    assert main(["fly", "--for", "1", *words]) == 2
    assert said in capsys.readouterr().err


def test_turbulence_words() -> None:
    assert [turbulence_level(word) for word in ("none", "light", "moderate", "severe", "7")] == [0, 3, 4, 6, 7]


def test_items_carry_their_places() -> None:
    items, start = draw_mission(3, CRUISE)
    assert isinstance(items[1], Item)
    lat, lon, _ = to_geodetic(HOME, start.p)
    assert abs(lat - HOME.lat_e7) < 200_000
    assert abs(lon - HOME.lon_e7) < 300_000
