"""No file hangs or fills whoever reads it: time and memory stay within bounds, and live links go on beside it."""

import signal
import socket
from pathlib import Path

import pytest
from conftest import unused_port
from pymavlink.dialects.v20 import ardupilotmega as mav
from test_end_to_end import process, wait

from fleet.bus.session import connect
from fleet.contract import GatewayCounters, Status
from fleet.telemetry.onboard_logs.ulog.formats import Formats
from fleet.telemetry.recording.opening import MAX_RATIO, MIN_UNPACKED_LIMIT, RecordingFile
from gateway.link_spec import read_spec
from gateway.links.recorded import split_replays
from tests.bench.security.hostile_files import CPU_S, FILES, MEMORY_MB, a_flight, read_apart, rightful_files, written

SHORT = ("regex", "nested formats", "records in records", "DataFlash, formats over and over", "tlog with gaps")
SHORT += ("MATLAB of a billion cells", "MATLAB that unfolds", "MCAP that unfolds", "MCAP of long records")
SHORT += ("SQLite bag without end",)
"""Those that are over quickly; `python -m tests.bench.security` reads all."""


@pytest.mark.parametrize("what", SHORT)
def test_a_hostile_file_ends_soon_in_little_memory_with_a_sentence(what: str, tmp_path: Path) -> None:
    cost = read_apart(written(tmp_path, what))
    assert cost["cpu_s"] <= CPU_S and cost["mb"] <= MEMORY_MB and cost["sentence"], cost


def test_a_sound_log_of_each_kind_is_read() -> None:
    assert rightful_files()


def test_every_file_of_the_table_is_made() -> None:
    assert len(FILES["regex"][1]()) <= 254 and len(FILES) >= 20


@pytest.mark.parametrize("n", [10, 1000, 15_000])
def test_a_format_is_judged_in_one_pass(n: int) -> None:
    formats = Formats(frozenset())
    assert not formats.is_format(b"a:" + b"bb cc" * n + b"!") and not formats.is_format(b"a:" + b"b " * n)
    assert formats.is_format(b"a:uint8_t[3] b;float c") and formats.is_format(b"a:uint8_t b;")
    assert not any(map(formats.is_format, (b"a:", b"a", b":b c;", b"a:b c;;", b"a:;b c", b"a:b[] c;", b"a:b c d;")))


def test_formats_are_looked_into_once_and_only_so_many_are_kept() -> None:
    formats = Formats(frozenset({"t"}))
    for k in range(1, 8):
        assert formats.declare(f"f{k}:".encode() + b";".join(b"f%d x%d" % (k - 1, i) for i in range(4)) + b";")
    assert formats.declare(b"f0:uint8_t x;")
    assert formats.declare(b"t:uint64_t timestamp;f5 x;") and formats.declare(b"deep:uint64_t timestamp;f7 x;f7 y;")
    assert formats.subscribe(b"\0\0\0t") and formats.topics[0].max_size == 8 + 4**5
    assert not formats.subscribe(b"\0\1\0deep")
    assert len(formats._extents) < 50
    kept = sum(formats.declare(f"g{k}:uint64_t timestamp;".encode()) for k in range(60_000))
    assert 10_000 < kept < 60_000


@pytest.mark.parametrize("suffix", [".gz", ".xz", ".bz2"])
def test_an_archive_ends_where_no_recording_would_unfold_to(suffix: str, tmp_path: Path) -> None:
    import bz2
    import gzip
    import lzma

    pack = {".gz": gzip.compress, ".xz": lzma.compress, ".bz2": bz2.compress}[suffix]
    bomb, small = tmp_path / f"bomb.tlog{suffix}", tmp_path / f"small.tlog{suffix}"
    bomb.write_bytes(pack(bytes(2 * MIN_UNPACKED_LIMIT)))
    small.write_bytes(pack(bytes(MIN_UNPACKED_LIMIT)))
    source = RecordingFile(bomb)
    with source.open() as stream:
        assert sum(map(len, iter(lambda: stream.read(1 << 20), b""))) == max(
            MIN_UNPACKED_LIMIT, MAX_RATIO * source.size
        )
    assert "decompress to more than" in source.problem and "decompress a trusted file" in source.problem
    source = RecordingFile(small)
    with source.open() as stream:
        assert len(stream.read(MIN_UNPACKED_LIMIT + 1)) == MIN_UNPACKED_LIMIT
    assert "damaged" not in source.problem


def test_recordings_are_played_apart_only_beside_live_links() -> None:
    live, file = read_spec("udpin:14550"), read_spec("replay:a.tlog")
    assert split_replays([live, file]) == ([live], [file])
    assert split_replays([file]) == ([file], []) and split_replays([live]) == ([live], [])


@pytest.mark.parametrize("what", ["hostile", "good"])
def test_a_live_link_is_served_beside_a_file_and_sigterm_ends_both(what: str, router: str, tmp_path: Path) -> None:
    file, port = written(tmp_path, "regex"), unused_port(socket.SOCK_DGRAM)
    if what == "good":
        file = tmp_path / "good.tlog"
        file.write_bytes(a_flight())
    beat = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3)
    talker = mav.MAVLink(None, 5, 1)
    heard: set[int] = set()
    accounts: set[tuple[str, ...]] = set()
    links = ("--link", f"udpin:127.0.0.1:{port}", "--link", f"replay:{file}")
    with connect(router) as bus, socket.socket(type=socket.SOCK_DGRAM) as aircraft:
        bus.subscribe(Status, lambda status, _: heard.add(status.uav))
        bus.subscribe(GatewayCounters, lambda account, _: accounts.add(account.links))
        with process("gateway", *links, "--router", router) as gateway:

            def served() -> bool:
                aircraft.sendto(beat.pack(talker), ("127.0.0.1", port))
                return 5 in heard and (what == "hostile" or any("replay:" in name for name, *_ in accounts))

            wait(served, gateway)
            assert all(len(names) == 1 for names in accounts), "live link and file each in a process of its own"
            gateway.send_signal(signal.SIGTERM)
            assert gateway.wait(60) == 0
