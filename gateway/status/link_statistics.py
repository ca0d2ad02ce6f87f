"""Statistics of one gateway, collected from its links once a second."""

import platform
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from fleet import SOURCES
from fleet.contract import Account, LinkAccount
from fleet.telemetry.mavlink.intake import Intake
from fleet.telemetry.mavlink.parsing.received import Heard
from gateway.links.link import Link
from gateway.onboard.rates import Share
from gateway.publication.router_session import Way
from gateway.record.recorder import Recorder, Taped

SMOOTH = 0.3  # weight of the newest second in a rate
_SYSTEM_S_COUNT = (Path("/proc/net/udp"), Path("/proc/net/udp6"))


class _Flow:
    """Traffic counters and rates of one link."""

    def __init__(self) -> None:
        self.datagrams = self.bytes_in = self.sent = self.bytes_out = 0
        self.bytes_s = self.messages_hz = 0.0
        self._then = (float("-inf"), 0, 0)

    def measure(self, t: float, messages: int) -> None:
        """Update the rates at `t` [s since 1970]."""
        before, bytes_in, heard = self._then
        passed = t - before
        self._then = (t, self.bytes_in, messages)
        if 0 < passed < float("inf"):
            self.bytes_s += SMOOTH * ((self.bytes_in - bytes_in) / passed - self.bytes_s)
            self.messages_hz += SMOOTH * ((messages - heard) / passed - self.messages_hz)


class Tally:
    """Counters of bytes received, before decoding, and of bytes sent."""

    def __init__(self, links: Sequence[Link], recorder: Recorder | None = None) -> None:
        self._links, self._recorder = links, recorder
        self._flows = [_Flow() for _ in links]
        self._overruns: dict[int, int] = {}

    def add(self, link: int, heard: Heard) -> None:
        """Count received bytes of a link."""
        flow = self._flows[link]
        flow.datagrams += len(heard.start)
        flow.bytes_in += int((heard.stop - heard.start).sum())

    def sent(self, link: int, size: int) -> None:
        """Count one datagram sent."""
        flow = self._flows[link]
        flow.sent += 1
        flow.bytes_out += size

    def account(
        self, t: float, intakes: Sequence[Intake], players: set[int], way: Way, shares: Sequence[Share]
    ) -> Account:
        """Return the statistics message; `t` is fleet time [s since 1970], `replayed` the UAV ids of recordings."""
        taped = self._recorder.account() if self._recorder is not None else [Taped() for _ in self._links]
        self._overruns = overruns()
        told = tuple(self._link(t, k, intakes[k], taped[k], share) for k, share in enumerate(shares))
        refused: Counter[str] = Counter()
        uavs = set(players)
        for intake in intakes:
            refused.update(intake.refused)
            uavs.update(craft.uav for craft in intake.crafts.values())
        if dropped := sum(link.dropped for link in told):
            refused["dropped: decoding fell behind"] += dropped
        if unsent := sum(link.unsent for link in told):
            refused["not sent: no peer, or send queue full"] += unsent
        return Account(
            t=t,
            links=tuple(link.link for link in told),
            uavs=tuple(sorted(uavs)),
            datagrams=sum(link.datagrams for link in told),
            bytes_in=sum(link.bytes_in for link in told),
            messages=sum(link.messages for link in told),
            bad_bytes=sum(link.bad_bytes for link in told),
            bad_frames=sum(link.bad_frames for link in told),
            refused=dict(refused),
            sentence="" if uavs else "no aircraft received yet; send its telemetry to one of the links",
            per_link=told,
            published=way.published,
            unsent=way.unsent,
            unsure=way.unsure,
            router=way.joined,
            removed=self._recorder.budget.removed if self._recorder is not None else 0,
            now=time.time(),
            machine=platform.node(),
            code=SOURCES,
        )

    def _link(self, t: float, number: int, intake: Intake, taped: Taped, share: Share) -> LinkAccount:
        flow, link, counts = self._flows[number], self._links[number], intake.counters()
        flow.measure(t, counts["messages"])
        return LinkAccount(
            link=link.spec.text,
            datagrams=flow.datagrams,
            bytes_in=flow.bytes_in,
            messages=counts["messages"],
            bad_bytes=counts["bad_bytes"],
            bad_frames=counts["bad_frames"] + counts["unknown"],
            dropped=link.dropped,
            overrun=self._overruns.get(link.spec.port) if link.spec.kind == "udpin" else None,
            sent=flow.sent,
            bytes_out=flow.bytes_out,
            unsent=link.unsent,
            bytes_s=round(flow.bytes_s, 1),
            messages_hz=round(flow.messages_hz, 1),
            recorded=taped.recorded,
            noise=taped.noise,
            unrecorded=taped.lost + taped.dropped,
            unwritten=taped.waiting,
            share=share.now,
            sentence="; ".join(filter(None, (taped.trouble, share.sentence, getattr(link, "damage", "")))),
        )


def overruns(counts: Sequence[Path] = _SYSTEM_S_COUNT) -> Counter[int]:
    """Return the datagrams dropped by the system at each UDP port because of a full buffer; empty if unknown."""
    found: Counter[int] = Counter()
    for path in counts:
        try:
            rows = [row.split() for row in path.read_text().splitlines()[1:]]
        except OSError:  # not Linux
            continue
        for row in rows:
            found[int(row[1].rpartition(":")[2], 16)] += int(row[-1])
    return found
