"""Sentences of the scene of two aircraft that meet: alert, proposals, approval, and what came of it."""

import numpy as np
import pytest

from fleet.cli import main
from fleet.contract import (
    Alert,
    AlertKind,
    Array,
    Change,
    Execution,
    ExecutionState,
    Option,
    Proposal,
    Rows,
    Sample,
)
from fleet.frames import Origin, to_geodetic
from fleet.report.story import ConflictStory

T = 1_700_000_000.0
HOME = Origin(474_000_000, 85_000_000, 450_000)
MEET_S = 30.0


def alert(active: bool = True) -> Alert:
    return Alert(
        uav=0, t=T, kind=AlertKind.CONFLICT, other=1, active=active, sentence="conflict in 30 s", predicted_t=T + MEET_S
    )


def proposal(name: str = "1a2b3c4d5e6f") -> Proposal:
    option = Option(
        sentence="UAV 0 climbs 40 m", changes=(Change(uav=0, seq=2),), paths=(), probability=0.01, clearance_m=41.0
    )
    return Proposal(uav=0, t=T, id=name, kind=AlertKind.CONFLICT, other=1, options=(option,), sentence="one option")


def execution(state: ExecutionState, **fields) -> Execution:
    return Execution(uav=0, t=T + 5, proposal="1a2b3c4d5e6f", state=state, who="kim", approved_t=T + 5, **fields)


def fly(story: ConflictStory, above: float, aside: float = 0.0, seconds: float = 60.0) -> None:
    """Two aircraft cross at MEET_S, one of them `above` the other and `aside` [m]."""
    for start in np.arange(0.0, seconds, 1.0):
        t = start + np.arange(10) * 0.1
        s, zero = 20.0 * (t - MEET_S), np.zeros(10)
        for uav, ned in enumerate(((s, zero, zero - 100.0), (zero + aside, s, zero - 100.0 - above))):
            x = to_geodetic(HOME, np.column_stack(ned)).astype(np.int64)
            story.on_sample(
                Sample(uav=uav, t=T + float(t[-1]), position=Rows(Array.of(T + t, "<f8"), Array.of(x, "<f8")))
            )


def test_the_scene_is_told_from_the_alert_to_the_avoided_conflict() -> None:
    story = ConflictStory("http://127.0.0.1:8080", " --router tcp/127.0.0.1:7")
    story.begin()
    fly(story, above=0.0)
    assert len(story.sentences) == 1 and not story.ended, "without an alert nothing is measured"
    story.on_alert(alert())
    story.on_proposal(proposal())
    story.on_proposal(proposal())
    story.on_execution(execution(ExecutionState.APPROVED))
    story.on_execution(execution(ExecutionState.ACCEPTED, follows=True, sentence="follows within its region"))
    story.on_execution(execution(ExecutionState.ACCEPTED, follows=True, sentence="follows within its region"))
    fly(story, above=41.0)
    text = "\n".join(story.sentences)
    assert [f"step {k} of 5" in text for k in range(1, 6)] == [True] * 5
    assert "fleet approve 1a2b3c4d --option 1 --router tcp/127.0.0.1:7" in text and "press Approve" in text
    assert "option 1: UAV 0 climbs 40 m" in text and "approved by kim" in text
    assert text.count("follows within its region") == 1
    assert "was avoided: UAV 0 and UAV 1 passed 0 m apart horizontally and 41 m vertically" in text


@pytest.mark.parametrize(("aside", "result"), [(10.0, "was not avoided"), (80.0, "without an approval")])
def test_what_happens_without_an_approval_is_told_as_it_is(aside: float, result: str) -> None:
    story = ConflictStory()
    story.begin()
    story.on_alert(alert())
    story.on_proposal(proposal())
    fly(story, above=0.0, aside=aside)
    assert story.ended and result in story.sentences[-1] and "http" not in "".join(story.sentences)


def test_a_refusal_is_told_and_other_executions_are_not() -> None:
    story = ConflictStory()
    story.on_proposal(proposal())
    story.on_execution(execution(ExecutionState.REFUSED, sentence="the proposal expired 2 s ago"))
    assert "refused: the proposal expired 2 s ago" in story.sentences[-1]
    count = len(story.sentences)
    story.on_execution(Execution(uav=0, t=T, proposal="other", state=ExecutionState.APPROVED, who="kim"))
    assert len(story.sentences) == count


@pytest.mark.parametrize(
    "arguments",
    [
        ("up", "--story", "conflict", "--link", "udpin:0.0.0.0:14550"),
        ("up", "--story", "conflict", "--uavs", "1"),
        ("fly", "--story", "conflict", "--uavs", "3-5"),
        ("fly", "--story", "conflict", "--aircraft", "quad"),
    ],
)
def test_commands_are_allowed_for_simulated_aircraft_only(arguments: tuple[str, ...], capsys) -> None:
    assert main(list(arguments)) == 2
    assert "--story: found" in capsys.readouterr().err


def test_the_scene_ends_although_an_aircraft_stops_sending() -> None:
    story = ConflictStory()
    story.begin()
    story.on_alert(alert())
    for second in range(int(MEET_S) + 120):
        t = second + np.arange(0.0, 1.0, 0.1)
        x = to_geodetic(HOME, np.column_stack([t, t, -t])).astype(np.int64)
        rows = Rows(Array.of(T + t, "<f8"), Array.of(x, "<f8"))
        for uav in (0,) if second > 5 else (0, 1):
            story.on_sample(Sample(uav=uav, t=T + float(t[-1]), position=rows))
    assert story.ended and "UAV 1 sent no positions" in story.sentences[-1]
    assert not any(story._positions.values())
