"""The way onto the bus: what we would show there, who is there, and until when that is good."""

import socket
import ssl
from collections.abc import Generator, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509

from fleet.access.entry import Entry, endpoint
from fleet.access.knock import answers
from fleet.access.papers import ending, papers_of, private
from fleet.access.roles import ROLES, ROUTER_ROLE
from fleet.health.finding import BAD, NOTE, OK, Finding
from fleet.health.machine import free

SOON = timedelta(days=14)
LOOPBACK = ("127.0.0.1", "::1", "localhost")


def papers(at: Entry) -> Iterator[Finding]:
    """Look at every certificate in the folder: its key is there and private, and it has not ended."""
    if at.certificates is None:
        where = "on loopback" if endpoint(at.at)[0] in LOOPBACK else "over the network"
        grade = OK if where == "on loopback" else NOTE
        known = "known by passwords" if at.passwords else "anyone may join"
        cure = "" if grade == OK else "; --config with certificates encrypts it: deploy/README.md"
        yield Finding(grade, "certificates", f"none are used: {where}, in the clear, {known}{cure}")
        yield from _passwords(at)
        return
    roles = [role for role in (*ROLES, ROUTER_ROLE) if (at.certificates / f"{role}.pem").is_file()]
    if at.mutual and at.role not in roles:
        roles.append(at.role)
    for role in roles:
        try:
            papers_of(at.certificates, role)
            names = "router FOLDER NAME..." if role == ROUTER_ROLE else f"role FOLDER {role}"
            yield _until(role, at.certificates / f"{role}.pem", f"certificates.sh {names}, and copy it here")
        except (ValueError, OSError) as error:
            yield Finding(BAD, "certificates", str(error).removeprefix("certificates: "))
    yield _authority(at.certificates)
    yield from _passwords(at)


def _passwords(at: Entry) -> Iterator[Finding]:
    """Say what is wrong with the file of passwords, if anything is."""
    if at.passwords is not None:
        try:
            private(at.passwords)
        except (ValueError, OSError) as error:
            yield Finding(BAD, "passwords", str(error).removeprefix("certificates: "))


def _authority(folder: Path) -> Finding:
    try:
        found = _until("authority", folder / "ca.pem", "certificates.sh next-ca FOLDER: Renewal in deploy/README.md")
    except (ValueError, OSError) as error:
        return Finding(BAD, "certificates", str(error).removeprefix("certificates: "))
    if found.grade == OK and (folder / "ca.key").exists():
        return Finding(NOTE, "certificates", f"{folder / 'ca.key'} can make any role; keep it on one machine, off line")
    return found


def _until(whose: str, path: Path, cure: str) -> Finding:
    return _judged(whose, ending(path), cure)


def _judged(whose: str, end: datetime, cure: str) -> Finding:
    left = end - datetime.now(UTC)
    if left < timedelta(0):
        return Finding(BAD, "certificates", f"{whose}: ended on {end:%Y-%m-%d %H:%M} UTC; renew it: {cure}")
    if left < SOON:
        return Finding(NOTE, "certificates", f"{whose}: ends on {end:%Y-%m-%d}, in {left.days} days; renew it: {cure}")
    return Finding(OK, "certificates", f"{whose}: good until {end:%Y-%m-%d}")


def router(at: Entry) -> Generator[Finding, None, bool]:
    """Look who is at the router's endpoint; return whether one is there and lets us in."""
    try:
        there = answers(at)
    except (ValueError, OSError) as error:
        yield Finding(BAD, "router", str(error))
        return False
    if there:
        yield Finding(OK, "router", f"{at.at} answers")
        if at.certificates is not None:
            yield from _shown(at, at.certificates)
        return True
    host, port = endpoint(at.at)
    if free(socket.SOCK_STREAM, host, port):
        yield Finding(OK, "router", f"{at.at} is free; `fleet up` will open a router there")
    else:
        yield Finding(
            BAD, "router", f"{at.at} neither answers nor is free; start `zenohd` there or name another --router"
        )
    return False


def _shown(at: Entry, folder: Path) -> Iterator[Finding]:
    """Read the router's own certificate off a handshake; that it is to be believed was seen before."""
    context = ssl.create_default_context(cafile=str(folder / "ca.pem"))
    context.verify_flags &= ~ssl.VERIFY_X509_STRICT
    try:
        if (own := at.papers()) is not None:  # or the router complains of us in its log
            context.load_cert_chain(*own)
        with (
            socket.create_connection(endpoint(at.at), timeout=3.0) as plain,
            context.wrap_socket(plain, server_hostname=endpoint(at.at)[0]) as secure,
        ):
            shown = secure.getpeercert(binary_form=True)
    except OSError:
        return
    if shown:
        end = x509.load_der_x509_certificate(shown).not_valid_after_utc
        yield _judged("the router's", end, "certificates.sh router FOLDER NAME..., and restart it")
