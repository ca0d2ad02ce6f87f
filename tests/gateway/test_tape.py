"""What the links heard, on disk: frame for frame, within its budget, and every byte accounted for."""

import errno
import io
import resource
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil

from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.recording.recordings import replay_messages
from gateway.links.link import Batch
from gateway.record import recorder as module
from gateway.record.recorder import LinkRecorder, RecordedQueue
from gateway.record.tape import MAX_FILE_S, RETRY_S, DiskBudget, TlogWriter, format_size, read_size
from tests.support.talker import T0, Talker

MORE = 10**9


def frames(n=200, system=7):
    talker = Talker(system)
    return [talker.heartbeat() if k % 20 == 0 else talker.attitude(0.05 * k) for k in range(n)]


def recorded(folder, pieces, budget=MORE, names=("udpin:127.0.0.1:14550",)):
    """Record pieces (link, arrival, sender, bytes); give the counters once everything is written."""
    with LinkRecorder(DiskBudget(folder, budget), names) as recorder:
        for link, t, sender, data in pieces:
            recorder.add(link, ReceivedBytes.from_pieces([(t, sender, data)]))
    return recorder.counters()


def adds_up(taped):
    return taped.received == taped.recorded + taped.noise + taped.lost + taped.dropped + taped.waiting


def read(folder, name="*.tlog"):
    """Every record of a folder's files: stamp [us], frame."""
    found = []
    for path in sorted(Path(folder).glob(name)):
        stream = mavutil.mavlink_connection(str(path), dialect="ardupilotmega", robust_parsing=False)
        while (message := stream.recv_msg()) is not None:
            found.append((round(message._timestamp * 1e6), bytes(message.get_msgbuf())))
        stream.close()
    return found


def test_every_frame_is_recorded_with_its_arrival_whoever_sent_it_and_however_it_was_cut(tmp_path):
    rng = np.random.default_rng(3)
    said = {system: b"".join(frames(300, system)) for system in (1, 2, 3)}
    cuts = [(system, cut) for system, data in said.items() for cut in np.sort(rng.integers(0, len(data), 40))]
    begun, pieces = dict.fromkeys(said, 0), []
    for k, (system, cut) in enumerate(sorted(cuts, key=lambda pair: pair[1]) + [(s, len(d)) for s, d in said.items()]):
        pieces.append((0, T0 + k * 1e-3, f"sender {system}", said[system][begun[system] : cut]))
        begun[system] = cut
    (taped,) = recorded(tmp_path, pieces)
    records = read(tmp_path)
    for system, data in said.items():
        assert b"".join(frame for _, frame in records if frame[5] == system) == data
    stamps = [stamp for stamp, _ in records]
    assert stamps == sorted(stamps) and abs(stamps[0] - T0 * 1e6) < 200e3 and len(set(stamps)) > 30
    assert (taped.recorded, taped.noise, taped.waiting, taped.frames) == (sum(map(len, said.values())), 0, 0, 900)


def test_our_own_reader_takes_the_recording_for_the_flight_it_was(tmp_path):
    recorded(tmp_path, [(0, T0 + 0.05 * k, "air", frame) for k, frame in enumerate(frames(400))])
    (path,) = tmp_path.glob("udpin-127.0.0.1-14550_*Z.tlog")
    samples = [message for message in replay_messages(path) if hasattr(message, "attitude")]
    assert sum(len(sample.attitude.t.numpy()) for sample in samples) == 380


def test_noise_is_counted_and_messages_unknown_here_are_kept(tmp_path):
    rng = np.random.default_rng(5)
    good = frames(50)
    strange = bytearray(good[1])
    strange[7:10] = (60_000).to_bytes(3, "little")  # an id of nobody's
    damaged = bytearray(good[2])
    damaged[12] ^= 0xFF
    noise = bytes(byte for byte in rng.bytes(5000) if byte not in (0xFD, 0xFE))
    said = [good[0], bytes(strange), bytes(damaged), noise, *good[3:], good[1][:9]]
    (taped,) = recorded(tmp_path, [(0, T0 + k, "air", data) for k, data in enumerate(said)])
    kept = b"".join((good[0], bytes(strange), *good[3:]))
    written = b"".join(path.read_bytes() for path in tmp_path.glob("*.tlog"))
    assert taped.recorded == len(kept) == len(written) - 8 * taped.frames and bytes(strange) in written
    assert (taped.noise, taped.waiting) == (len(damaged) + len(noise), 9) and adds_up(taped)


def test_links_have_files_of_their_own_and_the_oldest_make_room(tmp_path):
    foreign, budget = tmp_path / "monday.tlog", 1_000_000
    foreign.write_bytes(bytes(2_000_000))
    frame, written = frames(2)[1], 0
    shelf = DiskBudget(tmp_path, budget)
    with TlogWriter("a:1", shelf, 2) as one, TlogWriter("b:2", shelf, 2) as other:
        for k in range(400):
            for tape in (one,) if k % 10 else (one, other):  # the other hears little and keeps its file for long
                assert tape.write(frame * 100, float(k)) == 0
                written += 100 * len(frame)
                ours = [path for path in tmp_path.glob("*.tlog") if path != foreign]
                assert sum(path.stat().st_size for path in ours) == shelf.used <= budget
    assert foreign.stat().st_size == 2_000_000
    assert shelf.removed >= 1 and {path.name[0] for path in ours} == {"a", "b"}
    assert written > budget
    assert DiskBudget(tmp_path, budget).used == shelf.used  # the next run goes on from there


def test_an_old_file_is_followed_by_another(tmp_path):
    with TlogWriter("a", DiskBudget(tmp_path, MORE)) as tape:
        for now in (0.0, MAX_FILE_S - 1, MAX_FILE_S + 1):
            tape.write(b"12345678", now)
    assert len(list(tmp_path.glob("*.tlog"))) == 2


@contextmanager
def files_no_longer_than(size):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_that_takes_no_more_is_said_and_counted_and_later_tried_again(tmp_path):
    records = bytes(1000)
    with TlogWriter("a", DiskBudget(tmp_path, MORE)) as tape:
        with files_no_longer_than(10_500):
            fates = [tape.write(records, 0.0) for _ in range(20)]
        assert fates == [0] * 10 + [1000] * 10
        assert "File too large" in tape.fault and "free space" in tape.fault
        (path,) = tmp_path.glob("*.tlog")
        assert path.stat().st_size == 10_000  # no half of a record stays
        assert tape.write(records, RETRY_S / 2) == 1000
        assert tape.write(records, RETRY_S + 0.1) == 0 and tape.fault == ""


def test_a_disk_that_takes_nothing_is_left_without_empty_files(tmp_path):
    records = bytes(1000)
    with TlogWriter("a", DiskBudget(tmp_path, MORE)) as tape:
        with files_no_longer_than(500):
            for k in range(10):
                assert tape.write(records, k * (RETRY_S + 0.1)) == 1000
                assert "free space" in tape.fault and not list(tmp_path.iterdir())
        assert tape.write(records, 10 * (RETRY_S + 0.1)) == 0  # there is room again
    (path,) = tmp_path.iterdir()
    assert path.stat().st_size == 1000


def test_a_full_disk_loses_nothing_silently(tmp_path, monkeypatch, caplog):
    full = threading.Event()

    class Disk(io.FileIO):
        def write(self, data):
            if full.is_set():
                raise OSError(errno.ENOSPC, "No space left on device")
            return super().write(data)

    monkeypatch.setattr(Path, "open", lambda path, mode, buffering: Disk(path, mode))
    said = frames(300)
    with LinkRecorder(DiskBudget(tmp_path, MORE), ["udpin:h:1"]) as recorder:
        for k, frame in enumerate(said):
            recorder.add(0, ReceivedBytes.from_pieces([(T0 + k, "air", frame)]))
            if k == 100:
                recorder.write()
                full.set()
        recorder.write()
        (taped,) = recorder.counters()
        assert "No space left on device" in taped.fault and taped.fault in caplog.text
    assert taped.recorded == sum(map(len, said[:101])) and taped.lost == sum(map(len, said[101:])) and adds_up(taped)
    assert [frame for _, frame in read(tmp_path)] == said[:101]


def test_a_disk_too_slow_costs_counted_bytes_and_no_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MOST", 10_000)
    said = frames(1000)
    with LinkRecorder(DiskBudget(tmp_path, MORE), ["a"]) as recorder:
        with recorder._lock:  # the thread waits, as for a disk
            recorder._lock = threading.Lock()
            for frame in said:
                recorder.add(0, ReceivedBytes.from_pieces([(T0, "air", frame)]))
        (taped,) = recorder.counters()
        assert taped.dropped > 0 and taped.dropped + 10_000 >= taped.received and adds_up(taped)
    (taped,) = recorder.counters()
    assert taped.recorded == taped.received - taped.dropped and taped.waiting == 0


def test_what_no_longer_fits_into_the_queue_is_recorded_all_the_same(tmp_path):
    with LinkRecorder(DiskBudget(tmp_path, MORE), ["a"]) as recorder:
        tapped = RecordedQueue(1, recorder)
        tapped.put_nowait(Batch(0, ReceivedBytes.from_pieces([(T0, "air", frames(1)[0])])))
        with pytest.raises(module.queue.Full):
            tapped.put_nowait(Batch(0, ReceivedBytes.from_pieces([(T0, "air", frames(2)[1])])))
    assert recorder.counters()[0].frames == 2 and tapped.qsize() == 1


def test_the_queue_is_bounded_in_bytes_too_and_has_room_again_once_something_was_taken():
    heard = Batch(0, ReceivedBytes.from_pieces([(T0, "air", frames(1)[0])]))
    tapped = RecordedQueue(100, None, max_bytes=3 * heard.size)
    for _ in range(3):
        tapped.put_nowait(heard)
    with pytest.raises(module.queue.Full):
        tapped.put_nowait(heard)
    tapped.put_nowait(Batch(0, ended=True))
    assert tapped.get_nowait() == heard
    tapped.put_nowait(heard)


@pytest.mark.parametrize(("text", "size"), [("500M", 5e8), ("10G", 1e10), ("1.5k", 1500), ("7", 7), ("2GB", 2e9)])
def test_a_size_is_read(text, size):
    assert read_size(text, "--record-budget") == size


@pytest.mark.parametrize("text", ["", "0", "-1G", "ten", "1X"])
def test_what_is_no_size_stops_at_start(text):
    with pytest.raises(ValueError, match=r"^--record-budget: found .*, expected .*; correct it$"):
        read_size(text, "--record-budget")


def test_sizes_in_words():
    assert [format_size(n) for n in (7, 1500, 123_456, 2.5e9)] == ["7 B", "1.5 kB", "123 kB", "2.5 GB"]


def test_a_folder_that_cannot_be_made_stops_at_start(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError, match=r"^--record: .*; name another folder$"):
        DiskBudget(tmp_path / "file", MORE)
