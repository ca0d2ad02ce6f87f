import lzma
import math
from itertools import groupby

import numpy as np
import pytest

from fleet.contract import COLUMNS, Mission, Params, Sample, Status
from fleet.telemetry.mavlink.parsing.decode import Decoder
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.recording.opening import RecordingFile
from fleet.telemetry.recording.recordings import Recording, replay_messages
from fleet.telemetry.recording.tlog import StampCorrector, Tlog, backlog_offset, boot_times, restamped
from tests.support.talker import T0, Talker, assert_finite, of

S02 = "sitl/s02_nominal_light_wind.tlog.xz"


@pytest.fixture(scope="module")
def s02(recordings):
    skipped: list[str] = []
    return list(replay_messages(recordings / S02, skipped=skipped)), skipped


def test_a_recorded_flight_comes_out_whole(s02):
    news, skipped = s02
    missions, params, status = of(Mission, news), of(Params, news), of(Status, news)
    assert {m.uav for m in news} == {3}
    assert missions[-1].complete
    assert len(missions[-1].items) == 17
    items = [seq for seq, _ in groupby(m.seq for m in missions)]  # home moves too: one item may be published twice
    assert items == [0, 1, 2, 3, 4, 5, 7, 8, 9, 11, 14, 15, 16]
    assert params[-1].complete
    assert len(params[-1].values) > 1000
    assert params[-1].values["AIRSPEED_CRUISE"] == 22.0
    modes = [(s.t - news[0].t, s.mode) for s in status]
    assert next(t for t, mode in modes if mode == "AUTO") == pytest.approx(35.1, abs=0.5)
    assert status[-1].vehicle == "fixed_wing"
    assert status[-1].clock_jumps == 0
    assert skipped == []


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


def read(path) -> tuple[list[bytes], list[float], list[str]]:
    """Frames and times of a .tlog, and what was skipped."""
    tlog, frames, times = Tlog(RecordingFile(path)), [], []
    for batch in tlog.batches():
        frames += [batch.buf[start:stop].tobytes() for start, stop in batch.headers[:, :2]]
        times += batch.arrival.tolist()
    return frames, times, tlog.skipped


def test_a_damaged_recording_keeps_what_is_good(tmp_path):
    talker = Talker()
    frames = [talker.attitude(i * 0.05) for i in range(400)]
    half = log_of(frames[:200])
    data = half + np.random.default_rng(5).bytes(3000) + log_of(frames[200:], T0 + 10) + b"\0\0\x06"
    path = tmp_path / "damaged.tlog"
    path.write_bytes(data)
    found, times, skipped = read(path)
    assert found == frames
    assert np.diff(times) == pytest.approx(0.05, abs=1e-5)
    assert skipped == ["3003 damaged bytes skipped, the first near byte 0, 400 frames read"]


def test_a_cut_archive_keeps_what_came_before(tmp_path):
    talker = Talker()
    whole = log_of([talker.heartbeat()] + [talker.attitude(i * 0.05, phi=math.sin(i)) for i in range(20_000)])
    data = lzma.compress(whole)
    path = tmp_path / "cut.tlog.xz"
    for damaged in (data[: len(data) // 2], data[:-200] + bytes(100)):
        path.write_bytes(damaged)
        skipped: list[str] = []
        rows = sum(len(s.attitude.t.numpy()) for s in of(Sample, replay_messages(path, skipped=skipped)))
        assert rows > 1000
        assert any("the compressed file is damaged" in sentence for sentence in skipped)


@pytest.mark.parametrize(
    ("name", "data"), [("a.tlog", b""), ("a.tlog", b"hello" * 99), ("a.csv", b"1,2"), ("a.tlog.xz", b"no")]
)
def test_what_is_no_recording_is_named(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=name):
        list(replay_messages(tmp_path / name))


def test_what_is_no_file_is_named(tmp_path):
    (tmp_path / "endless.tlog").symlink_to("/dev/zero")
    (tmp_path / "folder.tlog").mkdir()
    for name in ("none.tlog", "endless.tlog", "folder.tlog"):
        with pytest.raises(OSError, match=name):
            list(replay_messages(tmp_path / name))


def test_a_wrong_suffix_is_seen_through(tmp_path):
    talker = Talker()
    path = tmp_path / "flight.ulg"
    path.write_bytes(log_of([talker.heartbeat()] + [talker.attitude(i * 0.05) for i in range(100)]))
    recording = Recording(path)
    assert recording.kind == "telemetry log"
    assert of(Sample, [news for _, step in recording.steps() for news in step])
    assert "flight.ulg: is a telemetry log by its content" in recording.skipped[0]


def heard(frames, times):
    """Frames of one sender, each with its time of arrival."""
    return Decoder().decode(
        ReceivedBytes.from_pieces([(t, None, frame) for t, frame in zip(times, frames, strict=True)])
    )


def test_a_backlog_is_played_in_the_time_of_the_flight():
    talker = Talker()
    frames = [talker.attitude(100 + i * 0.1) for i in range(1000)]
    rushed = heard(frames, [T0 + i * 0.01 for i in range(1000)])
    offset = backlog_offset(iter([rushed]))
    assert offset is not None
    (played,) = restamped(iter([rushed]), offset)
    assert np.diff(played.arrival) == pytest.approx(0.1, abs=1e-6)
    assert played.arrival[-1] == pytest.approx(rushed.arrival[-1], abs=1e-3)
    assert backlog_offset(iter([heard(frames, [T0 + i * 0.1 for i in range(1000)])])) is None
    assert boot_times(rushed)[5] == 100.5


def test_the_recorders_clock_is_straightened():
    t = T0 + np.arange(100.0)
    for wrong in (t + 0.0, np.where(t == T0 + 50, t + 3600, t), np.where(t == T0 + 50, t - 3600, t)):
        straight = np.concatenate(
            [line.correct(part) for line in [StampCorrector()] for part in np.split(wrong, [30, 70])]
        )
        assert np.abs(straight - t).max() <= 1.0  # a wrong stamp takes its neighbour's time
        assert (np.diff(straight) >= 0).all()
    set_back = np.where(t >= T0 + 50, t - 7200, t)
    straight = StampCorrector().correct(set_back)
    assert np.diff(straight).min() >= 0
    assert straight[-1] == pytest.approx(t[-1], abs=1.5)
