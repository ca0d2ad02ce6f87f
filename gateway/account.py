"""The counters of one gateway, gathered from its links once a second."""

from collections import Counter
from collections.abc import Sequence

from fleet.contract import Account
from fleet.telemetry.heard import Heard
from fleet.telemetry.intake import Intake
from gateway.link import Link


class Tally:
    """Count what arrives, before anything is decoded."""

    def __init__(self) -> None:
        self.datagrams = 0
        self.bytes_in = 0

    def add(self, heard: Heard) -> None:
        """Count pieces of bytes."""
        self.datagrams += len(heard.start)
        self.bytes_in += int((heard.stop - heard.start).sum())

    def account(self, t: float, links: Sequence[Link], intakes: Sequence[Intake], players: set[int]) -> Account:
        """Make the message; `t` is fleet time [s since 1970], `players` the UAV ids of recordings."""
        counts: Counter[str] = Counter()
        refused: Counter[str] = Counter()
        uavs = set(players)
        for link, intake in zip(links, intakes, strict=True):
            counts.update(intake.counters())
            refused.update(intake.refused)
            uavs.update(craft.uav for craft in intake.crafts.values())
            if link.dropped:
                refused["dropped: decoding fell behind"] += link.dropped
            if link.unsent:
                refused["not sent: nobody at the far end, or no room"] += link.unsent
        return Account(
            t=t,
            links=tuple(link.spec.text for link in links),
            uavs=tuple(sorted(uavs)),
            datagrams=self.datagrams,
            bytes_in=self.bytes_in,
            messages=counts["messages"],
            bad_bytes=counts["bad_bytes"],
            bad_frames=counts["bad_frames"] + counts["unknown"],
            refused=dict(refused),
            sentence="" if uavs else "no aircraft heard yet; point its telemetry at one of the links",
        )
