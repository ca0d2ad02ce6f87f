"""Checks of bus access: local certificates, router, and their expiry."""

import socket
import ssl
from collections.abc import Generator, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509

from fleet.access.entry import BusConfig, parse_endpoint
from fleet.access.knock import probe_router
from fleet.access.papers import check_private, expiry_of, find_certificate
from fleet.access.roles import ROLES, ROUTER_ROLE
from fleet.health.machine import BAD, NOTE, OK, CheckResult, is_port_free

RENEWAL_PERIOD = timedelta(days=14)
LOOPBACK = ("127.0.0.1", "::1", "localhost")


def check_certificates(entry: BusConfig) -> Iterator[CheckResult]:
    """Check every certificate in the folder: key present and private, not expired."""
    if entry.certificates is None:
        where = "on loopback" if parse_endpoint(entry.endpoint)[0] in LOOPBACK else "over the network"
        grade = OK if where == "on loopback" else NOTE
        access = "password authentication" if entry.passwords else "no authentication"
        remedy = "" if grade == OK else "; use --config with certificates to encrypt: deploy/README.md"
        yield CheckResult(grade, "certificates", f"not used: {where}, unencrypted, {access}{remedy}")
        yield from _passwords(entry)
        return
    roles = [role for role in (*ROLES, ROUTER_ROLE) if (entry.certificates / f"{role}.pem").is_file()]
    if entry.mutual_tls and entry.role not in roles:
        roles.append(entry.role)
    for role in roles:
        try:
            find_certificate(entry.certificates, role)
            names = "router FOLDER NAME..." if role == ROUTER_ROLE else f"role FOLDER {role}"
            yield _check_expiry(role, entry.certificates / f"{role}.pem", f"certificates.sh {names}, and copy it here")
        except (ValueError, OSError) as error:
            yield CheckResult(BAD, "certificates", str(error).removeprefix("certificates: "))
    yield _authority(entry.certificates)
    yield from _passwords(entry)


def _passwords(entry: BusConfig) -> Iterator[CheckResult]:
    """Check the password file."""
    if entry.passwords is not None:
        try:
            check_private(entry.passwords)
        except (ValueError, OSError) as error:
            yield CheckResult(BAD, "passwords", str(error).removeprefix("certificates: "))


def _authority(folder: Path) -> CheckResult:
    try:
        result = _check_expiry(
            "authority", folder / "ca.pem", "certificates.sh next-ca FOLDER: Renewal in deploy/README.md"
        )
    except (ValueError, OSError) as error:
        return CheckResult(BAD, "certificates", str(error).removeprefix("certificates: "))
    if result.grade == OK and (folder / "ca.key").exists():
        return CheckResult(
            NOTE, "certificates", f"{folder / 'ca.key'} can issue any role; store it offline, on one machine"
        )
    return result


def _check_expiry(subject: str, path: Path, remedy: str) -> CheckResult:
    return _grade_expiry(subject, expiry_of(path), remedy)


def _grade_expiry(subject: str, end: datetime, remedy: str) -> CheckResult:
    remaining = end - datetime.now(UTC)
    if remaining < timedelta(0):
        return CheckResult(BAD, "certificates", f"{subject}: expired on {end:%Y-%m-%d %H:%M} UTC; renew it: {remedy}")
    if remaining < RENEWAL_PERIOD:
        return CheckResult(
            NOTE, "certificates", f"{subject}: expires on {end:%Y-%m-%d}, in {remaining.days} days; renew it: {remedy}"
        )
    return CheckResult(OK, "certificates", f"{subject}: valid until {end:%Y-%m-%d}")


def check_router(entry: BusConfig) -> Generator[CheckResult, None, bool]:
    """Check the router endpoint; return whether a router answers and accepts the connection."""
    try:
        reachable = probe_router(entry)
    except (ValueError, OSError) as error:
        yield CheckResult(BAD, "router", str(error))
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
        yield CheckResult(
            BAD,
            "router",
            f"{entry.endpoint} is in use and does not answer; start `zenohd` there or choose another --router",
        )
    return False


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
