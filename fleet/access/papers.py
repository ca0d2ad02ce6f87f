"""Find the certificates and passwords of this machine and check their permissions and expiry."""

import os
import stat
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509

from fleet.access.roles import ROUTER_ROLE

CREATE_HINT = "create them with deploy/certificates.sh"
MAX_PASSWORD_CHARS = 1024


def find_certificate(folder: Path, role: str) -> tuple[Path, Path]:
    """Find the certificate of a role and its key.

    Raises:
        ValueError: when one is missing, has expired, or the key is readable by others.
        OSError: when one cannot be read.
    """
    certificate, key = folder / f"{role}.pem", folder / f"{role}.key"
    for path in (folder / "ca.pem", certificate, key):
        if not path.is_file():
            raise ValueError(
                f"certificates: found no {path}, expected it for the role {role}; {CREATE_HINT}, or copy it here"
            )
    check_private(key)
    for path in (folder, folder / "ca.pem", certificate):
        _check_unwritable(path)
    expiry, now = expiry_of(certificate), datetime.now(UTC)
    if expiry < now:
        names = "router FOLDER NAME..." if role == ROUTER_ROLE else f"role FOLDER {role}"
        raise ValueError(
            f"certificates: found {certificate} expired on {expiry:%Y-%m-%d %H:%M} UTC, the time here is "
            f"{now:%Y-%m-%d %H:%M}; renew it: certificates.sh {names}, and copy it here"
        )
    return certificate, key


def expiry_of(certificate: Path) -> datetime:
    """Return the latest expiry of the certificates in a file; a file of authorities may contain two.

    Raises:
        ValueError: when it contains no certificate.
        OSError: when it cannot be read.
    """
    try:
        return max(parsed.not_valid_after_utc for parsed in x509.load_pem_x509_certificates(certificate.read_bytes()))
    except ValueError as error:
        raise ValueError(f"certificates: found no certificate in {certificate} ({error}); {CREATE_HINT}") from None


def check_private(path: Path) -> None:
    """Check that a secret is readable by owner and group only, and writable by its owner only.

    Raises:
        ValueError: when it is not.
        OSError: when its status cannot be read.
    """
    status = path.stat()
    mode = stat.S_IMODE(status.st_mode)
    if not stat.S_ISREG(status.st_mode) or mode & 0o037:
        raise ValueError(
            f"certificates: found {path} with mode {mode:04o}, expected owner and group only; chmod 640 {path}"
        )
    if status.st_uid not in (0, os.geteuid()) and os.geteuid() != 0:
        raise ValueError(
            f"certificates: found {path} with owner {status.st_uid}, expected {os.geteuid()}, this user, or root; "
            f"chown it, or create another"
        )
    if not os.access(path, os.R_OK):
        raise ValueError(f"certificates: found {path} not readable by this user; chown it to the user of ParaUAV")


def _check_unwritable(path: Path) -> None:
    """Check that no other user may replace a certificate or its folder."""
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o022 and not mode & stat.S_ISVTX:
        raise ValueError(
            f"certificates: found {path} with mode {mode:04o}, expected write permission for its owner only; "
            f"chmod go-w {path}"
        )


def read_password(path: Path, role: str) -> str:
    """Read a role's password from a file of lines `role:password`.

    Raises:
        ValueError: when there is none, or the file is readable by others.
        OSError: when it cannot be read.
    """
    check_private(path)
    for line in path.read_text().splitlines():
        name, colon, password = line.partition(":")
        if colon and name == role and 0 < len(password) <= MAX_PASSWORD_CHARS:
            return password
    raise ValueError(f"passwords: found none for the role {role} in {path}, expected a line {role}:PASSWORD; add it")
