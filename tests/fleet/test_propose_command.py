"""`fleet propose`: a table of options, JSON, and the messages without a proposal or without a worker."""

import json
from contextlib import nullcontext

import msgspec
import pytest

from fleet.cli import main
from fleet.commands.live import propose as command
from fleet.contract import FleetState, Proposal
from tests.support.examples import EXAMPLES
from tests.support.memory_bus import MemoryBus

PROPOSAL: Proposal = EXAMPLES[Proposal]


@pytest.fixture
def bus(monkeypatch) -> MemoryBus:
    bus = MemoryBus()
    monkeypatch.setattr(command, "connect", lambda _: nullcontext(bus))
    return bus


def serve(bus: MemoryBus, *proposals: Proposal) -> None:
    bus.declare_queryable(Proposal, lambda uav, *_: [(p, None) for p in proposals])
    bus.declare_queryable(FleetState, lambda *_: [(FleetState(t=1.0), None)])


def test_options_are_a_table(bus, capsys):
    serve(bus, PROPOSAL)
    assert main(["propose"]) == 0
    out = capsys.readouterr().out
    (option,) = PROPOSAL.options
    assert option.sentence in out and PROPOSAL.sentence in out and PROPOSAL.id in out
    row = next(line for line in out.splitlines() if option.sentence in line)
    assert f"{PROPOSAL.probability:.0%} > {option.probability:.0%}" in row and f"{option.clearance_m:.0f}" in row


def test_json_has_positions_and_the_changes(bus, capsys):
    serve(bus, PROPOSAL)
    assert main(["propose", str(PROPOSAL.uav), "--json"]) == 0
    (read,) = json.loads(capsys.readouterr().out)
    (option,), (path,) = read["options"], read["options"][0]["paths"]
    assert read["id"] == PROPOSAL.id and option["changes"][0]["uav"] == PROPOSAL.options[0].changes[0].uav
    assert len(path["places"]) == len(path["ahead"]) == PROPOSAL.options[0].paths[0].ahead.shape[0]
    assert all(abs(lat) <= 90.0 for lat, _, _ in path["places"])


def test_nothing_to_propose_is_no_error(bus, capsys):
    serve(bus)
    assert main(["propose"]) == 0 and "nothing is predicted" in capsys.readouterr().out
    assert main(["propose", "--json"]) == 0 and json.loads(capsys.readouterr().out) == []


def test_a_proposal_without_options_is_its_sentence(bus, capsys):
    serve(bus, msgspec.structs.replace(PROPOSAL, options=(), sentence="uav-7: no change avoids it"))
    assert main(["propose", str(PROPOSAL.uav)]) == 0
    assert capsys.readouterr().out.strip() == "uav-7: no change avoids it"


@pytest.mark.parametrize("words", [(), ("9",)])
def test_without_a_worker_the_exit_code_is_1(bus, capsys, words):
    assert main(["propose", *words]) == 1
    assert "found no worker that replies" in capsys.readouterr().err


def test_words_that_are_no_ids_are_refused():
    with pytest.raises(SystemExit) as ended:
        main(["propose", "north"])
    assert ended.value.code == 2
