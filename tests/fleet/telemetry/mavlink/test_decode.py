"""The batched decoder against pymavlink: every message, both versions, cut, damaged, and in pieces of any size."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav
from pymavlink.dialects.v20 import common

from fleet.telemetry.mavlink.parsing.decode import IDS, Decoder, layout
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.mavlink.parsing.scan import STOP
from fleet.telemetry.recording.opening import RecordingFile
from fleet.telemetry.recording.tlog import Tlog
from tests.bench.gateway import fuzz
from tests.support import oracle

QUICK = 4_000  # frames; `python -m tests.bench.gateway.equal` takes a hundred thousand and more


def test_every_message_of_both_dialects_is_known_alike():
    assert set(common.mavlink_map) <= set(mav.mavlink_map)
    for number, kind in common.mavlink_map.items():
        other = mav.mavlink_map[number]
        assert (kind.crc_extra, kind.unpacker.format) == (other.crc_extra, other.unpacker.format)
        assert layout(kind.msgname).itemsize == kind.unpacker.size


@pytest.mark.parametrize("seed", [1, 2])
def test_all_messages_field_by_field(seed):
    made = oracle.frames(np.random.default_rng(seed), QUICK)
    messages = oracle.by_pymavlink(made)
    assert len(messages) == QUICK and {m.get_msgId() for m in messages} == set(mav.mavlink_map)
    frames = oracle.ours(made)
    oracle.assert_equal(frames, messages)
    assert frames.arrival.tolist() == list(range(QUICK))


@pytest.mark.parametrize("seed", [3, 4])
def test_a_damaged_stream_gives_every_sound_frame_and_more_than_pymavlink(seed):
    rng = np.random.default_rng(seed)
    stream = oracle.worsened(rng, b"".join(oracle.frames(rng, QUICK)))
    decoder = Decoder()
    frames = oracle.ours([stream, b"\0" * 600], decoder)
    oracle.assert_equal(frames, oracle.searched(stream))
    theirs = oracle.by_pymavlink([stream])
    lost = set(oracle.raw(frames)) - {bytes(m.get_msgbuf()) for m in theirs}
    assert {bytes(m.get_msgbuf()) for m in theirs} <= set(oracle.raw(frames)) and len(lost) > 100
    sound = sum(map(len, oracle.raw(frames)))
    assert decoder.counts[1] <= len(stream) + 600 - sound <= decoder.counts[1] + decoder.counts[3] * 280


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 700), min_size=1, max_size=30), st.booleans())
def test_pieces_of_any_size_give_what_the_whole_gives(seed, sizes, damaged):
    rng = np.random.default_rng(seed)
    stream = b"".join(oracle.frames(rng, 40))
    stream = oracle.worsened(rng, stream) if damaged else stream
    cuts = np.unique(np.clip(np.cumsum(sizes), 0, len(stream))).tolist()
    pieces = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)] + [b"\0" * 600]
    decoder, one_by_one = Decoder(), []
    for piece in pieces:
        one_by_one += oracle.raw(decoder.decode(ReceivedBytes.from_pieces([(0.0, "a", piece)])))
    whole = oracle.ours([*pieces])
    assert oracle.raw(whole) == one_by_one == [bytes(m.get_msgbuf()) for m in oracle.searched(stream)]


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(2, 6))
@example(44, 4)  # these four: a frame wholly in the carried bytes got the arrival of another sender's piece
@example(65, 4)
@example(69, 4)
@example(235, 4)
@example(830, 2)  # a false unknown frame up to the end of a batch swallowed the start of the next frame
def test_senders_do_not_disturb_each_other(seed, senders):
    rng = np.random.default_rng(seed)
    streams = [oracle.worsened(rng, b"".join(oracle.frames(rng, 12))) + b"\0" * 600 for _ in range(senders)]
    left, pieces = list(streams), []
    while any(left):
        who = int(rng.integers(senders))
        size = int(rng.integers(1, 400))
        pieces.append((float(len(pieces)), who, left[who][:size]))
        left[who] = left[who][size:]
    decoder, heard = Decoder(), {who: [] for who in range(senders)}
    for batch in np.array_split(np.arange(len(pieces)), 3):
        frames = decoder.decode(ReceivedBytes.from_pieces([pieces[i] for i in batch.tolist()]))
        assert (np.diff(frames.arrival) >= 0).all()
        for data, sender in zip(oracle.raw(frames), frames.sender.tolist(), strict=True):
            heard[frames.senders[sender]].append(data)
    for who, stream in enumerate(streams):
        assert heard[who] == [bytes(m.get_msgbuf()) for m in oracle.searched(stream)]


def test_a_frame_inside_a_false_start_is_found():
    good = oracle.framed(IDS["HEARTBEAT"], bytes(range(1, 10)), 50)
    frames = oracle.ours([b"\xfe\x40\0\0\0\0" + good + bytes(70)])
    assert oracle.raw(frames) == [good]


def test_messages_unknown_here_are_counted_and_passed_over_whole():
    good = oracle.framed(IDS["HEARTBEAT"], bytes(range(1, 10)), 50)
    strange = oracle.framed(60_000, bytes(range(1, 60)), 7)
    tunnel = oracle.framed(60_000, good, 7)  # what it carries is not for us
    assert 60_000 not in mav.mavlink_map
    for pieces in ([tunnel, good, tunnel], [good + strange + strange + good], [strange + good + strange]):
        decoder = Decoder()
        frames = oracle.ours(pieces, decoder)
        told = b"".join(pieces)
        assert oracle.raw(frames) == [good] * (told.count(good) - told.count(tunnel))
        unknown = told.count(strange) + told.count(tunnel)
        want = {"messages": len(frames.headers), "bad_bytes": 0, "bad_frames": 0, "unknown": unknown}
        assert decoder.counters() == want


def test_what_only_looks_like_an_unknown_message_swallows_nothing():
    good = oracle.framed(IDS["HEARTBEAT"], bytes(range(1, 10)), 50)
    false = bytes([oracle.V2, len(good) - 5, 0, 0, 0, 7, 1, 0x60, 0xEA, 0])  # claims to end where the next one begins
    frames = oracle.ours([good + false[:7] + good + good])
    assert oracle.raw(frames) == [good] * 3


def test_incompatible_flags_are_no_frame():
    good = bytearray(oracle.framed(IDS["HEARTBEAT"], bytes(range(1, 10)), 50))
    good[2] = 2
    crc = mav.x25crc(bytes(good[1:-2]) + bytes([50])).crc
    good[-2:] = crc.to_bytes(2, "little")
    assert len(oracle.ours([bytes(good)]).headers) == 0


def test_junk_neither_raises_nor_hangs_nor_hides_a_good_aircraft():
    found = fuzz.run(seed=5, total=1_500_000)
    assert found["blocks_with_the_good_aircraft"] == found["blocks"] == 15
    assert found["slowest_cpu_s"] < 2.0 and found["counters"]["bad_bytes"] > 1_000_000


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["sitl/s02_nominal_light_wind.tlog.xz", "real/cuav_quadplane_20161112.tlog"])
def test_recordings_field_by_field(recordings: Path, name):
    batch = next(Tlog(RecordingFile(recordings / name)).batches())
    some = batch._replace(headers=batch.headers[:6_000], arrival=batch.arrival[:6_000], sender=batch.sender[:6_000])
    frames = oracle.raw(some)
    oracle.assert_equal(oracle.ours(frames), oracle.by_pymavlink(frames))
    assert len(some.headers) == 6_000 and some.headers[-1, STOP] <= len(batch.buf)
