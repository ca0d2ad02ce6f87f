"""MAVLink 2 signatures, held against pymavlink's; forgeries, replays and locked files."""

import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.telemetry.mavlink.intake import MavlinkReceiver
from gateway.admission import (
    REPLAYED,
    STALE,
    UNSIGNED,
    WRONG,
    Admission,
    Signing,
    make_admissions,
    read_keys,
    select_key,
    stamp_now,
)
from gateway.link_spec import read_spec
from tests.support.oracle import ours
from tests.support.talker import T0, Ears, Talker

KEY, OTHER = bytes(range(32)), bytes(32)
NOW = 37_000_000_000_000  # [10 us since 2015]
FAR = 2**48 - 1


class Signer(Talker):
    """A talker that signs, as pymavlink does."""

    def __init__(self, key=KEY, stamp=NOW, system=7, component=1, link=5):
        super().__init__(system, component)
        signing = self._mav.signing
        signing.secret_key, signing.timestamp, signing.link_id, signing.sign_outgoing = key, stamp, link, True


def signing(require=True):
    return Signing(KEY, require, link=9, clock=lambda: NOW)


def passed(guard, *frames):
    """Whether each frame passes, and why not."""
    refused = Counter()
    heard = ours(list(frames))
    assert len(heard.headers) == len(frames)
    return guard.verify(heard, refused).tolist(), dict(refused)


def test_what_pymavlink_signed_passes_and_the_unsigned_where_it_may():
    plain, signed = Talker().heartbeat(), Signer().heartbeat()
    old = Talker().pack(mav.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3), v1=True)
    assert passed(signing(), plain, signed, old) == ([False, True, False], {UNSIGNED: 2})
    assert passed(signing(require=False), plain, signed, old) == ([True] * 3, {})
    assert passed(signing(require=False), Signer(OTHER).heartbeat()) == ([False], {WRONG: 1})


def test_pymavlink_takes_what_we_sign():
    ours = signing()
    far = mav.MAVLink(None, srcSystem=7)
    far.signing.secret_key = KEY
    far.signing.timestamp = NOW
    for seq in range(3):
        frame = ours.sign(Talker(255, 190).pack(mav.MAVLink_param_request_read_message(7, 1, b"ALT", seq)))
        (message,) = far.parse_buffer(frame)
        assert (message.get_type(), message.param_index, message.get_signed()) == ("PARAM_REQUEST_READ", seq, True)
        assert message.get_link_id() == 9
    assert passed(signing(), frame)[0] == [True]


def test_a_replay_passes_once():
    talker = Signer()
    one, two = talker.heartbeat(), talker.heartbeat()
    assert passed(signing(), one, two, one, two) == ([True, True, False, False], {REPLAYED: 2})
    assert passed(signing(), Signer(stamp=NOW - 6_000_001).heartbeat()) == ([False], {STALE: 1})
    other_link = Signer(link=6, stamp=NOW - 5_000_000).heartbeat()
    assert passed(signing(), two, other_link)[0] == [True, True]


def test_a_forged_stamp_from_the_far_future_locks_nobody_out():
    guard, genuine = signing(), Signer()
    assert passed(guard, genuine.heartbeat())[0] == [True]
    forged = Signer(OTHER, stamp=FAR - 10).heartbeat()
    assert passed(guard, forged) == ([False], {WRONG: 1})
    assert passed(guard, genuine.heartbeat(), genuine.attitude(1.0))[0] == [True, True]
    begun_by_forger = signing()
    assert passed(begun_by_forger, forged)[0] == [False]
    assert passed(begun_by_forger, genuine.heartbeat())[0] == [True]
    far = mav.MAVLink(None, srcSystem=7)  # must still take what we say
    far.signing.secret_key, far.signing.timestamp = KEY, NOW
    assert len(far.parse_buffer(guard.sign(Talker(255).heartbeat()))) == 1


def test_pymavlink_itself_is_locked_out_which_is_why_we_do_not_use_it():
    ears = mav.MAVLink(None)
    ears.signing.secret_key, ears.robust_parsing = KEY, True
    genuine = Signer()
    assert ears.parse_buffer(genuine.heartbeat())[0].get_type() == "HEARTBEAT"
    ears.parse_buffer(Signer(OTHER, stamp=FAR - 10).heartbeat())
    assert ears.parse_buffer(genuine.heartbeat())[0].get_type() == "BAD_DATA"


def test_whose_clock_is_ahead_is_answered_on_its_time_and_shuts_nobody_else_out():
    guard = signing()
    assert passed(guard, Signer(stamp=NOW + 10**9).heartbeat())[0] == [True]
    assert passed(guard, Signer(system=8).heartbeat())[0] == [True]
    frame = guard.sign(Talker(255).heartbeat())
    assert int.from_bytes(frame[-12:-6], "little") > NOW + 10**9


@settings(max_examples=200)
@given(st.integers(0, 25), st.integers(1, 255))
def test_no_changed_byte_of_a_signed_frame_passes(at, by):
    frame = bytearray(Signer().heartbeat())
    body = len(frame) - 13
    frame[body + at % 13 if at >= 13 else 4 + at % (body - 6)] ^= by
    refused = Counter()
    crc = mav.x25crc(bytes(frame[1 : body - 2]) + bytes([mav.MAVLink_heartbeat_message.crc_extra])).crc
    frame[body - 2 : body] = crc.to_bytes(2, "little")  # whoever forges can reckon a checksum
    heard = ours([bytes(frame)])
    assert not signing().verify(heard, refused).any()


def test_a_link_that_requires_signatures_knows_no_unsigned_aircraft():
    spec = read_spec("udpin:127.0.0.1:14550#sign=require")
    intake = MavlinkReceiver(admit=Admission(spec.message_filter, Signing(KEY, require=True)).admit)
    intake.receive(
        T0, Talker(6).heartbeat() + Signer(OTHER, stamp_now(), 8).heartbeat() + Signer(KEY, stamp_now()).heartbeat()
    )
    intake.flush(T0)
    assert [craft.uav for craft in intake.aircraft.values()] == [7]
    assert intake.rejected == {UNSIGNED: 1, WRONG: 1}


def test_our_own_words_are_signed_where_a_link_has_a_key(tmp_path):
    file = keys(tmp_path, f"a {KEY.hex()}\nb {OTHER.hex()} # of the others\n\n")
    specs = [read_spec(f"udpin:h:1#{text}") for text in ("", "sign=accept&key=a", "sign=require&key=b")]
    found, frame = make_admissions(specs, 0, file), Talker(255).heartbeat()
    assert [gate.sign(frame)[2] & 1 for gate in found] == [0, 1, 1]
    assert passed(Signing(OTHER, require=True), found[2].sign(frame))[0] == [True]
    (heard,) = Ears().feed(found[1].sign(frame))
    assert heard.get_type() == "HEARTBEAT"


# ---- the file of keys


def keys(folder, text, mode=0o600):
    path = folder / "keys.txt"
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o620])
def test_a_file_others_may_read_is_refused(tmp_path, mode):
    path = keys(tmp_path, f"a {KEY.hex()}\n", mode)
    with pytest.raises(ValueError, match=rf"^keys {path}: found mode 0{mode:o}, owner \d+, expected .*; chmod 600 "):
        read_keys(path)


def test_a_file_of_a_stranger_and_what_is_no_file_are_refused(tmp_path, monkeypatch):
    path = keys(tmp_path, f"a {KEY.hex()}\n")
    assert read_keys(path) == {"a": KEY}
    if path.stat().st_uid != 0:
        monkeypatch.setattr(os, "geteuid", lambda: 12345)
        with pytest.raises(ValueError, match="expected a file readable only by its owner"):
            read_keys(path)
    with pytest.raises(ValueError, match="expected a file readable only by its owner"):
        read_keys(Path("/dev/null"))
    with pytest.raises(OSError, match="No such file"):
        read_keys(tmp_path / "none")


@pytest.mark.parametrize("line", ["a", "a 00", f"a {'0' * 63}g", f"a {'0' * 64} b"])
def test_a_line_that_is_no_key_is_named_without_telling_it(tmp_path, line):
    path = keys(tmp_path, f"x {KEY.hex()}\n{line}\n")
    with pytest.raises(ValueError, match="found invalid line 2") as caught:
        read_keys(path)
    assert KEY.hex() not in str(caught.value) and "00" not in str(caught.value).replace("600", "")


def test_the_key_of_a_link_is_the_one_it_names_or_the_only_one():
    assert select_key({"a": KEY}, "", "udpin") == select_key({"a": KEY, "b": OTHER}, "a", "udpin") == KEY
    for found, name in (({}, ""), ({"a": KEY, "b": OTHER}, ""), ({"a": KEY}, "c")):
        with pytest.raises(ValueError, match=r"link udpin: found .*, expected one of --keys FILE"):
            select_key(found, name, "udpin")


def test_a_hundred_senders_are_told_apart():
    guard = signing()
    frames = [Signer(system=system, stamp=NOW + system).heartbeat() for system in range(1, 101)]
    assert np.all(passed(guard, *frames)[0])
    assert passed(guard, *frames)[1] == {REPLAYED: 100}
