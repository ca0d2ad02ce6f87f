"""Fleet checks: router and credentials, clocks, versions, owners of aircraft, unclaimed and doubly claimed aircraft."""

import socket
import ssl
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Generator, Iterable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509

from fleet import SOURCES
from fleet.access.entry import BusConfig, parse_endpoint
from fleet.access.knock import probe_router
from fleet.access.papers import check_private, expiry_of, find_certificate
from fleet.access.roles import ROLES, ROUTER_ROLE
from fleet.bus.bus_protocol import parse_token
from fleet.bus.session import Bus
from fleet.contract import Claim, GatewayCounters, Status
from fleet.health.machine import BAD, NOTE, OK, CheckResult, is_port_free
from fleet.health.ports import port_user
from fleet.report.report_text import id_ranges

OFFSET_NOTE_S = 0.2  # a larger clock offset is a note [s]
OFFSET_BAD_S = 1.0  # a larger clock offset breaks epochs and ages [s]
RECHECK_S = 1.5  # longer than a handover: a problem that persists is real [s]


class FleetSnapshot:
    """Answers of the fleet at one time.

    Attributes:
        claims: claims by worker
        accounts: accounts of gateways
        uavs: ids of aircraft that gateways receive
        clock_offsets: local minus remote clock, by machine, corrected for half the round trip [s]
        live_ranges: id range of each live worker, by worker
    """

    def __init__(self, bus: Bus, live_ranges: dict[str, range]) -> None:
        begun = time.time()
        self.claims = {claim.worker: claim for claim, _ in bus.get(Claim)}
        middle = (begun + time.time()) / 2
        self.clock_offsets = {claim.machine or worker: middle - claim.t for worker, claim in self.claims.items()}
        begun = time.time()
        self.accounts = [account for account, _ in bus.get(GatewayCounters)]
        middle = (begun + time.time()) / 2
        self.clock_offsets |= {account.machine: middle - account.wall_t for account in self.accounts if account.wall_t}
        self.uavs = {status.uav for status, _ in bus.get(Status)}
        self.live_ranges = dict(live_ranges)

    def contested(self) -> dict[int, list[str]]:
        """Return the aircraft that more than one worker claims."""
        holders = defaultdict(list)
        for worker, claim in self.claims.items():
            for uav, _ in claim.owned:
                holders[uav].append(worker)
        return {uav: workers for uav, workers in holders.items() if len(workers) > 1}

    def unclaimed(self) -> set[int]:
        """Return the aircraft that are received and not claimed."""
        return self.uavs - {uav for claim in self.claims.values() for uav, _ in claim.owned}


def check_fleet(bus: Bus) -> Iterator[CheckResult]:
    """Check the fleet; repeat after a problem, as a handover resolves itself."""
    live_ranges: dict[str, range] = {}
    lock = threading.Lock()

    def on_token(name: str, is_live: bool) -> None:
        if (presence := parse_token(name)) is not None:
            with lock:
                live_ranges.pop(presence.worker, None)
                if is_live:
                    live_ranges[presence.worker] = presence.ids

    bus.watch_liveliness(on_token)
    first = FleetSnapshot(bus, live_ranges)
    suspect = first.contested() or first.unclaimed() or set(first.live_ranges) - set(first.claims)
    if suspect:
        threading.Event().wait(RECHECK_S)
    latest = FleetSnapshot(bus, live_ranges) if suspect else first
    yield from _present(latest)
    yield from _clocks(latest)
    yield from _sources(latest)
    yield from _owners(first, latest)


def _present(snapshot: FleetSnapshot) -> Iterator[CheckResult]:
    if not snapshot.accounts:
        yield CheckResult(NOTE, "gateways", "none found; start `gateway` with a --link to the aircraft")
    for account in snapshot.accounts:
        unsent = f", {account.unsent} messages unsent" if account.unsent else ""
        text = f"{account.machine or 'one'}: {len(account.uavs)} aircraft on {len(account.links)} links{unsent}"
        yield CheckResult(OK, "gateways", text)
    publishers = Counter(uav for account in snapshot.accounts for uav in account.uavs)
    if duplicates := sorted(uav for uav, count in publishers.items() if count > 1):
        remedy = "change the offset of one (#offset=), or stop it"
        yield CheckResult(BAD, "gateways", f"two gateways publish uav {id_ranges(duplicates)}; {remedy}")
    if not snapshot.claims and not snapshot.live_ranges:
        yield CheckResult(NOTE, "workers", "none found; start `twin_worker` with a range of ids (--uavs)")
    for worker in sorted(set(snapshot.live_ranges) - set(snapshot.claims)):
        problem = f"{worker} is live but does not answer: process or machine frozen; stop it (kill -9)"
        yield CheckResult(BAD, "workers", problem)


def _clocks(snapshot: FleetSnapshot) -> Iterator[CheckResult]:
    for machine, offset in sorted(snapshot.clock_offsets.items()):
        if abs(offset) < OFFSET_NOTE_S:
            yield CheckResult(OK, "clocks", f"{machine}: within {OFFSET_NOTE_S:g} s of this machine's")
            continue
        which = "behind" if offset > 0 else "ahead of"
        grade = BAD if abs(offset) > OFFSET_BAD_S else NOTE
        remedy = "synchronise both with one time server (chrony, systemd-timesyncd)"
        yield CheckResult(grade, "clocks", f"{machine}: {abs(offset):.1f} s {which} this machine's; {remedy}")


def _sources(snapshot: FleetSnapshot) -> Iterator[CheckResult]:
    processes = [("twin_worker", claim.machine or worker, claim.code) for worker, claim in snapshot.claims.items()]
    processes += [("gateway", account.machine, account.code) for account in snapshot.accounts]
    differing = sorted({f"{role} on {machine or 'a machine'}" for role, machine, code in processes if code != SOURCES})
    if differing and len(differing) == len(processes) and len({code for *_, code in processes}) == 1:
        text = f"all {len(processes)} processes have one release, this command another; install theirs"
        yield CheckResult(NOTE, "versions", text)
    elif differing:
        remedy = "twins are not handed over between releases; install the same release everywhere and restart"
        yield CheckResult(NOTE, "versions", f"{', '.join(differing)}: other release than here; {remedy}")
    elif processes:
        yield CheckResult(OK, "versions", f"all {len(processes)} processes have the release of this command")


def _owners(first: FleetSnapshot, snapshot: FleetSnapshot) -> Iterator[CheckResult]:
    for worker, claim in sorted(snapshot.claims.items()):
        id_range = snapshot.live_ranges.get(worker)
        text = f"{worker} on {claim.machine or 'a machine'}: owns {id_ranges(u for u, _ in claim.owned) or 'none'}"
        text += f", id range {id_range.start}-{id_range.stop - 1}" if id_range is not None else ""
        text += ", is leaving" if claim.leaving else ""
        yield CheckResult(OK, "owners", text)
        if id_range is None:
            yield CheckResult(BAD, "owners", f"{worker}: claims without a liveliness token; restart it")
        if claim.without_history:
            text = f"{worker}: uav {id_ranges(claim.without_history)} without past telemetry; check its gateway"
            yield CheckResult(NOTE, "owners", text)
    for uav, workers in sorted(snapshot.contested().items()):
        if uav in first.contested():
            yield CheckResult(BAD, "owners", f"uav-{uav}: claimed by {' and '.join(sorted(workers))}; stop one of them")
    yield from _unclaimed(snapshot.unclaimed() & first.unclaimed(), snapshot)


def _unclaimed(unclaimed: Iterable[int], snapshot: FleetSnapshot) -> Iterator[CheckResult]:
    ranges = snapshot.live_ranges.values()
    out_of_range = sorted(uav for uav in unclaimed if not any(uav in id_range for id_range in ranges))
    if out_of_range:
        text = f"uav {id_ranges(out_of_range)}: in no worker range; start `twin_worker --uavs` with these ids"
        yield CheckResult(BAD, "orphans", text)
    if in_range := sorted(set(unclaimed) - set(out_of_range)):
        text = f"uav {id_ranges(in_range)}: in a worker range but not claimed; restart that worker"
        yield CheckResult(BAD, "orphans", text)
    if not out_of_range and not in_range and snapshot.uavs:
        yield CheckResult(OK, "orphans", f"none of {len(snapshot.uavs)} aircraft")


RENEWAL_PERIOD = timedelta(days=14)
LOOPBACK = ("127.0.0.1", "::1", "localhost")


def check_certificates(entry: BusConfig) -> Iterator[CheckResult]:
    """Check every certificate in the folder: key present and private, not expired; and the password file."""
    if entry.certificates is None:
        where = "on loopback" if parse_endpoint(entry.endpoint)[0] in LOOPBACK else "over the network"
        grade = OK if where == "on loopback" else NOTE
        access = "password authentication" if entry.passwords else "no authentication"
        remedy = "" if grade == OK else "; use --config with certificates to encrypt: deploy/README.md"
        yield CheckResult(grade, "certificates", f"not used: {where}, unencrypted, {access}{remedy}")
    else:
        yield from _certificates(entry, entry.certificates)
    if entry.passwords is not None:
        try:
            check_private(entry.passwords)
        except (ValueError, OSError) as error:
            yield CheckResult(BAD, "passwords", str(error).removeprefix("certificates: "))


def _certificates(entry: BusConfig, folder: Path) -> Iterator[CheckResult]:
    roles = [role for role in (*ROLES, ROUTER_ROLE) if (folder / f"{role}.pem").is_file()]
    if entry.mutual_tls and entry.role not in roles:
        roles.append(entry.role)
    for role in roles:
        try:
            find_certificate(folder, role)
            names = "router FOLDER NAME..." if role == ROUTER_ROLE else f"role FOLDER {role}"
            remedy = f"certificates.sh {names}, and copy it here"
            yield _grade_expiry(role, expiry_of(folder / f"{role}.pem"), remedy)
        except (ValueError, OSError) as error:
            yield CheckResult(BAD, "certificates", str(error).removeprefix("certificates: "))
    try:
        remedy = "certificates.sh next-ca FOLDER: Renewal in deploy/README.md"
        result = _grade_expiry("authority", expiry_of(folder / "ca.pem"), remedy)
    except (ValueError, OSError) as error:
        result = CheckResult(BAD, "certificates", str(error).removeprefix("certificates: "))
    key = folder / "ca.key"
    if result.grade == OK and key.exists():
        result = CheckResult(NOTE, "certificates", f"{key} can issue any role; store it offline, on one machine")
    yield result


def _grade_expiry(subject: str, end: datetime, remedy: str) -> CheckResult:
    remaining = end - datetime.now(UTC)
    if remaining < timedelta(0):
        return CheckResult(BAD, "certificates", f"{subject}: expired on {end:%Y-%m-%d %H:%M} UTC; renew it: {remedy}")
    if remaining < RENEWAL_PERIOD:
        text = f"{subject}: expires on {end:%Y-%m-%d}, in {remaining.days} days; renew it: {remedy}"
        return CheckResult(NOTE, "certificates", text)
    return CheckResult(OK, "certificates", f"{subject}: valid until {end:%Y-%m-%d}")


def check_router(entry: BusConfig) -> Generator[CheckResult, None, bool]:
    """Check the router endpoint; return whether a router answers and accepts the connection."""
    try:
        reachable = probe_router(entry)
    except (ValueError, OSError) as error:
        yield CheckResult(BAD, "router", f"{error}{at_router_port(entry)}")
        return False
    if reachable:
        yield CheckResult(OK, "router", f"{entry.endpoint} answers")
        if entry.certificates is not None:
            yield from _router_certificate(entry, entry.certificates)
        return True
    host, port = parse_endpoint(entry.endpoint)
    if is_port_free(socket.SOCK_STREAM, host, port):
        yield CheckResult(OK, "router", f"{entry.endpoint} is free; `fleet up` will open a router there")
    else:
        text = f"{entry.endpoint} is in use and does not answer; start `zenohd` there or choose another --router"
        text += at_router_port(entry)
        yield CheckResult(BAD, "router", text)
    return False


def at_router_port(entry: BusConfig) -> str:
    """Return `; the port is used by …` with the program at the router's port on this machine; else nothing."""
    host, port = parse_endpoint(entry.endpoint)
    user = port_user(socket.SOCK_STREAM, port) if host in LOOPBACK else ""
    return f"; the port is used by {user}" if user else ""


def _router_certificate(entry: BusConfig, folder: Path) -> Iterator[CheckResult]:
    """Check the expiry of the router certificate from a TLS handshake; it was verified before."""
    context = ssl.create_default_context(cafile=str(folder / "ca.pem"))
    context.verify_flags &= ~ssl.VERIFY_X509_STRICT
    try:
        if (own_papers := entry.certificate_pair()) is not None:  # avoids an error in the router log
            context.load_cert_chain(*own_papers)
        with (
            socket.create_connection(parse_endpoint(entry.endpoint), timeout=3.0) as raw_socket,
            context.wrap_socket(raw_socket, server_hostname=parse_endpoint(entry.endpoint)[0]) as tls_socket,
        ):
            certificate = tls_socket.getpeercert(binary_form=True)
    except OSError:
        return
    if certificate:
        end = x509.load_der_x509_certificate(certificate).not_valid_after_utc
        yield _grade_expiry("router", end, "certificates.sh router FOLDER NAME..., and restart it")
