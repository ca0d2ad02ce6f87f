"""Attempts to have commands executed that nobody rightfully approved; uploads over a radio that loses frames; undo.

Each attempt is made beside a rightful approval of the same aircraft, which must be executed. Simulated time, no router:
who may publish an approval is tried in `role`.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleet.bus.codec import digest_of
from fleet.contract import Alert, AlertKind, Approval, Change, ExecutionState, Option, Proposal
from gateway.commands.mission_transfer import RawItem, planned_items
from gateway.commands.steps import MissionCommand
from tests.support.commanded import CommandedAircraft, CommandSite, StepDriver, mission, raised
from tests.support.pretend_feed import STAMP, Clock, T, feed_of
from viewer.panels.approval import ApprovalDialog

from .trying import Admitted

ROUNDS = 40  # attempts of each kind: 200 in all
UPLOADS = 50  # of each autopilot
EXECUTIONS = 20
LOSS = 0.1  # of the frames in each direction
AUTOPILOTS = ("ardupilot", "px4")


def lossy_uploads() -> str:
    """100 uploads over 10 % loss in both directions: all right by an independent look, none half-done."""
    slowest = 0.0
    for autopilot in AUTOPILOTS:
        for seed in range(1_000, 1_000 + UPLOADS):
            aircraft = CommandedAircraft(autopilot, loss=LOSS, seed=seed, n=8 + seed % 12)
            before, items = aircraft.items, raised(mission(6 + seed % 15), by=5.0 + seed % 50)
            plan = partial(planned_items, items, reported=before, is_px4=aircraft.is_px4)
            expected = [RawItem.from_item(item, item.param4) for item in items]
            has_home = not aircraft.is_px4
            step = MissionCommand((1, 1), plan, expected, current=lambda _: 2, active_seq=2, has_home=has_home)
            driver = StepDriver(aircraft)
            result = driver.run(step)
            slowest = max(slowest, driver.t)
            stored = [(item.lat_e7, item.lon_e7, item.alt_m) for item in aircraft.items[1:]]
            if not result.accepted or stored != [(item.lat_e7, item.lon_e7, item.alt_m) for item in items[1:]]:
                raise Admitted(f"{autopilot}, seed {seed}: {result.sentence}")
    return f"{2 * UPLOADS} of {2 * UPLOADS} right, slowest {slowest:.0f} s of simulated time"


def _attempts(attempt: Callable[[CommandSite, int], None]) -> str:
    """Make an attempt `ROUNDS` times; not one byte may be sent, the audit must know, and the rightful one works."""
    for k in range(ROUNDS):
        with tempfile.TemporaryDirectory() as folder:
            site = CommandSite(Path(folder), CommandedAircraft(AUTOPILOTS[k % 2]))
            attempt(site, k)
            site.run(3.0)
            published = site.executions
            if site.aircraft.uplink_bytes or any(one.state is not ExecutionState.REFUSED for one in published):
                raise Admitted(f"round {k}: {[one.state.value for one in published]}")
            if site.events() != ["refused"] * len(published):
                raise Admitted(f"round {k}: the audit has {site.events()}")
            site.aircraft.offset[:] = 0.0
            site.run(2.0)
            proposal = site.propose(site.option(speed=17.0), name="rightful")
            site.bus.publish(site.approval(proposal))
            if (states := [one.state for one in site.run(4.0)])[-1:] != [ExecutionState.ACCEPTED]:
                raise Admitted(f"round {k}: the rightful approval was not executed ({states}), so nothing was tried")
    return f"0 of {ROUNDS} executed, each rightful one was"


def forged_approvals() -> str:
    """Approvals of no proposal, with other changes, of another aircraft's proposal, without a name, of an undo."""

    def attempt(site: CommandSite, k: int) -> None:
        proposal = site.propose(site.option(speed=15.0 + k % 5))
        forged: tuple[dict[str, Any], ...] = (
            {"proposal": f"{k:016x}"},
            {"digest": f"{k:064x}"},
            {"digest": site.approval(site.propose(site.option(speed=25.0), name="other")).digest},
            {"who": ""},
            {"undo": True},
        )
        site.bus.publish(site.approval(proposal, **forged[k % len(forged)]))

    return _attempts(attempt)


def replayed_approvals() -> str:
    """The same approval again, and after a restart of the gateway."""
    executed = 0
    for k in range(ROUNDS):
        with tempfile.TemporaryDirectory() as folder:
            site = CommandSite(Path(folder), CommandedAircraft(AUTOPILOTS[k % 2]))
            approval = site.approval(site.propose(site.option(speed=17.0), name=f"p{k}"))
            site.bus.publish(approval)
            if site.run(4.0)[-1].state is not ExecutionState.ACCEPTED:
                raise Admitted("the rightful one was not executed, so nothing was tried")
            if k % 4 >= 2:
                site = CommandSite(Path(folder), CommandedAircraft(AUTOPILOTS[k % 2]))
                site.propose(site.option(speed=17.0), name=f"p{k}")
                approval = msgspec.structs.replace(approval, t=site.now)
            sent = site.aircraft.uplink_bytes
            site.bus.publish(approval)
            site.run(3.0)
            executed += site.aircraft.uplink_bytes != sent
    if executed:
        raise Admitted(f"{executed} of {ROUNDS} were executed again")
    return f"0 of {ROUNDS} executed again, each was once"


def expired_approvals() -> str:
    """Approvals of expired and withdrawn proposals, and approvals that are too old or from the future."""

    def attempt(site: CommandSite, k: int) -> None:
        proposal = site.propose(site.option(speed=17.0), valid_s=2.0 if k % 4 == 0 else 60.0)
        if k % 4 == 0:
            site.run(2.5)
        elif k % 4 == 1:
            site.propose()
        age = {2: 31.0 + k, 3: -31.0 - k}.get(k % 4, 0.0)
        site.bus.publish(site.approval(proposal, t=site.now - age))

    return _attempts(attempt)


def unapproved_proposals() -> str:
    """Proposals that nobody approves, and floods of them."""

    def attempt(site: CommandSite, k: int) -> None:
        for n in range(1 + k):
            site.propose(site.option(speed=17.0, items=raised(mission()), mode="return"), name=f"p{n}", valid_s=60.0)

    return _attempts(attempt)


def outdated_approvals() -> str:
    """Approvals after the aircraft has left the region, or its mode or mission has changed."""
    directions = np.vstack([np.eye(3), -np.eye(3)])

    def attempt(site: CommandSite, k: int) -> None:
        proposal, aircraft = site.propose(site.option(speed=17.0), valid_s=60.0), site.aircraft
        mode, items = aircraft.mode, aircraft.items
        if k % 4 == 0:
            aircraft.mode = "LOITER"
        elif k % 4 == 1:
            aircraft.endpoint.missions.items = raised(items, by=5.0 + k)
            site.receiver.aircraft[1].mission.needs_download = True
            site.download()
        else:
            aircraft.offset = (20.0 + k) * directions[k % 6]
        site.run(1.5)
        site.bus.publish(site.approval(proposal))
        site.run(0.2)
        aircraft.mode, aircraft.endpoint.missions.items = mode, items
        if k % 4 == 1:
            site.receiver.aircraft[1].mission.needs_download = True
            site.download()

    return _attempts(attempt)


def audited_and_undone() -> str:
    """Executions over 10 % loss: the audit has every message that arrived, and the undo restores everything."""
    messages = 0
    for k in range(EXECUTIONS):
        with tempfile.TemporaryDirectory() as folder:
            aircraft = CommandedAircraft(AUTOPILOTS[k % 2], loss=LOSS, seed=2_000 + k)
            site = CommandSite(Path(folder), aircraft)
            before = (aircraft.items, aircraft.speed, aircraft.seq, aircraft.mode)
            proposal = site.propose(site.option(items=raised(mission()), speed=16.0, mode="hold"))
            site.bus.publish(site.approval(proposal))
            while not (done := site.run(1.0)) or not done[-1].can_undo:
                if site.t > 300.0:
                    raise Admitted(f"round {k}: not executed")
            if (aircraft.items, aircraft.mode) == (before[0], before[3]):
                raise Admitted(f"round {k}: nothing was changed, so nothing was tried")
            site.bus.publish(site.approval(proposal, undo=True))
            while not (done := site.run(1.0)) or done[-1].state is not ExecutionState.UNDONE:
                if site.t > 600.0:
                    raise Admitted(f"round {k}: not undone")
            if (aircraft.items, aircraft.speed, aircraft.seq, aircraft.mode) != before:
                raise Admitted(f"round {k}: {aircraft.speed}, {aircraft.seq}, {aircraft.mode} after the undo")
            sent = [one["message"]["mavpackettype"] for one in site.entries() if one["event"] == "sent"]
            arrived = iter(sent)
            if not all(message.get_type() in arrived for message in aircraft.received):
                raise Admitted(f"round {k}: a message arrived that the audit does not have")
            messages += len(sent)
    return f"{EXECUTIONS} of {EXECUTIONS} undone, {messages} messages sent, all in the audit"


def page_without_confirmation() -> str:
    """Texts of a foreign script into the input of a page that may approve: guessed, replayed, cancelled, of others."""
    for k in range(ROUNDS):
        clock = Clock()
        feed, _, bus = feed_of(clock, 3)
        sent: list[Approval] = []
        dialog = ApprovalDialog(feed, sent.append, "kim")
        bus.publish(Alert(uav=1, t=T, kind=AlertKind.CONFLICT, other=2), STAMP)
        option = Option(sentence="", changes=(Change(uav=1, seq=k),), paths=(), probability=0.0, clearance_m=60.0)
        given = {"kind": AlertKind.CONFLICT, "other": 2, "valid_until": feed.get(1).data_time(clock()) + 15.0}
        bus.publish(Proposal(uav=1, t=T, id="a1", options=(option,), **given), STAMP)
        dialog.on_click("approve/1/a1/0", clock())
        name = dialog.pending.name if dialog.pending is not None else ""
        guesses = [f"confirm/{guess}" for guess in ("", f"{k:016x}", name[:-1], name + "0", name.upper() + " ")]
        for text in (*guesses, "undo/1", "confirm/a1", "confirm/1/a1/0", f"approve/2/a1/{k}", f"send/{name}"):
            dialog.on_click(text, clock())
            if dialog.pending is None or dialog.pending.name != name:
                dialog.on_click("approve/1/a1/0", clock())
                name = dialog.pending.name if dialog.pending is not None else ""
        if sent or not name:
            raise Admitted(f"round {k}: {len(sent)} sent, asked for: {bool(name)}")
        dialog.on_click(f"cancel/{name}", clock())
        dialog.on_click(f"confirm/{name}", clock())
        if sent:
            raise Admitted(f"round {k}: sent after it was cancelled")
        dialog.on_click("approve/1/a1/0", clock())
        dialog.on_click(f"confirm/{dialog.pending.name}", clock())  # type: ignore[union-attr]
        if [one.digest for one in sent] != [digest_of(option)]:
            raise Admitted(f"round {k}: the rightful one was not sent, so nothing was tried")
    return f"0 of {11 * ROUNDS} sent, each rightful one was"


BY_COMMAND: tuple[Callable[[], str], ...] = (
    *(lossy_uploads, forged_approvals, replayed_approvals, expired_approvals),
    *(unapproved_proposals, outdated_approvals, audited_and_undone, page_without_confirmation),
)
