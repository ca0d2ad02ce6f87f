"""What `fleet doctor` and `fleet status` say of a fleet: every finding is provoked, every bad one ends in a cure."""

import contextlib
import io
import json
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable
from datetime import timedelta
from pathlib import Path

import pytest
from conftest import unused_port
from rich.console import Console

from fleet import SOURCES, cli
from fleet.access.entry import BusConfig
from fleet.access.knock import _remedy
from fleet.bus.session import open_router
from fleet.commands.live.status import machines, processes, watch
from fleet.contract import Claim, FleetRow, FleetState, GatewayCounters, LinkCounters, Status, TwinState
from fleet.health import claims, machine, ports
from fleet.health import claims as door
from fleet.health.machine import BAD, NOTE, OK
from fleet.report.report_text import id_ranges
from tests.bench.security.bombs import ESCAPES
from tests.bench.security.site import expired, make_papers, make_passwords
from tests.support.memory_bus import MemoryBus

ONE, TWO = "0" * 15 + "1", "0" * 15 + "2"


def claim(worker: str, held: Iterable[int], **said: object) -> Claim:
    given = {"t": time.time(), "machine": f"m{worker[-1]}", "code": SOURCES} | said
    return Claim(worker=worker, owned=tuple((uav, 5) for uav in held), **given)


def fleet(
    *said: Claim, uavs: Iterable[int] = range(4), live: Iterable[str] = ("1/0-9", "2/0-9"), **account
) -> MemoryBus:
    """A bus where these claims are answered, these aircraft heard, and these workers present."""
    bus = MemoryBus()
    heard = tuple(uavs)
    told = GatewayCounters(t=1.0, uavs=heard, links=("udpin:x",), **({"machine": "gs", "code": SOURCES} | account))
    bus.declare_queryable(Claim, lambda *_: [(one, None) for one in said])
    bus.declare_queryable(GatewayCounters, lambda *_: [(told, None)])
    bus.declare_queryable(Status, lambda *_: [(Status(uav=uav, t=1.0), None) for uav in heard])
    for name in live:
        worker, _, ids = name.partition("/")
        bus.declare_liveliness(f"worker/{worker.zfill(16)}/{ids}/1")
    return bus


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "RECHECK_S", 0.0)


def found(bus: MemoryBus, grade: str) -> list[str]:
    return [f"{one.what}: {one.sentence}" for one in claims.check_fleet(bus) if one.grade == grade]


def test_a_healthy_fleet_is_told_line_by_line() -> None:
    bus = fleet(claim(ONE, (0, 1)), claim(TWO, (2, 3)))
    assert found(bus, BAD) == found(bus, NOTE) == []
    assert found(bus, OK) == [
        "gateways: gs: 4 aircraft on 1 links",
        "clocks: m1: within 0.2 s of this machine's",
        "clocks: m2: within 0.2 s of this machine's",
        "versions: all 3 processes have the release of this command",
        f"owners: {ONE} on m1: owns 0-1, id range 0-9",
        f"owners: {TWO} on m2: owns 2-3, id range 0-9",
        "orphans: none of 4 aircraft",
    ]


def of(*said: Claim, **more: object) -> MemoryBus:
    """A fleet of one worker that may hold 0 to 9."""
    return fleet(*said, live=["1/0-9"], **more)


FOUR = range(4)
WRONG: list[tuple[Callable[[], MemoryBus], str, str]] = [  # made when they are looked at: clocks run on
    (lambda: fleet(claim(ONE, (0, 1, 2)), claim(TWO, (2, 3))), BAD, f"uav-2: claimed by {ONE} and {TWO}; stop one"),
    (lambda: fleet(claim(ONE, (0, 1)), claim(TWO, ())), BAD, "uav 2-3: in a worker range but not claimed; rest"),
    (lambda: of(claim(ONE, (0, 1)), uavs=(0, 1, 77, 78)), BAD, "uav 77-78: in no worker range; start"),
    (lambda: fleet(claim(ONE, FOUR)), BAD, f"{TWO} is live but does not answer: process or machine frozen"),
    (lambda: fleet(claim(ONE, FOUR), live=[]), BAD, f"{ONE}: claims without a liveliness token; restart"),
    (lambda: of(claim(ONE, FOUR, without_history=(2,))), NOTE, "uav 2 without past telemetry"),
    (lambda: of(claim(ONE, FOUR, t=time.time() - 9.0)), BAD, "m1: 9.0 s behind .*; synchronise both"),
    (lambda: of(claim(ONE, FOUR, t=time.time() + 0.6)), NOTE, "m1: 0.6 s ahead of this machine's"),
    (lambda: of(claim(ONE, FOUR, code="other")), NOTE, "twin_worker on m1: other release .* install"),
    (lambda: of(claim(ONE, FOUR), code="x"), NOTE, "gateway on gs: other release than here"),
    (lambda: fleet(live=[]), NOTE, "workers: none found; start `twin_worker`"),
]


@pytest.mark.parametrize(("make", "grade", "sentence"), WRONG, ids=[sentence[:30] for _, _, sentence in WRONG])
def test_what_is_wrong_is_found_with_its_cure(make: Callable[[], MemoryBus], grade: str, sentence: str) -> None:
    lines = found(make(), grade)
    assert any(re.search(sentence, line) for line in lines), lines


def test_a_release_that_all_have_but_this_machine_is_not_taken_for_a_mixture() -> None:
    bus = of(claim(ONE, FOUR, code="other"), code="other")
    assert found(bus, NOTE) == ["versions: all 2 processes have one release, this command another; install theirs"]


def test_the_port_our_own_gateway_has_is_no_finding() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        with contextlib.suppress(OSError):  # some gateway of this machine may hold it just as well
            held.bind(("0.0.0.0", machine.MAVLINK_PORT))
        assert ports.mavlink_port(["udpin:0.0.0.0:14550"]).grade == OK
        taken = ports.mavlink_port(["udpin:0.0.0.0:14551"])
        assert taken.grade == NOTE and "--link udpin" in taken.sentence


def test_the_clock_of_a_gateways_machine_counts_too() -> None:
    assert any("gs: 30.0 s behind" in line for line in found(of(claim(ONE, FOUR), wall_t=time.time() - 30.0), BAD))


def test_two_gateways_of_one_aircraft_and_none_at_all() -> None:
    bus = of(claim(ONE, FOUR))
    bus.declare_queryable(
        GatewayCounters, lambda *_: [(GatewayCounters(t=1.0, uavs=(3, 9), machine="gs2", code=SOURCES), None)]
    )
    assert found(bus, BAD) == ["gateways: two gateways publish uav 3; change the offset of one (#offset=), or stop it"]
    assert found(MemoryBus(), NOTE)[0].startswith("gateways: none found; start `gateway`")


def test_a_handover_under_way_is_no_fault() -> None:
    bus, turn = MemoryBus(), iter([((0, 1), (1,)), ((0,), (1,))])
    bus.declare_liveliness(f"worker/{ONE}/0-9/1")
    bus.declare_liveliness(f"worker/{TWO}/0-9/1")
    bus.declare_queryable(Claim, lambda *_: [(claim(w, h), None) for w, h in zip((ONE, TWO), next(turn), strict=True)])
    bus.declare_queryable(Status, lambda *_: [(Status(uav=uav, t=1.0), None) for uav in (0, 1)])
    assert found(bus, BAD) == []


def test_names_from_the_wire_are_only_names() -> None:
    bus = fleet(claim(ONE, range(4), machine=ESCAPES), live=["1/0-9", "1/x-y", "9" * 5000 + "/1-2", "3/0-" + "9" * 99])
    assert len(list(claims.check_fleet(bus))) < 12


# --- certificates ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_papers(tmp_path_factory.mktemp("site") / "certificates", "127.0.0.1")


def shown(capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, str]:
    return cli.main(["doctor", *options]), capsys.readouterr().out


def test_certificates_are_judged_by_their_end_and_the_fleet_behind_them_is_seen(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    at = f"tls/127.0.0.1:{unused_port()}"
    file = tmp_path / "fleet.toml"
    file.write_text(f'[router]\nat = "{at}"\ncertificates = "{site}"\n')
    with open_router(BusConfig(at, certificates=site)):
        code, out = shown(capsys, f"--config={file}")
    assert code == 0
    assert out.count("certificates") >= 7 and "router: valid until" in out and "offline" in out
    assert "gateways       none found" in out

    soon = expired(site, "viewer", tmp_path / "soon", ended=timedelta(days=-3))
    (soon / "worker.key").chmod(0o644)
    old = {line.sentence: line.grade for line in door.check_certificates(BusConfig(at, "tools", soon))}
    assert any(
        g == NOTE and "viewer: expires on" in s and "renew it: certificates.sh role" in s for s, g in old.items()
    )
    assert any(g == BAD and "chmod 640" in s for s, g in old.items())
    gone = [
        one
        for one in door.check_certificates(BusConfig(at, "viewer", expired(site, "viewer", tmp_path / "old")))
        if one.grade == BAD
    ]
    assert "expired on" in gone[0].sentence and "renew it: certificates.sh role FOLDER viewer" in gone[0].sentence


def test_a_routers_certificate_is_renewed_as_one(site: Path, tmp_path: Path) -> None:
    for name, ended in (("past", timedelta(days=1)), ("soon", timedelta(days=-3))):
        folder = expired(site, "router", tmp_path / name, ended=ended)
        lines = [one.sentence for one in door.check_certificates(BusConfig("tls/127.0.0.1:1", "tools", folder))]
        assert any("renew it: certificates.sh router FOLDER NAME" in line for line in lines), name


def test_why_a_router_is_not_believed_decides_what_helps(site: Path, tmp_path: Path) -> None:
    named = tmp_path / "named"
    make_papers(named, "router.example", authority=site)
    at = f"tls/127.0.0.1:{unused_port()}"
    with open_router(BusConfig(at, certificates=named)):
        (bad,) = [one for one in door.check_router(BusConfig(at, "tools", site)) if one.grade == BAD]
    assert "create one for this name too (certificates.sh router FOLDER NAME...)" in bad.sentence
    assert "set the clock" in _remedy("certificate is not yet valid") and "restart" in _remedy(
        "certificate has expired"
    )


def test_a_network_in_the_clear_is_noted(site: Path) -> None:
    assert [one.grade for one in door.check_certificates(BusConfig())] == [OK]
    (note,) = door.check_certificates(BusConfig("tcp/10.1.2.3:7447", passwords=make_passwords(site)))
    assert note.grade == NOTE and "unencrypted, password authentication; use --config" in note.sentence


def test_findings_are_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    code, out = shown(capsys, "--json", "--router", f"tcp/127.0.0.1:{unused_port()}")
    assert code == 0 and {"grade", "what", "sentence"} == set(json.loads(out)[0])


# --- status ----------------------------------------------------------------------------------------------------------


def test_status_tells_which_machine_does_what() -> None:
    bus = fleet(claim(ONE, (0, 1, 2, 5), leaving=True), per_link=(LinkCounters(link="udpin:x", messages_hz=40.0),))
    row = FleetRow(uav=0, state=TwinState.WAITING, verdict="", worker=ONE)
    bus.declare_queryable(FleetState, lambda *_: [(FleetState(t=1.0, rows=(row,), sentence=f"busy{ESCAPES}"), None)])
    console = Console(file=io.StringIO(), width=160)
    with console.capture() as captured:
        console.print(machines(processes(bus)))
    lines = captured.get().splitlines()
    assert lines[1].split() == ["gs", "gateway", "0-3", "40", "messages/s"]
    assert lines[2].split()[:5] == ["m1", "worker", ONE, "0-2,", "5"] and "is leaving; busy" in lines[2]
    assert "\x1b" not in captured.get()


@pytest.mark.parametrize("terminal", [True, False])
def test_status_is_repeated_until_it_is_stopped_and_a_late_prediction_is_red(*, terminal: bool) -> None:
    stop, out = threading.Event(), io.StringIO()

    def rows(*_: object) -> list[tuple[FleetState, None]]:
        age = next(ages)
        if age > 60:
            stop.set()
        row = FleetRow(uav=7, state=TwinState.VERIFIED, verdict="", worker=ONE, prediction_age_s=age)
        return [(FleetState(t=1.0, rows=(row,)), None)]

    bus = of(claim(ONE, (7,)), uavs=(7,))
    stop.wait = lambda _=None: stop.is_set()  # type: ignore[method-assign, assignment]
    # `processes` asks for the same message, so each look takes two
    ages = iter([0.4, 0.4, 5.1, 5.1, 61.0, 61.0])
    bus.declare_queryable(FleetState, rows)
    console = Console(file=out, width=120, force_terminal=terminal, color_system="standard" if terminal else None)
    assert watch(bus, stop, console) == 0  # type: ignore[arg-type]
    shown = out.getvalue()
    assert 3 <= shown.count("until Ctrl-C") <= 4 and "gateway" in shown
    red = [f"\x1b[31m{age}" in shown for age in ("0.4", "5.1", "61.0")]
    assert red == ([False, True, True] if terminal else [False] * 3)


def test_ids_are_written_as_spans() -> None:
    assert [id_ranges(ids) for ids in ((), (3,), (2, 1, 0), (9, 1, 2, 5))] == ["", "3", "0-2", "1-2, 5, 9"]
