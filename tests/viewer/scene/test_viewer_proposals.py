"""Proposals on the page: sentences and figures of the valid options, their paths as ghost lines, and the approval."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from fleet.contract import Alert, AlertKind, Array, Change, Option, Proposal, ProposedPath
from tests.support.pretend_feed import HOSTILE, STAMP, Clock, T, feed_of
from viewer.panels.proposals import parse_approval, proposals_html
from viewer.scene.selection.ghosts import DASHES, GhostPaths
from viewer.store.proposal import MAX_OPTIONS
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


def test_the_button_sends_what_is_approved(page):
    publish(page, n=1)
    html = shown(page, "send('{}')")
    assert "send('1/5f2c/0')" in html and ">Approve</button>" in html
    assert parse_approval("1/5f2c/0") == (1, "5f2c", 0)
    for text in ("", "1", "1/5f2c", "x/5f2c/0", "1/5f2c/-1", "1/5f 2c/0", "1//0", "9" * 90):
        assert parse_approval(text) is None
