import lzma
import math

import numpy as np
import pytest
from talker import T0, Talker, assert_finite, of

from fleet.contract import COLUMNS, Mission, Params, Sample, Status
from fleet.telemetry.intake import Intake
from fleet.telemetry.recordings import records, replay_messages
from fleet.telemetry.restamp import backlog_offset, boot_s, restamped

S02 = "sitl/s02_nominal_light_wind.tlog.xz"


@pytest.fixture(scope="module")
def s02(recordings):
    intake = Intake()
    return list(replay_messages(recordings / S02, intake=intake)), intake


def test_a_recorded_flight_comes_out_whole(s02):
    news, intake = s02
    missions, params, status = of(Mission, news), of(Params, news), of(Status, news)
    assert {m.uav for m in news} == {3}
    assert missions[-1].complete
    assert len(missions[-1].items) == 17
    assert [m.seq for m in missions[2:]] == [1, 2, 3, 4, 5, 7, 8, 9, 11, 14, 15, 16]
    assert params[-1].complete
    assert len(params[-1].values) > 1000
    assert params[-1].values["AIRSPEED_CRUISE"] == 22.0
    modes = [(s.t - news[0].t, s.mode) for s in status]
    assert next(t for t, mode in modes if mode == "AUTO") == pytest.approx(35.1, abs=0.5)
    assert status[-1].vehicle == "fixed_wing"
    assert status[-1].clock_jumps == 0
    assert intake.counters()["bad_bytes"] == 0


def test_a_recorded_flight_is_finite_in_order_and_on_its_own_time(s02):
    news, _ = s02
    last = dict.fromkeys(COLUMNS, 0.0)
    for message in news:
        assert_finite(message)
        for field in COLUMNS if isinstance(message, Sample) else ():
            rows = getattr(message, field)
            if rows is not None:
                assert rows.t.numpy()[0] > last[field]
                last[field] = rows.t.numpy()[-1]
    samples = of(Sample, news)
    assert samples[0].t == pytest.approx(1763607200, abs=1)
    assert samples[-1].t - samples[0].t == pytest.approx(446, abs=1)
    airspeed = np.concatenate([s.air.x.numpy()[:, 0] for s in samples if s.air and s.t - samples[0].t > 60])
    error = np.concatenate([s.command.x.numpy()[:, 4] for s in samples if s.command and 60 < s.t - samples[0].t < 330])
    assert 15 < np.median(airspeed) < 30
    assert np.median(np.abs(error)) < 2.0  # m/s, were it not for the centimetres of ArduPilot


def test_three_aircraft_in_one_recording(recordings):
    seen: dict[int, set] = {}
    for message in replay_messages(recordings / "sitl/s10_multi3_nominal.tlog.xz", offset=-1):
        seen.setdefault(message.uav, set()).add(type(message))
        if len(seen) == 3 and all(len(kinds) == 4 for kinds in seen.values()):
            break
    assert seen == {uav: {Sample, Status, Mission, Params} for uav in (20, 21, 22)}


def log_of(frames, t0=T0, step=0.05):
    stamps = [round((t0 + i * step) * 1e6).to_bytes(8, "big") for i in range(len(frames))]
    return b"".join(stamp + frame for stamp, frame in zip(stamps, frames, strict=True))


def test_a_damaged_recording_keeps_what_is_good(tmp_path, caplog):
    talker = Talker()
    frames = [talker.attitude(i * 0.05) for i in range(400)]
    half = log_of(frames[:200])
    data = half + np.random.default_rng(5).bytes(3000) + log_of(frames[200:], T0 + 10) + b"\0\0\x06"
    path = tmp_path / "damaged.tlog"
    path.write_bytes(data)
    found = list(records(path))
    assert sum(frame in frames for _, frame in found) >= 396
    assert "damaged bytes skipped" in caplog.text


def test_a_cut_archive_keeps_what_came_before(tmp_path, caplog):
    talker = Talker()
    data = lzma.compress(log_of([talker.attitude(i * 0.05, phi=math.sin(i)) for i in range(20_000)]))
    path = tmp_path / "cut.tlog.xz"
    path.write_bytes(data[: len(data) // 2])
    assert len(list(records(path))) > 1000
    path.write_bytes(data[:-200] + bytes(100))
    assert len(list(records(path))) > 1000
    assert "damaged" in caplog.text


@pytest.mark.parametrize(
    ("name", "data"), [("a.tlog", b""), ("a.tlog", b"hello" * 99), ("a.csv", b""), ("a.tlog.xz", b"no")]
)
def test_what_is_no_recording_is_named(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=name):
        list(records(tmp_path / name))


def test_a_backlog_is_played_in_the_time_of_the_flight():
    talker = Talker()
    frames = [talker.attitude(100 + i * 0.1) for i in range(1000)]
    rushed = [(T0 + i * 0.01, frame) for i, frame in enumerate(frames)]
    offset = backlog_offset(rushed)
    assert offset is not None
    times = [t for t, _ in restamped(rushed, offset)]
    assert np.diff(times) == pytest.approx(0.1, abs=1e-6)
    assert times[-1] == pytest.approx(rushed[-1][0], abs=1e-3)
    assert backlog_offset([(T0 + i * 0.1, frame) for i, frame in enumerate(frames)]) is None
    assert boot_s(frames[5]) == 100.5
