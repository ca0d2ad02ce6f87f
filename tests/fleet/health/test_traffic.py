"""What `fleet doctor` finds in the traffic of a fleet and at ports: each provoked, with its remedy."""

import contextlib
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import unused_port

from fleet import cli
from fleet.bus.codec import Stamp
from fleet.contract import Alert, AlertKind, FleetRow, FleetState, Status, TwinState
from fleet.health import ports, traffic
from fleet.health.machine import BAD, NOTE, OK
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import PretendFleet

NOW_MS = int(time.time() * 1e3)
ONE, TWO = Stamp(NOW_MS, 0xA1), Stamp(NOW_MS + 1, 0xB2)


class Busy(MemoryBus):
    """A bus on which something is sent as soon as somebody listens."""

    def __init__(self, *sent: tuple[Any, Stamp | None]) -> None:
        super().__init__()
        self._sent = sent

    def subscribe(self, kind: type, callback: Callable[..., None], accepts: Any = None) -> None:
        super().subscribe(kind, callback, accepts)
        for message, stamp in self._sent:
            if type(message) is kind:
                self.publish(message, stamp)


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traffic, "LISTEN_S", 0.0)


def found(bus: MemoryBus) -> list[tuple[str, str]]:
    return [(one.grade, f"{one.what}: {one.sentence}") for one in traffic.check_traffic(bus)]  # type: ignore[arg-type]


def alert(uav: int) -> Alert:
    return Alert(uav=uav, t=1.0, kind=AlertKind.GROUND)


def row(uav: int, **changes: Any) -> FleetRow:
    healthy = {"state": TwinState.PREDICTING, "worker": "a1", "sample_age_s": 0.1, "prediction_age_s": 0.4}
    return FleetRow(uav=uav, verdict="", **(healthy | changes))


def fleet_of(*rows: FleetRow) -> MemoryBus:
    bus = MemoryBus()
    bus.declare_queryable(FleetState, lambda *_: [(FleetState(t=1.0, rows=rows), None)])
    return bus


# --- writers ---------------------------------------------------------------------------------------------------------


def test_two_writers_of_one_key_are_found_and_one_of_each_is_not() -> None:
    assert found(Busy((alert(7), ONE), (alert(7), ONE), (alert(8), TWO))) == [
        (OK, "writers: one for each of 2 keys received in 0 s")
    ]
    ((grade, text),) = found(Busy((alert(7), ONE), (alert(7), TWO), (alert(8), TWO)))
    assert grade == BAD and text.startswith(
        "writers: parauav/7/alert: written by 00000000000000a1 and 00000000000000b2"
    )
    assert text.endswith("repeat, and stop one if it persists")


def test_a_new_epoch_of_the_same_worker_is_no_second_writer() -> None:
    assert found(Busy((alert(7), ONE), (alert(7), ONE._replace(epoch=NOW_MS + 9))))[0][0] == OK


def test_messages_without_a_writer_and_epochs_of_the_future_are_found() -> None:
    ((grade, text),) = found(Busy((alert(7), None)))
    assert grade == BAD and "parauav/7/alert: messages without a writer; stop the program" in text
    ((grade, text),) = found(Busy((alert(7), Stamp(NOW_MS + 86_400_000, 1))))
    assert grade == BAD and "an epoch in the future" in text and "set the clock" in text


# --- predictions -----------------------------------------------------------------------------------------------------


def test_stalled_predictions_are_found_with_their_worker() -> None:
    bus = fleet_of(row(1), row(2, prediction_age_s=9.0), row(3, prediction_age_s=61.0), row(9, worker="b2"))
    ((grade, text),) = found(bus)
    assert grade == BAD and text.startswith(
        "predictions: uav 2-3: newest 61 s old although telemetry arrives; worker a1"
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"state": TwinState.LINK_LOST},
        {"state": TwinState.IDENTIFYING, "prediction_age_s": None},
        {"sample_age_s": 30.0},  # telemetry itself stopped
    ],
    ids=["link lost", "identifying", "no telemetry"],
)
def test_a_prediction_that_cannot_be_new_is_not_stalled(changes: dict[str, Any]) -> None:
    assert found(fleet_of(row(1, **({"prediction_age_s": 40.0} | changes)))) == []
    assert found(fleet_of(row(1))) == [(OK, "predictions: none of 1 is older than 5 s")]


# --- clocks of aircraft ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"clock_advance_s": 12.3}, "uav 4: timestamps late, corrected by up to 12.3 s; check load"),
        ({"clock_jumps": 2}, "uav 4: clock jumped (2 times at most); the autopilot restarted, or two aircraft share"),
        ({"gps_offset_s": 3.2}, "uav 4: gateway clock 3.2 s ahead of satellite time; synchronise"),
        ({"gps_offset_s": -3.2}, "uav 4: gateway clock 3.2 s behind satellite time; synchronise"),
    ],
)
def test_a_late_clock_is_found(changes: dict[str, Any], text: str) -> None:
    bus = MemoryBus()
    statuses = [Status(uav=3, t=1.0, clock_advance_s=0.4, gps_offset_s=0.1), Status(uav=4, t=1.0, **changes)]
    bus.declare_queryable(Status, lambda *_: [(status, None) for status in statuses])
    ((grade, sentence),) = found(bus)
    assert grade == NOTE and f"aircraft clocks: {text}" in sentence
    statuses.pop()
    assert found(bus) == [(OK, "aircraft clocks: 1 aircraft: no late timestamps, no jumps")]


def test_a_healthy_fleet_has_no_findings() -> None:
    bus = MemoryBus()
    fleet = PretendFleet(bus, 4)  # type: ignore[arg-type]
    fleet.advance(time.time())
    assert {grade for grade, _ in found(bus)} == {OK}
    assert found(MemoryBus()) == []


# --- ports -----------------------------------------------------------------------------------------------------------


def test_the_program_at_a_port_is_named() -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        held.listen()
        port = held.getsockname()[1]
        user = ports.port_user(socket.SOCK_STREAM, port)
        assert user.endswith(f", process {os.getpid()}") and user[0].isalpha()
        taken = ports.viewer_port(port)
        assert taken.grade == NOTE and f"in use by {user}; choose another: --port {port + 1}" in taken.sentence
    assert ports.viewer_port(unused_port()).grade == OK


def test_a_viewer_at_its_port_is_no_finding_and_a_foreign_process_has_no_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "net").mkdir()
    head = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n"
    line = "   0: 0100007F:1F90 00000000:0000 0A 00000000:00000000 00:00000000 00000000  1000        0 777 1\n"
    (tmp_path / "net" / "tcp").write_text(head + line)
    assert ports.port_user(socket.SOCK_STREAM, 8080, tmp_path) == ""  # of another user
    (tmp_path / "41" / "fd").mkdir(parents=True)
    (tmp_path / "41" / "fd" / "3").symlink_to("socket:[777]")
    (tmp_path / "41" / "comm").write_text("python3\n")
    (tmp_path / "41" / "cmdline").write_bytes(b"/x/python3\0-m\0viewer\0--port\x008080\0")
    user = ports.port_user(socket.SOCK_STREAM, 8080, tmp_path)
    assert user == "viewer, process 41" and ports.port_user(socket.SOCK_STREAM, 8081, tmp_path) == ""
    (tmp_path / "41" / "cmdline").write_bytes(b"\x1b]0;x\x07\0")
    (tmp_path / "41" / "comm").write_text("\x1b]0;x\x07\n")
    assert ports.port_user(socket.SOCK_STREAM, 8080, tmp_path) == "?]0;x?, process 41"
    monkeypatch.setattr(ports, "is_port_free", lambda *_: False)
    monkeypatch.setattr(ports, "port_user", lambda *_: user)
    assert ports.viewer_port().grade == OK


def test_a_router_port_of_another_program_is_named_in_the_report(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        held.listen()
        port = held.getsockname()[1]
        with contextlib.suppress(SystemExit):
            assert cli.main(["doctor", "--router", f"tcp/127.0.0.1:{port}"]) == 1
    assert f"process {os.getpid()}" in capsys.readouterr().out
