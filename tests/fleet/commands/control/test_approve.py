"""`fleet approve` and `fleet undo`: what is shown, what is asked, what is printed, and the exit code."""

import argparse
import time
from pathlib import Path
from typing import Any

import pytest

from fleet.commands.control import approve, undo
from fleet.contract import Approval, Mission, Proposal
from tests.support.commanded import CommandedAircraft, CommandSite, mission, raised


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CommandSite:
    """A site whose gateway works off every approval at once; the clock of the person is its own."""
    site = CommandSite(tmp_path, CommandedAircraft())
    site.bus.declare_queryable(Mission, lambda *_: [(Mission(uav=1, t=site.now, items=mission()), None)])
    site.bus.subscribe(Approval, lambda *_: site.run(9.0))
    monkeypatch.setattr(time, "time", lambda: site.now)
    return site


def options(**given: Any) -> argparse.Namespace:
    return argparse.Namespace(**({"id": "p", "option": 1, "yes": True, "who": None, "uav": 1} | given))


def offer(site: CommandSite, *offered) -> Proposal:
    proposal = site.propose(*offered)
    site.bus.declare_queryable(Proposal, lambda *_: [(proposal, None)])
    return proposal


def test_an_approval_shows_what_is_sent_and_prints_the_steps(site: CommandSite, capsys) -> None:
    offer(site, site.option(speed=15.0), site.option(items=raised(mission()), seq=3, speed=17.0, mode="return"))
    assert approve.approve(site.bus, options(option=2, who="Kim\x1b Lee")) == 0
    out = capsys.readouterr().out
    assert "uav-1: upload a mission of 10 items: the present one has 10, new or changed are 1, 2, 3" in out
    assert "uav-1: fly to item 3 first" in out and "uav-1: change the mode: return" in out and "valid for 15 s" in out
    assert out.count("  ok     uav-1: ") == 4 and "read back and compared" in out
    assert out.endswith("accepted: all steps acknowledged; to restore the plan from before: fleet undo 1\n")
    assert site.entries()[0]["who"] == "Kim? Lee"
    assert undo.undo(site.bus, options()) == 0
    out = capsys.readouterr().out
    assert "undo mission of 10 items" in out and out.endswith("undone: the plan from before is restored\n")
    assert undo.undo(site.bus, options()) == 1
    assert "one that cannot be undone (undone)" in capsys.readouterr().err


def test_a_refused_approval_is_exit_code_1_with_the_reason(site: CommandSite, capsys) -> None:
    offer(site, site.option(speed=17.0))
    site.run(20.0)
    assert approve.approve(site.bus, options()) == 1
    captured = capsys.readouterr()
    assert "expired: a gateway will refuse it" in captured.out and "refused: the proposal expired" in captured.err
    assert site.aircraft.uplink_bytes == 0


@pytest.mark.parametrize("answer", ["n", "", "yeah", None])
def test_without_a_clear_yes_nothing_is_approved(site: CommandSite, answer, monkeypatch, capsys) -> None:
    def answered(_: str) -> str:
        if answer is None:
            raise EOFError
        return answer

    monkeypatch.setattr("builtins.input", answered)
    offer(site, site.option(speed=17.0))
    assert approve.approve(site.bus, options(yes=False)) == 1
    assert "nothing is sent" in capsys.readouterr().out
    site.run(2.0)
    assert not site.executions and site.aircraft.uplink_bytes == 0
    monkeypatch.setattr("builtins.input", lambda _: "Y")
    assert approve.approve(site.bus, options(yes=False)) == 0


def test_a_site_without_a_gateway_that_allows_commands_says_so(site: CommandSite, monkeypatch, capsys) -> None:
    proposal = offer(site, site.option(speed=17.0))
    approval = site.approval(proposal)
    monkeypatch.setattr(approve, "ANSWER_S", 0.05)
    site.receiver._id_owners.clear()
    assert approve.send_approval(site.bus, approval) == 1
    assert "start the gateway of this aircraft with --allow commands" in capsys.readouterr().err


def test_ids_and_options_are_found_or_named(site: CommandSite, capsys) -> None:
    proposal = offer(site, site.option(speed=17.0))
    with pytest.raises(ValueError, match=r"found no proposal that begin with 'x', expected one of p1"):
        approve.approve(site.bus, options(id="x"))
    with pytest.raises(ValueError, match=r"found 2, expected 1 to 1 of proposal p1"):
        approve.approve(site.bus, options(option=2))
    assert approve.find_proposal([proposal], "p1") is proposal
    with pytest.raises(ValueError, match="expected one of none at all"):
        approve.find_proposal([], "p1")
    assert undo.undo(site.bus, options(uav=5)) == 1
    assert "no execution of it" in capsys.readouterr().err
