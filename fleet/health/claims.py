"""Fleet checks: clocks, versions, owners of aircraft, unclaimed and doubly claimed aircraft."""

import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator

from fleet import SOURCES
from fleet.bus.bus_protocol import Bus
from fleet.bus.presence import read
from fleet.contract import Account, Claim, Status
from fleet.health.finding import BAD, NOTE, OK, Finding
from fleet.report.report_text import spans

APART_S = 0.2  # a larger clock offset is a note [s]
FAR_S = 1.0  # a larger clock offset breaks epochs and ages [s]
SETTLE_S = 1.5  # longer than a handover: a problem that persists is real [s]


class Seen:
    """Answers of the fleet at one time.

    Attributes:
        claims: claims by worker
        accounts: accounts of gateways
        uavs: ids of aircraft that gateways receive
        clock_offsets: local minus remote clock, by machine, corrected for half the round trip [s]
        live_ranges: id range of each live worker, by worker
    """

    def __init__(self, bus: Bus, live: dict[str, range]) -> None:
        begun = time.time()
        self.claims = {claim.worker: claim for claim, _ in bus.ask(Claim)}
        middle = (begun + time.time()) / 2
        self.late = {claim.machine or worker: middle - claim.t for worker, claim in self.claims.items()}
        begun = time.time()
        self.accounts = [account for account, _ in bus.ask(Account)]
        middle = (begun + time.time()) / 2
        self.late |= {account.machine: middle - account.now for account in self.accounts if account.now}
        self.known = {status.uav for status, _ in bus.ask(Status)}
        self.live = dict(live)

    def twice(self) -> dict[int, list[str]]:
        """Return the aircraft that more than one worker claims."""
        holders = defaultdict(list)
        for worker, claim in self.claims.items():
            for uav, _ in claim.held:
                holders[uav].append(worker)
        return {uav: workers for uav, workers in holders.items() if len(workers) > 1}

    def orphans(self) -> set[int]:
        """Return the aircraft that are received and not claimed."""
        return self.known - {uav for claim in self.claims.values() for uav, _ in claim.held}


def look(bus: Bus) -> Iterator[Finding]:
    """Check the fleet; repeat after a problem, as a handover resolves itself."""
    live: dict[str, range] = {}
    lock = threading.Lock()

    def token(name: str, lives: bool) -> None:
        if (told := read(name)) is not None:
            with lock:
                live.pop(told.worker, None) if not lives else live.update({told.worker: told.ids})

    bus.attend(token)
    before = Seen(bus, live)
    wrong = before.twice() or before.orphans() or set(before.live) - set(before.claims)
    if wrong:
        threading.Event().wait(SETTLE_S)
    now = Seen(bus, live) if wrong else before
    yield from _present(now)
    yield from _clocks(now)
    yield from _sources(now)
    yield from _owners(before, now)


def _present(seen: Seen) -> Iterator[Finding]:
    if not seen.accounts:
        yield Finding(NOTE, "gateways", "none found; start `gateway` with a --link to the aircraft")
    for account in seen.accounts:
        where = f"{account.machine or 'one'}: {len(account.uavs)} aircraft on {len(account.links)} links"
        sent = f", {account.unsent} messages unsent" if account.unsent else ""
        yield Finding(OK, "gateways", where + sent)
    heard = Counter(uav for account in seen.accounts for uav in account.uavs)
    if both := sorted(uav for uav, count in heard.items() if count > 1):
        yield Finding(
            BAD,
            "gateways",
            f"two gateways publish uav {spans(both)}; change the offset of one (#offset=), or stop it",
        )
    if not seen.claims and not seen.live:
        yield Finding(NOTE, "workers", "none found; start `twin_worker` with a range of ids (--uavs)")
    for worker in sorted(set(seen.live) - set(seen.claims)):
        yield Finding(
            BAD, "workers", f"{worker} is live but does not answer: process or machine frozen; stop it (kill -9)"
        )


def _clocks(seen: Seen) -> Iterator[Finding]:
    for machine, late in sorted(seen.late.items()):
        if abs(late) < APART_S:
            yield Finding(OK, "clocks", f"{machine}: within {APART_S:g} s of this machine's")
            continue
        which = "behind" if late > 0 else "ahead of"
        grade = BAD if abs(late) > FAR_S else NOTE
        cure = "synchronise both with one time server (chrony, systemd-timesyncd)"
        yield Finding(grade, "clocks", f"{machine}: {abs(late):.1f} s {which} this machine's; {cure}")


def _sources(seen: Seen) -> Iterator[Finding]:
    told: list[tuple[str, str, str]] = [("twin_worker", c.machine or w, c.code) for w, c in seen.claims.items()]
    told += [("gateway", account.machine, account.code) for account in seen.accounts]
    strange = sorted({f"{what} on {machine or 'a machine'}" for what, machine, code in told if code != SOURCES})
    if strange and len(strange) == len(told) and len({code for *_, code in told}) == 1:
        yield Finding(
            NOTE, "versions", f"all {len(told)} processes have one release, this command another; install theirs"
        )
    elif strange:
        cure = "twins are not handed over between releases; install the same release everywhere and restart"
        yield Finding(NOTE, "versions", f"{', '.join(strange)}: other release than here; {cure}")
    elif told:
        yield Finding(OK, "versions", f"all {len(told)} processes have the release of this command")


def _owners(before: Seen, seen: Seen) -> Iterator[Finding]:
    for worker, claim in sorted(seen.claims.items()):
        may = seen.live.get(worker)
        words = f"{worker} on {claim.machine or 'a machine'}: owns {spans(u for u, _ in claim.held) or 'none'}"
        words += f", id range {may.start}-{may.stop - 1}" if may is not None else ""
        words += ", is leaving" if claim.leaving else ""
        yield Finding(OK, "owners", words)
        if may is None:
            yield Finding(BAD, "owners", f"{worker}: claims without a liveliness token; restart it")
        if claim.bare:
            yield Finding(
                NOTE, "owners", f"{worker}: uav {spans(claim.bare)} without past telemetry; check its gateway"
            )
    for uav, workers in sorted(seen.twice().items()):
        if uav in before.twice():
            yield Finding(BAD, "owners", f"uav-{uav}: claimed by {' and '.join(sorted(workers))}; stop one of them")
    yield from _orphans(seen.orphans() & before.orphans(), seen)


def _orphans(orphans: Iterable[int], seen: Seen) -> Iterator[Finding]:
    beyond = sorted(uav for uav in orphans if not any(uav in may for may in seen.live.values()))
    if beyond:
        yield Finding(
            BAD,
            "orphans",
            f"uav {spans(beyond)}: in no worker range; start `twin_worker --uavs` with these ids",
        )
    if left := sorted(set(orphans) - set(beyond)):
        yield Finding(BAD, "orphans", f"uav {spans(left)}: in a worker range but not claimed; restart that worker")
    if not beyond and not left and seen.known:
        yield Finding(OK, "orphans", f"none of {len(seen.known)} aircraft")
