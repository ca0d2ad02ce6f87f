"""`fleet record`: what the bus said, byte for byte, and back through the same door as every other recording."""

import os
import signal
import subprocess
import sys
import threading
import time

import msgspec
import numpy as np
import pytest
from conftest import ROOT

from fleet.bus.codec import Stamp, encode, encoding
from fleet.bus.session import connect
from fleet.commands.live import record
from fleet.commands.live.record import BusRecorder
from fleet.contract import COLUMNS, TOPICS, Alert, FleetState, Message, Mission, Model, Prediction, Sample, Status
from fleet.telemetry.recording.fleet_log import MAX_UNRECOGNISED, BusRecord
from fleet.telemetry.recording.fleet_news import RESULT_TYPES, TELEMETRY_TYPES
from fleet.telemetry.recording.recordings import Recording, replay_messages
from gateway.link_spec import read_spec
from gateway.links.recorded import ReplayLink
from gateway.pipeline import Pipeline
from gateway.publication import Publisher
from tests.support.examples import EXAMPLES, MESSAGES
from tests.support.fake_link import untimed
from tests.support.flights import rows
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import STAMP, PretendFleet, T
from viewer.store.store import FleetStore

PATIENCE_S = 60.0


class Everything:
    """Whatever is said on a bus, as it came."""

    def __init__(self, bus):
        self.said = []
        for kind in TOPICS.values():
            bus.subscribe_raw(kind, lambda payload, named, stamp: self.said.append((payload, named, stamp)))


def recorded(path, seconds=10.0, uavs=2):
    """Record a pretend fleet that has flown already when the recording begins; give what it said since."""
    bus = MemoryBus()
    fleet = PretendFleet(bus, uavs)
    fleet.advance(T)
    with path.open("wb", buffering=0) as file:
        recorder = BusRecorder(bus, file)
        recorder.subscribe()
        heard = Everything(bus)
        for step in range(1, round(seconds * 10)):
            fleet.advance(T + step * 0.1)
            recorder.write()
    return recorder, heard.said


def everything(path):
    return [message for _, step in Recording(path).steps(results=True) for message in step]


def test_a_recording_holds_every_byte_that_was_said(tmp_path):
    path = tmp_path / "fleet.parauav"
    recorder, said = recorded(path)
    asked = recorder.counts.total() - len(said)
    assert asked == 2 + 2 + 2 + 1  # status, mission, model of each, the prediction of the one not identifying
    assert [encode(message) for message in everything(path)[asked:]] == [payload for payload, *_ in said]
    assert f"{len(said) + asked} messages" in recorder.summary() and recorder.size == path.stat().st_size


def test_every_message_of_the_contract_comes_back(tmp_path):
    path = tmp_path / "all.parauav"
    path.write_bytes(b"".join(BusRecord(T, encoding(type(m)), encode(m), STAMP).pack() for m in MESSAGES))
    found = everything(path)
    assert [encode(m) for m in found] == [encode(m) for m in MESSAGES if type(m) in TELEMETRY_TYPES + RESULT_TYPES]
    assert {type(m) for m in replay_messages(path)} == set(TELEMETRY_TYPES)
    moved = [m for _, step in Recording(path, offset=3).steps(results=True) for m in step]
    assert {m.uav for m in moved if isinstance(m, Message)} == {10}
    assert [row.uav for m in moved if isinstance(m, FleetState) for row in m.rows] == [10]


@pytest.mark.parametrize("suffix", ["", ".xz", ".gz", ".bz2"])
def test_it_is_told_by_its_content_also_compressed(tmp_path, suffix):
    import bz2
    import gzip
    import lzma

    packer = {"": bytes, ".xz": lzma.compress, ".gz": gzip.compress, ".bz2": bz2.compress}[suffix]
    recorded(tmp_path / "a.parauav")
    other = tmp_path / f"b.dat{suffix}"
    other.write_bytes(packer((tmp_path / "a.parauav").read_bytes()))
    recording = Recording(other)
    news = [message for _, step in recording.steps() for message in step]
    assert recording.kind == "fleet recording" and recording.skipped == []
    assert news == list(replay_messages(tmp_path / "a.parauav"))
    assert {type(m) for m in news} == {Sample, Status, Mission} and {m.uav for m in news} == {0, 1}


def test_a_file_cut_anywhere_is_read_to_its_last_whole_record(tmp_path):
    path = tmp_path / "fleet.parauav"
    recorded(path, 3.0)
    data, rng = path.read_bytes(), np.random.default_rng(8)
    whole = [encode(message) for message in everything(path)]
    for cut in [*rng.integers(40_000, len(data), 40).tolist(), len(data) - 1]:
        path.write_bytes(data[:cut])
        recording = Recording(path)
        found = [encode(message) for _, step in recording.steps(results=True) for message in step]
        assert found == whole[: len(found)] and len(found) < len(whole)
        skipped = sum(int(sentence.split(": ")[1].split()[0]) for sentence in recording.skipped)
        assert sum(len(payload) for payload in whole[: len(found)]) <= cut - skipped


def test_two_joined_recordings_play_without_the_days_between(tmp_path):
    status = EXAMPLES[Status]
    heard = [T, T + 1, T + 30 * 86_400, T + 30 * 86_400 + 1]
    packed = [BusRecord(t, encoding(Status), encode(status)).pack() for t in heard]
    path = tmp_path / "joined.parauav"
    path.write_bytes(b"".join(packed))
    times = [now for now, _ in Recording(path).steps()]
    assert len(times) == 3 and np.diff(times) == pytest.approx([1.0, 1.0], abs=0.11)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (msgspec.structs.replace(EXAMPLES[Status], uav=-1), "id out of range"),
        (msgspec.structs.replace(EXAMPLES[Status], t=float("nan")), "an invalid time"),
        (msgspec.structs.replace(EXAMPLES[Mission], items=EXAMPLES[Mission].items * 2000), "invalid items"),
        (
            msgspec.structs.replace(
                EXAMPLES[Sample], air=msgspec.structs.replace(EXAMPLES[Sample].air, x=EXAMPLES[Sample].servo.x)
            ),
            "invalid rows of air",
        ),
    ],
)
def test_a_sound_record_of_nonsense_is_refused_with_its_place(tmp_path, message, words):
    good = BusRecord(T, encoding(Status), encode(EXAMPLES[Status])).pack()
    bad = BusRecord(T, encoding(type(message)), encode(message)).pack()
    path = tmp_path / "odd.parauav"
    path.write_bytes(good + bad + good)
    recording = Recording(path)
    assert len([m for _, step in recording.steps() for m in step]) == 2
    (sentence,) = recording.skipped
    assert words in sentence and f"near byte {len(good)}" in sentence


@pytest.mark.parametrize(
    ("kind", "column", "valid"), [("command", 2, True), ("battery", 1, True), ("battery", 0, False)]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_an_autopilot_does_not_report_is_nan_and_is_played(tmp_path, kind, column, valid, value):
    x = np.ones((2, len(COLUMNS[kind])))
    x[:, column:] = value
    sample = Sample(uav=1, t=T, **{kind: rows(T + np.arange(2.0), x)})
    path = tmp_path / "optional.parauav"
    good = BusRecord(T, encoding(Status), encode(EXAMPLES[Status])).pack()
    path.write_bytes(good + BusRecord(T, encoding(Sample), encode(sample)).pack())
    recording = Recording(path)
    played = [m for _, step in recording.steps() for m in step if isinstance(m, Sample)]
    if valid and np.isnan(value):
        assert np.isnan(getattr(played[0], kind).x.numpy()[:, column:]).all() and not recording.skipped
    else:
        assert not played and any(f"invalid rows of {kind}" in sentence for sentence in recording.skipped)


def test_other_versions_and_broken_payloads_are_refused(tmp_path):
    good = BusRecord(T, encoding(Status), encode(EXAMPLES[Status])).pack()
    newer = BusRecord(T, encoding(Status).replace(".1", ".9"), encode(EXAMPLES[Status])).pack()
    broken = BusRecord(T, encoding(Status), b"\xc1\xc1").pack()
    path = tmp_path / "odd.parauav"
    path.write_bytes(good + newer + broken)
    recording = Recording(path)
    assert len([m for _, step in recording.steps() for m in step]) == 1
    assert any("status.9" in sentence for sentence in recording.skipped)
    assert any("do not fit" in sentence for sentence in recording.skipped)


def test_of_two_workers_only_the_one_that_held_the_aircraft_is_played(tmp_path):
    made = EXAMPLES[Prediction]
    said = [(10, "old"), (20, "new"), (10, "old again"), (20, "newer")]
    path = tmp_path / "two.parauav"
    path.write_bytes(
        b"".join(
            BusRecord(
                T, encoding(Prediction), encode(msgspec.structs.replace(made, sentence=words)), Stamp(epoch, 1)
            ).pack()
            for epoch, words in said
        )
    )
    assert [m.sentence for m in everything(path)] == ["old", "new", "newer"]


def test_what_the_twins_said_then_is_played_and_answered_for(tmp_path):
    path = tmp_path / "fleet.parauav"
    recorded(path)
    bus = MemoryBus()
    heard = Everything(bus)
    Pipeline([ReplayLink(read_spec(f"replay:{path}?speed=max&results=1"))], bus).run(threading.Event())
    played = [payload for payload, named, _ in heard.said if "gateway" not in named and "fleet.state" not in named]
    assert played == [encode(m) for m in everything(path) if not isinstance(m, FleetState)]
    stamps = {named.split(".")[1]: stamp for _, named, stamp in heard.said}
    assert stamps["sample"] is None and stamps["prediction"].epoch > STAMP.epoch
    assert stamps["prediction"].writer == bus.writer
    for kind in (Prediction, Model, Status, Mission):
        assert {message.uav for message, _ in bus.get(kind)} <= {0, 1} and bus.get(kind)
    ((state, stamp),) = bus.get(FleetState)
    assert {row.epoch for row in state.rows} == {stamp.epoch}
    assert bus.get(Alert) == []


def test_the_viewer_believes_the_results_of_then_while_a_worker_computes_its_own():
    bus = MemoryBus()
    feed, player = FleetStore(bus), Publisher(bus, results=True)
    worker = Stamp(time.time_ns() // 1_000_000 - 5, 1)  # it heard of the aircraft when the recording began to play
    then, now = (msgspec.structs.replace(EXAMPLES[Prediction], sentence=words) for words in ("then", "now"))
    bus.publish(now, worker)
    assert feed.get(then.uav).prediction.sentence == "now"
    for _ in range(3):
        player.publish([then])
        bus.publish(now, worker)
        assert feed.get(then.uav).prediction.sentence == "then"


def test_without_asking_for_results_only_telemetry_is_played(tmp_path):
    path = tmp_path / "fleet.parauav"
    recorded(path)
    bus = MemoryBus()
    heard = Everything(bus)
    Pipeline([ReplayLink(read_spec(f"replay:{path}?speed=max"))], bus).run(threading.Event())
    assert {named.split(".")[1] for _, named, _ in heard.said} == {"sample", "status", "mission", "gateway"}


def test_what_the_disk_cannot_take_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "MAX_BUFFER_BYTES", 5_000)
    bus = MemoryBus()
    with (tmp_path / "a.parauav").open("wb", buffering=0) as file:
        recorder = BusRecorder(bus, file)
        recorder.subscribe()
        for _ in range(100):
            bus.publish(EXAMPLES[Status])
        recorder.write()
        bus.publish(EXAMPLES[Status])
        recorder.write()
    assert recorder.dropped == 100 - (recorder.counts.total() - 1) and recorder.size <= 6_000
    assert len(everything(tmp_path / "a.parauav")) == recorder.counts.total()


def test_an_endless_file_of_nothing_is_given_up(tmp_path):
    path = tmp_path / "zeros.parauav"
    with path.open("wb") as file:
        file.truncate(4 * MAX_UNRECOGNISED)
    recording = Recording(path)
    with pytest.raises(ValueError, match=r"zeros\.parauav: \d+ damaged bytes .* expected"):
        list(recording.steps())
    assert recording.source._raw.closed


# --- the command -----------------------------------------------------------------------------------------------------


def command(*arguments, router):
    return subprocess.Popen(
        [sys.executable, "-m", "fleet.cli", "record", *map(str, arguments), "--router", router],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_a_recording_cleanly(router, tmp_path, number):
    path, t, pause = tmp_path / "live.parauav", T, threading.Event()
    with connect(router) as bus, command(path, router=router) as child:
        fleet = PretendFleet(bus, 2)
        while not (path.exists() and path.stat().st_size > 20_000):
            assert child.poll() is None and t < T + 600
            fleet.advance(t := t + 0.1)
            pause.wait(0.02)
        child.send_signal(number)
        _, errors = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0
    (line,) = untimed(errors)
    assert line.startswith("fleet record: ") and "live.parauav is complete" in line
    assert {type(m) for m in everything(path)} >= {Sample, Prediction, FleetState}
    assert Recording(path).skipped == []


def test_it_ends_by_itself_and_never_overwrites_unasked(router, tmp_path):
    path = tmp_path / "short.parauav"
    for options, code, words in (
        (["--for", "0.3"], 0, "no messages yet"),
        (["--for", "0.3"], 2, "expected a new name; choose one, or add --overwrite"),
        (["--for", "0.3", "--overwrite"], 0, "is complete"),
        (["--for", "-1"], 2, "--for: found -1.0 s"),
    ):
        with command(path, *options, router=router) as child:
            _, errors = child.communicate(timeout=PATIENCE_S)
        assert (child.returncode, errors.count("\n")) == (code, 1) and words in errors
    for name, words in (
        ("a.tlog", "expected a name that ends in .parauav"),
        ("none/a.parauav", "expected one; create it first"),
    ):
        with command(tmp_path / name, router=router) as child:
            _, errors = child.communicate(timeout=PATIENCE_S)
        assert child.returncode == 2 and words in errors
