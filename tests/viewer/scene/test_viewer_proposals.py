"""Proposals on the page: sentences and figures of the valid options, their paths as ghost lines, and the approval."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from fleet.bus.codec import digest_of
from fleet.contract import (
    Alert,
    AlertKind,
    Approval,
    Array,
    Change,
    Execution,
    ExecutionState,
    ExecutionStep,
    Option,
    Proposal,
    ProposedPath,
)
from tests.support.pretend_feed import HOSTILE, STAMP, Clock, T, feed_of
from viewer.panels.approval import ApprovalDialog, execution_html, parse_option
from viewer.panels.detail import status_html
from viewer.panels.proposals import proposals_html
from viewer.scene.selection.ghosts import DASHES, GhostPaths
from viewer.store.inbox import time_of_day
from viewer.store.proposal import MAX_OPTIONS
from viewer.text.words import alert_sentence, alerts_html
from viewer.theme.palette import DARK

UAV = 1
AHEAD = np.arange(0.0, 61.0)
ORIGIN = (474_000_000, 85_000_000, 500_000)


def option(k: int, sentence: str = "UAV 1 climbs 40 m: passes 62 m above UAV 2") -> Option:
    path = np.column_stack([20.0 * AHEAD, 0.0 * AHEAD, -100.0 - 30.0 * k + 0.0 * AHEAD])
    tube = np.tile([10.0, 5.0, 4.0], (len(AHEAD), 1))
    ghost = ProposedPath(
        uav=UAV, origin=ORIGIN, ahead=Array.of(AHEAD), path=Array.of(path), prediction_region_half_axes=Array.of(tube)
    )
    figures = {"probability": 0.01, "clearance_m": 62.0, "delay_s": 3.0, "energy": 1.04, "deviation_m": 43.0}
    return Option(sentence=sentence, changes=(Change(uav=UAV, seq=k),), paths=(ghost,), **figures)


class Scene:
    """A scene that keeps its line segments by name."""

    def __init__(self) -> None:
        self.nodes: dict[str, SimpleNamespace] = {}

    def add_line_segments(self, name, points, colors, **_) -> SimpleNamespace:
        self.nodes[name] = SimpleNamespace(points=points, colors=colors, visible=True)
        return self.nodes[name]

    def segments(self) -> np.ndarray:
        (node,) = self.nodes.values()
        points = np.asarray(node.points)
        return points[np.linalg.norm(points[:, 1] - points[:, 0], axis=1) > 0]


@pytest.fixture
def page():
    clock = Clock()
    feed, _, bus = feed_of(clock, 3)
    return feed, bus, clock


def publish(page, n: int = 2, **more) -> Proposal:
    feed, bus, clock = page
    vehicle = feed.get(UAV)
    alert = Alert(uav=UAV, t=T, kind=AlertKind.CONFLICT, other=2, sentence="conflict", probability=0.3)
    bus.publish(alert, STAMP)
    given = {
        "uav": UAV, "t": T, "id": "5f2c", "kind": AlertKind.CONFLICT, "other": 2, "probability": 0.3,
        "options": tuple(option(k) for k in range(n)), "valid_until": vehicle.data_time(clock()) + 10.0,
        "sentence": "uav-1: 30% chance of a conflict with uav-2; 2 options avoid it",
    }  # fmt: skip
    proposal = Proposal(**(given | more))
    bus.publish(proposal, STAMP)
    return proposal


def shown(page, approve: str = "") -> str:
    feed, _, clock = page
    return proposals_html(feed.get(UAV), DARK, clock(), approve=approve)


def test_each_option_is_shown_with_its_figures(page):
    publish(page)
    html = shown(page)
    assert html.count("passes 62 m above UAV 2") == 2 and "2 options avoid it" in html
    assert "62 m clearance · +3 s · energy +4 % · deviation 43 m · risk 30 % → 1 %" in html
    assert DARK.option(1) in html and DARK.option(2) in html and "<button" not in html


def test_options_disappear_with_their_validity_their_withdrawal_and_their_alert(page):
    _, bus, clock = page
    proposal = publish(page)
    clock.now += 11.0
    assert "climbs" not in shown(page)
    publish(page)
    assert "climbs" in shown(page)
    bus.publish(msgspec.structs.replace(proposal, options=(), sentence="uav-1: no longer predicted"), STAMP)
    assert "climbs" not in shown(page) and "no longer predicted" in shown(page)
    publish(page)
    bus.publish(Alert(uav=UAV, t=T + 1, kind=AlertKind.CONFLICT, other=2, active=False), STAMP)
    assert shown(page) == ""


def test_ghost_lines_of_another_dash_and_colour_for_each_option(page):
    feed, _, clock = page
    publish(page, n=3)
    scene = Scene()
    ghosts = GhostPaths(scene, DARK)
    vehicle = feed.get(UAV)
    tags = ghosts.draw(vehicle.open_proposals(), T)
    assert [tag.text for tag in tags] == ["1", "2", "3"] and len(DASHES) == MAX_OPTIONS
    heights = {round(float(z), 2) for z in scene.segments()[:, :, 2].mean(axis=1)}
    assert len(heights) >= 3
    all_three = len(scene.segments())
    assert ghosts.draw(vehicle.open_proposals(), vehicle.data_time(clock()) + 100.0) == []
    assert len(scene.segments()) == 0 < all_three


def test_a_hostile_proposal_is_text_or_rejected(page):
    feed, _, _ = page
    publish(page, sentence=HOSTILE, options=(option(0, sentence=HOSTILE),), id=HOSTILE)
    html = shown(page, "send('{}')")
    assert HOSTILE not in html and "&lt;img" in html and html.count("onclick") == 1
    before = feed.get(UAV).proposals
    broken = msgspec.structs.replace(option(0).paths[0], path=Array.of(np.full((61, 3), np.nan)))
    publish(page, options=(msgspec.structs.replace(option(0), paths=(broken,)),))
    assert feed.get(UAV).proposals == before and "not finite" in feed.get(UAV).refusal[1]


def test_without_approvals_the_page_shows_the_command(page):
    publish(page, n=2)
    html = shown(page)
    assert "fleet approve 5f2c --option 1" in html and "--option 2" in html and "onclick" not in html


def test_the_button_names_the_option(page):
    publish(page, n=1)
    html = shown(page, "send('{}')")
    assert "send('approve/1/5f2c/0')" in html and "fleet approve" not in html
    assert parse_option("1/5f2c/0") == (1, "5f2c", 0)
    for text in ("", "1", "1/5f2c", "x/5f2c/0", "1/5f2c/-1", "1/5f 2c/0", "1//0", "9" * 90):
        assert parse_option(text) is None


class Desk:
    """The approvals of one page, and what they send."""

    def __init__(self, page) -> None:
        self.feed, self.bus, self.clock = page
        self.sent: list[Approval] = []
        self.dialog = ApprovalDialog(self.feed, self.sent.append, "kim")

    def press(self, text: str) -> None:
        self.dialog.on_click(text, self.clock())

    def html(self) -> str:
        return self.dialog.html(self.feed.get(UAV), DARK, self.clock(), "send('{}')")

    @property
    def name(self) -> str:
        return self.dialog.pending.name


def test_an_option_is_sent_after_a_confirmation_that_shows_the_change(page):
    proposal, desk = publish(page, n=2), Desk(page)
    desk.press("approve/1/5f2c/1")
    assert desk.sent == [] and "uav-1: fly to item 1 first" in desk.html() and "valid for 10 s" in desk.html()
    desk.press(f"confirm/{desk.name}")
    (approval,) = desk.sent
    assert (approval.uav, approval.proposal, approval.option, approval.who) == (UAV, "5f2c", 1, "kim")
    assert approval.digest == digest_of(proposal.options[1]) and not approval.undo and approval.t > T
    assert desk.html() == "" and desk.dialog.pending is None


def test_what_is_confirmed_is_what_was_shown(page):
    proposal, desk = publish(page, n=1), Desk(page)
    desk.press("approve/1/5f2c/0")
    publish(page, n=1, options=(option(3),))
    desk.press(f"confirm/{desk.name}")
    assert desk.sent[0].digest == digest_of(proposal.options[0])


def test_nothing_is_sent_without_the_name_of_what_is_shown(page):
    publish(page, n=1)
    desk = Desk(page)
    for text in ("confirm/", "confirm/0123456789abcdef", "approve/1/5f2c/7", "approve/9/5f2c/0", "approve/1/abcd/0",
                 "undo/1", "undo/x", "", "confirm/é", "x" * 500):  # fmt: skip
        desk.press(text)
        assert desk.dialog.pending is None
    desk.press("approve/1/5f2c/0")
    name = desk.name
    desk.press("confirm/" + "0" * len(name))
    assert desk.sent == [] and desk.dialog.pending is not None
    desk.press(f"cancel/{name}")
    desk.press(f"confirm/{name}")
    assert desk.sent == [] and desk.dialog.pending is None


def test_an_expired_option_is_neither_asked_for_nor_sent_by_a_button(page):
    publish(page, n=1)
    desk = Desk(page)
    desk.press("approve/1/5f2c/0")
    desk.clock.now += 11.0
    assert "expired" in desk.html() and ">Send<" not in desk.html() and ">Cancel<" in desk.html()
    desk.press(f"confirm/{desk.name}")  # of a page that is late
    assert desk.sent == [] and "expired" in desk.html()
    desk.press(f"cancel/{desk.name}")
    desk.press("approve/1/5f2c/0")
    assert desk.dialog.pending is None


def test_an_alert_states_the_probability_of_the_proposal_against_it(page):
    """The alert is published once, the proposal again and again."""
    feed, bus, clock = page
    raised = Alert(uav=UAV, t=T, kind=AlertKind.CONFLICT, other=2, sentence="68% chance", probability=0.68)
    bus.publish(raised, STAMP)
    assert alert_sentence(raised, feed.get(UAV), clock()) == f"at {time_of_day(raised.t)}: {raised.sentence}"
    for probability in (0.68, 1.0):
        publish(page, n=1, t=raised.t + 1.0, probability=probability)
        html = status_html(feed.get(UAV), DARK, clock()) + alerts_html([feed.get(UAV)], DARK, clock())
        assert html.count(f"risk {100 * probability:.0f} % with the present plan") == 2
        assert raised.sentence not in html


def execution(state: ExecutionState, uav: int = 2, **fields) -> Execution:
    step = ExecutionStep(uav=UAV, sentence="current item 1", accepted=True, t=T)
    own = {"proposal": "5f2c", "who": "kim", "digest": "ab", "approved_t": T, "steps": (step,), "can_undo": True}
    return Execution(uav=uav, t=T + 1, state=state, **(own | fields))


def test_the_execution_is_shown_and_undone_after_a_confirmation(page):
    feed, bus, _ = page
    desk = Desk(page)
    bus.publish(execution(ExecutionState.ACCEPTED, follows=True, sentence="follows within its region"))
    shown = feed.get(UAV).execution
    html = execution_html(shown, UAV, DARK, "send('{}')")
    assert "Option 1 approved by kim: accepted" in html and "follows within its region" in html
    assert "send('undo/1')" in html and "✓ uav-1: current item 1" in html
    assert "fleet undo 1" in execution_html(shown, UAV, DARK, "")
    desk.press("undo/1")
    assert "uav-1: undo current item 1" in desk.dialog.html(feed.get(2), DARK, desk.clock(), "send('{}')")
    desk.press(f"confirm/{desk.name}")
    (approval,) = desk.sent
    assert approval.undo and (approval.uav, approval.proposal, approval.digest) == (2, "5f2c", "ab")
    bus.publish(execution(ExecutionState.UNDONE, can_undo=False, undo=True, approved_t=T + 5))
    desk.press("undo/1")
    assert desk.dialog.pending is None and "Undo approved by kim" in execution_html(
        feed.get(UAV).execution, 1, DARK, ""
    )


def test_hostile_texts_of_an_execution_are_text(page):
    steps = (ExecutionStep(uav=UAV, sentence=HOSTILE, accepted=False, t=T),)
    message = execution(ExecutionState.FAILED, who=HOSTILE, sentence=HOSTILE, steps=steps)
    html = execution_html(message, UAV, DARK, "send('{}')")
    assert HOSTILE not in html and html.count("&lt;img") == 3


def test_a_missing_gateway_is_reported(page):
    publish(page, n=1)
    desk = Desk(page)
    desk.press("approve/1/5f2c/0")
    desk.press(f"confirm/{desk.name}")
    desk.clock.now += 6.0
    assert "No gateway has answered" in desk.html()
    desk.bus.publish(execution(ExecutionState.REFUSED, uav=UAV, approved_t=desk.sent[0].t))
    assert "No gateway" not in desk.html()
