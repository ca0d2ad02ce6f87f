"""Checks of bus access: local certificates, router, and their expiry."""

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
    """Check every certificate in the folder: key present and private, not expired."""
    if at.certificates is None:
        where = "on loopback" if endpoint(at.at)[0] in LOOPBACK else "over the network"
        grade = OK if where == "on loopback" else NOTE
        known = "password authentication" if at.passwords else "no authentication"
        cure = "" if grade == OK else "; use --config with certificates to encrypt: deploy/README.md"
        yield Finding(grade, "certificates", f"not used: {where}, unencrypted, {known}{cure}")
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
    """Check the password file."""
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
        return Finding(
            NOTE, "certificates", f"{folder / 'ca.key'} can issue any role; store it offline, on one machine"
        )
    return found


def _until(whose: str, path: Path, cure: str) -> Finding:
    return _judged(whose, ending(path), cure)


def _judged(whose: str, end: datetime, cure: str) -> Finding:
    left = end - datetime.now(UTC)
    if left < timedelta(0):
        return Finding(BAD, "certificates", f"{whose}: expired on {end:%Y-%m-%d %H:%M} UTC; renew it: {cure}")
    if left < SOON:
        return Finding(
            NOTE, "certificates", f"{whose}: expires on {end:%Y-%m-%d}, in {left.days} days; renew it: {cure}"
        )
    return Finding(OK, "certificates", f"{whose}: valid until {end:%Y-%m-%d}")


def router(at: Entry) -> Generator[Finding, None, bool]:
    """Check the router endpoint; return whether a router answers and accepts the connection."""
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
            BAD, "router", f"{at.at} is in use and does not answer; start `zenohd` there or choose another --router"
        )
    return False


def _shown(at: Entry, folder: Path) -> Iterator[Finding]:
    """Check the expiry of the router certificate from a TLS handshake; it was verified before."""
    context = ssl.create_default_context(cafile=str(folder / "ca.pem"))
    context.verify_flags &= ~ssl.VERIFY_X509_STRICT
    try:
        if (own := at.papers()) is not None:  # avoids an error in the router log
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
        yield _judged("router", end, "certificates.sh router FOLDER NAME..., and restart it")
