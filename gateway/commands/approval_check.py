"""Checks before anything is sent: who approved what, for which aircraft, and whether the situation is still the same.

Every check returns why the approval is refused, or an empty text. An approval of an execution passes only if

    it is new, at most 30 s old, and names a person
    the gateway has received the proposal itself, a valid version of it has this option, and so has the newest
    every changed aircraft may be commanded, is received, armed, flown automatically and not being commanded
    its mission and mode are those of the proposal, and it is within the region predicted for this time with it
"""

from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import numpy as np

from fleet.bus.codec import digest_of
from fleet.contract import Approval, Change, Item, Link, Option, Proposal
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from gateway.commands.autopilot_modes import AUTOMATIC, commanded_modes
from gateway.commands.mission_transfer import check_items
from gateway.commands.region import deviation

MAX_AGE_S = 30.0  # age of an approval; the clocks of a site differ by less [s]
MAX_POSITION_AGE_S = 2.0  # [s]
MAX_SPEED = 400.0  # a larger speed is an error; the autopilot has closer limits of its own [m/s]
MAX_TEXT = 200  # characters of a name

Positions = Mapping[int, tuple[float, np.ndarray]]
"""Newest position by UAV id: time [s since 1970]; latitude, longitude, altitude, (3,) [1e-7 deg, 1e-7 deg, mm]."""


class Situation(NamedTuple):
    """What must not change between a proposal and its execution."""

    items: tuple[Item, ...]  # on board
    published_items: tuple[Item, ...]  # the same as the proposal's computation received them
    mode: str


class ReceivedProposal(NamedTuple):
    """A version of a proposal, and the situation of each changed aircraft when it arrived.

    Attributes:
        proposal: as received
        situations: by UAV id
        earlier: versions before this one that are still valid
    """

    proposal: Proposal
    situations: dict[int, Situation]
    earlier: "tuple[ReceivedProposal, ...]" = ()

    def valid_versions(self, now: float) -> "tuple[ReceivedProposal, ...]":
        """Return all versions that may be approved, the newest first; a withdrawal ends the earlier ones, too."""
        versions = (self._replace(earlier=()), *self.earlier) if self.proposal.options else ()
        return tuple(one for one in versions if now <= one.proposal.valid_until)


class Fleet(NamedTuple):
    """What the checks need to know of the aircraft."""

    aircraft: Mapping[int, AircraftLink]  # by UAV id
    positions: Positions
    is_allowed: Callable[[int], bool]  # whether a UAV may be commanded
    busy: Collection[int]  # UAVs that are being commanded


def situation_of(aircraft: AircraftLink) -> Situation:
    """Return the present situation of an aircraft."""
    return Situation(aircraft.mission.items, aircraft.mission.published_items, aircraft.mode)


def approval_refusal(approval: Approval, now: float, executed: Collection[tuple[str, bool]]) -> str:
    """Return why an approval is refused by itself."""
    if (approval.proposal, approval.undo) in executed:
        return "it was approved before, and each approval is executed once"
    age = now - approval.t
    if not abs(age) <= MAX_AGE_S:
        return f"the approval is {age:.0f} s old, expected at most {MAX_AGE_S:.0f} s; synchronise the clocks"
    if not 0 < len(approval.who.strip()) <= MAX_TEXT:
        return "it names nobody who approved it"
    return ""


def approved_version(
    approval: Approval, received: ReceivedProposal | None, now: float
) -> tuple[ReceivedProposal, Option] | str:
    """Return the version of a proposal that a person has approved and its option, or why there is none.

    A proposal is renewed while a person decides. What was shown may be approved while it is valid, and as long as the
    newest version has the same option, or renewed with its inserted item farther ahead.
    """
    if received is None or received.proposal.uav != approval.uav:
        return "no worker has published this proposal"
    proposal = received.proposal
    if not proposal.options:
        return "the proposal was withdrawn"
    if not now <= proposal.valid_until:
        return f"the proposal expired {now - proposal.valid_until:.0f} s ago"
    if not proposal.t <= now + MAX_AGE_S:
        return "the proposal is from the future; synchronise the clocks"
    for version in received.valid_versions(now):
        option = next((one for one in version.proposal.options if digest_of(one) == approval.digest), None)
        if option is not None and any(is_renewal(option, newer) for newer in proposal.options):
            return version, option
    return "the proposal has no option with the changes that were approved; look at its newest version"


def is_renewal(option: Option, newer: Option) -> bool:
    """Return whether two options have the same changes, except for one item of a mission and for the current item."""
    if [change.uav for change in option.changes] != [change.uav for change in newer.changes]:
        return False
    return all(map(_is_same_change, option.changes, newer.changes))


def _is_same_change(one: Change, other: Change) -> bool:
    if (one.speed, one.mode) != (other.speed, other.mode):
        return False
    if one.items is None or other.items is None:
        return one == other
    different = [a for a, b in zip(one.items, other.items, strict=False) if a != b]
    return len(one.items) == len(other.items) and len(different) <= 1


def change_refusal(change: Change, fleet: Fleet) -> str:
    """Return why a change must not be sent, whatever the situation was before."""
    uav = change.uav
    aircraft = fleet.aircraft.get(uav)
    if not fleet.is_allowed(uav):
        return f"uav-{uav} may not be commanded; start the gateway with --allow commands:{uav}"
    if aircraft is None or aircraft.link is not Link.LIVE or aircraft.source is None:
        return f"uav-{uav} is not received by this gateway"
    if uav in fleet.busy:
        return f"uav-{uav} is being commanded; wait for the end"
    modes = commanded_modes(aircraft.autopilot, aircraft.vehicle)
    if not modes:
        return f"uav-{uav} is a {aircraft.vehicle} with autopilot {aircraft.autopilot}, which is not commanded"
    if not aircraft.armed:
        return f"uav-{uav} is not armed"
    if aircraft.mode not in AUTOMATIC[aircraft.autopilot]:
        return f"uav-{uav} is in mode {aircraft.mode}, in which a person may be flying"
    if change.mode and change.mode not in modes:
        return f"uav-{uav} has no mode to {change.mode} in; expected {', '.join(modes)}"
    if change.speed is not None and not 0 < change.speed < MAX_SPEED:
        return f"uav-{uav}: found speed {change.speed} m/s, expected one between 0 and {MAX_SPEED:.0f}"
    count = len(aircraft.mission.items if change.items is None else change.items)
    if change.seq is not None and not 0 <= change.seq < count:
        return f"uav-{uav}: found item {change.seq}, expected one of {count}"
    if change.items is not None and (problem := check_items(change.items)):
        return f"uav-{uav}: {problem}"
    if change == Change(uav=uav):
        return f"uav-{uav}: found a change without content"
    return ""


def situation_refusal(option: Option, received: ReceivedProposal, fleet: Fleet, now: float) -> str:
    """Return why the situation is no longer that of the proposal.

    Until the approval an aircraft flies its present plan: it is compared with the path predicted for that plan, or
    with that of the option where the proposal has none.
    """
    uavs = [change.uav for change in option.changes]
    if not uavs or len(set(uavs)) < len(uavs):
        return "the option changes no aircraft, or one twice"
    paths = {path.uav: path for path in option.paths} | {path.uav: path for path in received.proposal.present}
    for change in option.changes:
        uav, aircraft = change.uav, fleet.aircraft[change.uav]
        before, present = received.situations.get(uav), situation_of(aircraft)
        if before is None or before.mode != present.mode:
            was = "unknown" if before is None else before.mode
            return f"uav-{uav} is in mode {present.mode}, at the proposal it was {was}"
        is_replaced = aircraft.mission.needs_download and aircraft.autopilot != "px4"  # PX4: also read periodically
        if not aircraft.mission.complete or is_replaced or before.items != present.items:
            return f"uav-{uav}: the mission on board is not the one of the proposal, or not confirmed"
        t, position = fleet.positions.get(uav, (float("-inf"), np.zeros(3)))
        if now - t > MAX_POSITION_AGE_S:
            return f"uav-{uav}: no position for {MAX_POSITION_AGE_S:.0f} s"
        if uav not in paths:
            return f"uav-{uav}: the proposal has no predicted path of it"
        try:
            offset = deviation(paths[uav], t - received.proposal.t, position)
        except ValueError as error:
            return str(error)
        if offset is None:
            return f"uav-{uav}: the predicted path of the proposal has no point for now"
        if not offset.is_inside:
            return f"uav-{uav} is outside of the region predicted for now: {offset}; the situation has changed"
    return ""
