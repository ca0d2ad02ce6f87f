"""Pretend aircraft of every type under every autopilot: they fly their missions, and say so in their own tongue."""

from collections import Counter
from math import degrees

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.cli import main
from fleet.commands.live.fly import AIRCRAFT, AUTOPILOTS
from fleet.contract import Mission, Params, Sample, Status
from fleet.frames import to_ned
from fleet.mission import KIND, WAYPOINT
from fleet.simulator.flight import drive
from fleet.simulator.flight.tuning import TUNINGS, tuned_parameters
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.jsbsim import Aircraft
from fleet.simulator.vehicle.missions import DO_JUMP, HOME, LOITER_TIME, draw_mission
from fleet.simulator.vehicle.types import TYPES
from fleet.telemetry.recording.recordings import replay_messages

KINDS = sorted(TUNINGS)


def heard(frames: list[bytes]) -> list:
    ear = mav.MAVLink(None)
    return [message for frame in frames for message in (ear.parse_buffer(frame) or [])]


def test_every_pair_is_tuned_and_can_be_asked_for() -> None:
    assert sorted((autopilot, aircraft) for autopilot in AUTOPILOTS for aircraft in AIRCRAFT) == KINDS
    assert set(AIRCRAFT) == set(TYPES)


class Silent:
    """In place of an endpoint, where the frames between two looks at an aircraft are read by nobody."""

    def telemetry(self, tick: int, state: object) -> list[bytes]:
        return []


@pytest.mark.parametrize(("autopilot", "aircraft"), KINDS)
def test_it_holds_height_speed_bank_and_line_for_ten_minutes(autopilot: str, aircraft: str) -> None:
    uav = SimulatedUav(1, seed=77, wind=5.0, turbulence=2, autopilot=autopilot, aircraft=aircraft)
    endpoint, uav._endpoint = uav._endpoint, Silent()
    rows, seqs, sent = [], [], []
    for k in range(1, 2_000):
        uav.step(k * 0.3)
        f, x = uav._telemetry_state(), uav.aircraft.truth()
        sent += endpoint.telemetry(k, lambda state=f: state)  # every message in its turn
        errors = (f.alt_error, f.Va_error, degrees(f.phi_c - x.euler[0]), degrees(f.theta_c - x.euler[1]))
        rows.append((*errors, f.xtrack_error if uav.leg[KIND] == WAYPOINT else np.nan))
        seqs.append(f.seq)
    alt, Va, phi, theta, _ = np.sqrt(np.mean(np.square(rows), axis=0))
    size = TYPES[aircraft].geometry
    assert not uav.crashed
    assert len({message.get_type() for message in heard(sent)}) >= 9
    assert np.count_nonzero(np.diff(seqs)) >= 8
    assert alt < 10 * size.height and np.quantile(np.abs(rows)[:, 0], 0.9) < 14 * size.height
    assert Va < 2 and phi < 10 and theta < 3
    assert np.median(np.abs(rows)[:, 2]) < 2.5
    assert np.nanmedian(np.abs(rows)[:, 4]) < 12 * size.scale  # corners are in it


def test_the_cessna_trims_and_differs_by_its_load() -> None:
    kind = TYPES["c172p"]
    planes = [Aircraft(HOME, seed, 0, kind) for seed in (1, 2)]
    assert planes[0].payload_kg != planes[1].payload_kg
    for plane in planes:
        theta, delta_e, delta_t = plane.start(np.array([0.0, 0.0, -250.0]), 1.0, kind.cruise, (3.0, 0.0))
        assert abs(degrees(theta)) < 5 and abs(delta_e) < 0.3 and 0.4 < delta_t < 0.9
        plane.set_controls(0.0, delta_e, 0.0, delta_t)
        for _ in range(300):
            plane.step()
        x = plane.truth()
        assert abs(x.Va - kind.cruise) < 2 and abs(x.p[2] + 250) < 4  # JSBSim starts engines at full speed


@pytest.mark.parametrize("seed", range(8))
def test_px4_missions_begin_at_zero_and_circle_by_the_clock(seed: int) -> None:
    field = TYPES["c172p"].geometry
    items, start = draw_mission(seed, 48.0, HOME, field, "px4")
    other, begun = draw_mission(seed, 48.0, HOME, field)
    assert [item.seq for item in items] == list(range(len(items))) and len(items) == len(other) - 1
    assert (items[-1].command, items[-1].param1) == (DO_JUMP, 0)
    assert start.seq == begun.seq - 1 and (items[start.seq].lat_e7, items[0].frame) == (other[begun.seq].lat_e7, 3)
    (circle,) = [item for item in items if item.command == LOITER_TIME]
    assert circle.param1 == pytest.approx(2 * np.pi * abs(circle.param3) / 48.0, abs=0.5) and circle.param2 == 1


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimulatedUav, list]:
    """Twenty seconds of a PX4 aircraft as a recording, read back."""
    path = tmp_path_factory.mktemp("px4") / "one.tlog"
    uav = SimulatedUav(0, 5, autopilot="px4")
    drive.to_tlog(path, [uav], seconds=20, loss=0.0, seed=5)
    return uav, list(replay_messages(path, -1))


def test_px4_speaks_as_px4() -> None:
    uav = SimulatedUav(4, 11, autopilot="px4")
    said = heard(uav.step(20.0))
    counts = Counter(m.get_type() for m in said)
    assert "NAV_CONTROLLER_OUTPUT" not in counts
    assert (counts["ATTITUDE_TARGET"], counts["HOME_POSITION"], counts["WIND_COV"]) == (200, 10, 20)
    (beat, *_) = [m for m in said if m.get_type() == "HEARTBEAT"]
    assert beat.autopilot == mav.MAV_AUTOPILOT_PX4 and mavutil.mode_string_v10(beat) == "MISSION"


def test_what_px4_says_is_read(recorded: tuple[SimulatedUav, list]) -> None:
    uav, news = recorded
    status = [m for m in news if isinstance(m, Status)][-1]
    assert (status.autopilot, status.mode, status.vehicle) == ("px4", "MISSION", "fixed_wing")
    assert status.rejected == 0
    params = [m for m in news if isinstance(m, Params)][-1].values
    assert params == {name: pytest.approx(value, rel=1e-6) for name, value in uav.params.items()}
    command = np.concatenate([m.command.x.numpy() for m in news if isinstance(m, Sample) and m.command])
    assert len(command) > 150 and np.isfinite(command[:, :2]).all() and np.isnan(command[:, 2:]).all()
    assert command[-1, :2] == pytest.approx([uav._phi_c, uav._theta_c], abs=0.15)
    winds = np.concatenate([m.wind.x.numpy() for m in news if isinstance(m, Sample) and m.wind])
    assert winds[-1] == pytest.approx(uav._wind_estimate, abs=0.5)


def test_altitudes_over_home_become_altitudes_over_the_sea_once_home_is_told(
    recorded: tuple[SimulatedUav, list],
) -> None:
    uav, news = recorded
    missions = [m for m in news if isinstance(m, Mission)]
    assert missions[0].items == uav.items or missions[-1].items != uav.items
    for item, own in zip(missions[-1].items, uav.items, strict=True):
        if own.lat_e7:
            assert item.frame == 0 and item.alt_m == pytest.approx(own.alt_m + HOME.alt_mm * 1e-3, abs=0.01)
    place = to_ned(HOME, *np.array([[i.lat_e7, i.lon_e7, i.alt_m * 1e3] for i in missions[-1].items[:1]]).T)[0]
    assert -place[2] == pytest.approx(uav.items[0].alt_m, abs=0.01)


def test_integers_of_px4_survive_their_disguise() -> None:
    params = tuned_parameters(3, "px4")
    assert params["PWM_MAIN_FUNC3"] == 101.0 and params["NPFG_PERIOD"] in (11.0, 12.0, 13.0, 14.0)
    assert tuned_parameters(3, "px4") == params != tuned_parameters(4, "px4")


def test_options_choose_autopilot_and_aircraft(tmp_path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "one.tlog"
    words = ["--uavs", "0", "--for", "2", "--autopilot", "px4", "--aircraft", "c172p", "--tlog", str(path)]
    assert main(["fly", *words]) == 0
    status = [m for m in replay_messages(path, -1) if isinstance(m, Status)][-1]
    assert status.autopilot == "px4"
    with pytest.raises(SystemExit):
        main(["fly", "--autopilot", "inav"])
    assert "--autopilot" in capsys.readouterr().err
