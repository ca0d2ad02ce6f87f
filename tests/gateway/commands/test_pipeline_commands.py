"""Commands through the whole gateway, and its options: off by default, an operator's role, no half-hearted mixtures."""

from collections import Counter
from pathlib import Path

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.access.entry import BusConfig
from fleet.contract import Execution, ExecutionState, Mission
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from gateway import __main__ as gateway
from gateway import pipeline as pipeline_module
from gateway.commands.audit import AuditLog
from gateway.links.link import Batch
from gateway.pipeline import Pipeline
from tests.support.commanded import T0, CommandedAircraft, CommandSite, mission, raised
from tests.support.fake_link import FakeLink
from tests.support.memory_bus import MemoryBus


class LiveGateway(CommandSite):
    """The same site with a whole pipeline, which requests mission and parameters itself."""

    def __init__(self, folder: Path, aircraft: CommandedAircraft, *, commands: bool, listen_only: bool = False) -> None:
        self.bus, self.aircraft, self.t, self.link = MemoryBus(), aircraft, 0.0, FakeLink()
        self.executions, self.missions = [], []
        self.bus.subscribe(Execution, lambda message, _: self.executions.append(message))
        self.bus.subscribe(Mission, lambda message, _: self.missions.append(message))
        self.pipeline = Pipeline([self.link], self.bus, listen_only)
        self.audit = AuditLog(folder / "commands.jsonl")
        if commands:
            self.pipeline.enable_commands(self.bus, range(9).__contains__, self.audit)
        self.run(6.0)

    def run(self, seconds: float) -> list[Execution]:
        before = len(self.executions)
        for _ in range(round(seconds * 10)):
            self.t = round(self.t + 0.1, 1)
            uplink = [data for _, data in self.link.sent]
            self.link.sent.clear()
            frames = self.aircraft.tick(self.t, uplink)
            received = ReceivedBytes.from_pieces([(self.now, "radio", frame) for frame in frames])
            self.pipeline.take(Batch(0, received))
            self.pipeline._tick(self.t)
        return self.executions[before:]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch):
    """Fleet time of the gateway: that of the site."""
    sites: list[LiveGateway] = []
    monkeypatch.setattr(pipeline_module, "wall", lambda: T0 + (sites[-1].t if sites else 0.0))
    original = LiveGateway.run

    def run(site: LiveGateway, seconds: float):
        if site not in sites:
            sites.append(site)
        return original(site, seconds)

    monkeypatch.setattr(LiveGateway, "run", run)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_an_approved_mission_passes_the_whole_gateway(autopilot: str, clock: None, tmp_path: Path) -> None:
    aircraft = CommandedAircraft(autopilot, loss=0.05, seed=2)
    site = LiveGateway(tmp_path, aircraft, commands=True)
    assert site.missions[-1].complete
    published = site.missions[-1].items
    items = tuple(msgspec.structs.replace(item, alt_m=item.alt_m + 30.0) for item in published)
    proposal = site.propose(site.option(items=items, speed=17.0))
    site.bus.publish(site.approval(proposal))
    assert site.run(20.0)[-1].state == ExecutionState.ACCEPTED
    assert [item.alt_m for item in aircraft.items[1:]] == pytest.approx([item.alt_m for item in raised(mission())][1:])
    assert site.missions[-1].items[1:] == items[1:], "the gateway publishes the mission that is on board"
    names = Counter(message.get_type() for message in aircraft.received)
    assert names["MISSION_COUNT"] >= 1 and names["HEARTBEAT"] > 10, "the rest of its work goes on"
    sequence = [message.get_seq() for message in aircraft.received if message.get_srcSystem() == 254]
    assert len(set(sequence)) > len(sequence) // 2, "one sequence of numbers for requests and commands"


def commands_of(aircraft: CommandedAircraft) -> list:
    harmless = (mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAV_CMD_REQUEST_MESSAGE)
    names = ("MISSION_COUNT", "MISSION_ITEM_INT", "SET_MODE", "MISSION_SET_CURRENT", "COMMAND_INT", "PARAM_SET")
    return [
        message
        for message in aircraft.received
        if message.get_type() in names or (message.get_type() == "COMMAND_LONG" and message.command not in harmless)
    ]


def test_without_approval_a_gateway_that_allows_commands_sends_the_same_bytes(clock: None, tmp_path: Path) -> None:
    """The same flight with commands off, and on with a proposal that nobody approves."""
    counts = []
    for commands in (False, True):
        (folder := tmp_path / str(commands)).mkdir(mode=0o700)
        aircraft = CommandedAircraft()
        site = LiveGateway(folder, aircraft, commands=commands)
        site.propose(site.option(items=raised(mission()), speed=17.0, mode="return"), valid_s=60.0)
        site.run(20.0)
        assert commands_of(aircraft) == []
        counts.append(aircraft.uplink_bytes)
    assert counts[0] == counts[1] > 0


def test_off_by_default_and_never_when_it_only_listens(clock: None, tmp_path: Path) -> None:
    for k, given in enumerate(({"commands": False}, {"commands": True, "listen_only": True})):
        (folder := tmp_path / str(k)).mkdir(mode=0o700)
        aircraft = CommandedAircraft()
        site = LiveGateway(folder, aircraft, **given)
        site.bus.publish(site.approval(site.propose(site.option(speed=17.0))))
        site.run(5.0)
        assert commands_of(aircraft) == [] and not site.executions


# --- options ---------------------------------------------------------------------------------------------------------


class Parsed(Exception):
    """The options of a command line."""


def options(monkeypatch: pytest.MonkeyPatch, *words: str):
    def stop(name: str, run, args):
        raise Parsed(args)

    monkeypatch.setattr(gateway, "run_command", stop)
    with pytest.raises(Parsed) as caught:
        gateway.main(list(words))
    return caught.value.args[0]


@pytest.mark.parametrize(("text", "inside"), [("commands", 900), ("commands:0-9", 9), ("commands:7", 7)])
def test_aircraft_that_may_be_commanded(text: str, inside: int, monkeypatch: pytest.MonkeyPatch) -> None:
    allowed = options(monkeypatch, "--allow", text).allow
    assert inside in allowed and (text == "commands" or 10 not in allowed)
    assert options(monkeypatch).allow is None, "off by default"


@pytest.mark.parametrize("text", ["everything", "commands:x", "commands:9-0", "command", "commands:"])
def test_what_is_not_allowed_that_way_is_wrong_use(text: str, capsys) -> None:
    with pytest.raises(SystemExit, match="2"):
        gateway.main(["--allow", text])
    assert "expected" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "at", "expected"),
    [
        (("--dry-run",), "tcp/127.0.0.1:7447", "no --allow commands"),
        (("--audit", "x"), "tcp/127.0.0.1:7447", "no --allow commands"),
        (("--allow", "commands", "--listen-only"), "tcp/127.0.0.1:7447", "--listen-only as well"),
        (("--allow", "commands"), "tcp/10.0.0.1:7447", "without certificates or passwords"),
    ],
)
def test_options_that_disagree_are_refused(words: tuple, at: str, expected: str, monkeypatch) -> None:
    with pytest.raises(ValueError, match=expected):
        gateway.check_commands(options(monkeypatch, *words), BusConfig(at))


def test_on_loopback_without_roles_a_warning_says_who_could_approve(monkeypatch, caplog, tmp_path: Path) -> None:
    allowed = options(monkeypatch, "--allow", "commands")
    gateway.check_commands(allowed, BusConfig())
    assert "every process of this machine can approve" in caplog.text
    caplog.clear()
    gateway.check_commands(allowed, BusConfig("tcp/10.0.0.1:7447", passwords=tmp_path / "words"))
    gateway.check_commands(allowed, BusConfig("tls/10.0.0.1:7447", certificates=tmp_path))
    assert not caplog.text
