"""Certificates and passwords on this machine: found, private, and not expired."""

import os
import stat
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from cryptography import x509

from fleet.access.roles import ROUTER_ROLE

HOW = "make them with deploy/certificates.sh"
MOST_PASSWORD = 1024


class Papers(NamedTuple):
    """A certificate and its key."""

    certificate: Path
    key: Path


def papers_of(folder: Path, role: str) -> Papers:
    """Find the certificate of a role and its key.

    Raises:
        ValueError: when one is missing, has expired, or the key is open to others.
        OSError: when one cannot be read.
    """
    papers = Papers(folder / f"{role}.pem", folder / f"{role}.key")
    for path in (folder / "ca.pem", *papers):
        if not path.is_file():
            raise ValueError(f"certificates: found no {path}, expected it for the role {role}; {HOW}, or copy it here")
    private(papers.key)
    for path in (folder, folder / "ca.pem", papers.certificate):
        _unaltered(path)
    ends, now = ending(papers.certificate), datetime.now(UTC)
    if ends < now:
        names = "router FOLDER NAME..." if role == ROUTER_ROLE else f"role FOLDER {role}"
        raise ValueError(
            f"certificates: found {papers.certificate} expired on {ends:%Y-%m-%d %H:%M} UTC, this clock says "
            f"{now:%Y-%m-%d %H:%M}; renew it: certificates.sh {names}, and copy it here"
        )
    return papers


def ending(certificate: Path) -> datetime:
    """Tell when the last certificate of a file ceases to be valid: the first is a role's, an authority may have two.

    Raises:
        ValueError: when it holds no certificate.
        OSError: when it cannot be read.
    """
    try:
        return max(one.not_valid_after_utc for one in x509.load_pem_x509_certificates(certificate.read_bytes()))
    except ValueError as error:
        raise ValueError(f"certificates: found no certificate in {certificate} ({error}); {HOW}") from None


def private(path: Path) -> None:
    """Refuse a secret that everybody may read, or that others may change.

    Raises:
        ValueError: when it is so.
        OSError: when it cannot be looked at.
    """
    found = path.stat()
    mode = stat.S_IMODE(found.st_mode)
    if not stat.S_ISREG(found.st_mode) or mode & 0o037:
        raise ValueError(
            f"certificates: found {path} with mode {mode:04o}, expected it for owner and group alone; chmod 640 {path}"
        )
    if found.st_uid not in (0, os.geteuid()) and os.geteuid() != 0:
        raise ValueError(
            f"certificates: found {path} with owner {found.st_uid}, expected {os.geteuid()}, who runs this, or root; "
            f"chown it, or make another"
        )
    if not os.access(path, os.R_OK):
        raise ValueError(f"certificates: found {path} that this user may not read; chown it to who runs ParaUAV")


def _unaltered(path: Path) -> None:
    """Refuse a certificate, or a folder of them, that others may replace.

    Raises:
        ValueError: when it is so.
        OSError: when it cannot be looked at.
    """
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o022 and not mode & stat.S_ISVTX:
        raise ValueError(
            f"certificates: found {path} with mode {mode:04o}, expected that only its owner may change it; "
            f"chmod go-w {path}"
        )


def password_of(path: Path, role: str) -> str:
    """Read a role's password from a file of lines `role:password`.

    Raises:
        ValueError: when it has none, or everybody may read the file.
        OSError: when it cannot be read.
    """
    private(path)
    for line in path.read_text().splitlines():
        name, colon, password = line.partition(":")
        if colon and name == role and 0 < len(password) <= MOST_PASSWORD:
            return password
    raise ValueError(f"passwords: found none for the role {role} in {path}, expected a line {role}:PASSWORD; add it")
