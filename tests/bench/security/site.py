"""A site to be attacked: certificates made by deploy/certificates.sh, and a router, the real one or ours."""

import contextlib
import os
import secrets
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fleet.access.entry import BusConfig, parse_endpoint
from fleet.access.knock import accepts_connections
from fleet.access.roles import ROLES, ROUTER_ROLE
from fleet.bus.session import _config
from fleet.commands.live.router import format_settings

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = ROOT / "deploy" / "certificates.sh"
PATIENCE_S = 20.0
REAL, OURS = "zenohd", "embedded"


@dataclass(frozen=True)
class Site:
    """What attackers and rightful owners need.

    Attributes:
        at: the router's endpoint
        folder: of the site's certificates, `foreign` (another authority's) and `old` (expired) beside it
        passwords: file of the roles' passwords; None: roles show certificates
    """

    at: str
    folder: Path
    passwords: Path | None = None

    @property
    def tls(self) -> bool:
        """Tell whether it speaks TLS."""
        return self.at.startswith("tls/")

    def entry(self, role: str) -> BusConfig:
        """Give a rightful way in."""
        return BusConfig(self.at, role, self.folder if self.tls else None, self.passwords)

    def session(self, role: str, changed: dict[str, Any] | None = None) -> zenoh.Session:
        """Open a raw session as a role, some of its settings changed, or taken away by None.

        Raises:
            zenoh.ZError: when the router does not let it in.
        """
        settings = self.entry(role).session_settings() | (changed or {})
        return zenoh.open(_config({path: value for path, value in settings.items() if value is not None}))


def make_papers(folder: Path, *names: str, authority: Path | None = None) -> Path:
    """Run the script of deploy/ for a router of these names and every role; of another site's authority, or its own."""
    if authority is None:
        _script("all", folder, *names)
    else:
        shutil.copytree(authority, folder, ignore=shutil.ignore_patterns("other-*"))
        _script("router", folder, *names)
    return folder


def make_passwords(folder: Path) -> Path:
    """Write a password for every role."""
    path = folder / "passwords"
    path.touch(0o600)
    path.write_text("".join(f"{role}:{secrets.token_hex(8)}\n" for role in (*ROLES, ROUTER_ROLE)))
    return path


def _script(command: str, folder: Path, *words: str) -> None:
    subprocess.run(["sh", str(SCRIPT), command, str(folder), *words], check=True, capture_output=True)


def expired(folder: Path, role: str, to: Path, ended: timedelta = timedelta(minutes=1)) -> Path:
    """Make a certificate of the site's own authority that ended a while ago; `openssl x509` cannot."""
    shutil.copytree(folder, to, ignore=shutil.ignore_patterns("other-*"))
    key = ec.generate_private_key(ec.SECP256R1())
    authority = x509.load_pem_x509_certificate((folder / "ca.signing").read_bytes())
    signing = serialization.load_pem_private_key((folder / "ca.key").read_bytes(), None)
    assert isinstance(signing, ec.EllipticCurvePrivateKey)
    until = datetime.now(UTC) - ended
    made = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, role)]))
        .issuer_name(authority.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(until - timedelta(days=1))
        .not_valid_after(until)
        .add_extension(x509.BasicConstraints(False, None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH]), critical=False)
        .sign(signing, hashes.SHA256())
    )
    (to / f"{role}.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))
    (to / f"{role}.key").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return to


def free_port() -> int:
    """Give a loopback port that nobody holds."""
    with socket.socket() as trial:
        trial.bind(("127.0.0.1", 0))
        return trial.getsockname()[1]


def zenohd() -> str | None:
    """Find the real router: in PARAUAV_ZENOHD, on the path, or where cargo puts it."""
    usual = Path.home() / ".cargo" / "bin" / "zenohd"
    return os.environ.get("PARAUAV_ZENOHD") or shutil.which("zenohd") or (str(usual) if usual.is_file() else None)


@contextlib.contextmanager
def routed(kind: str, site: Site, beside: list[str] | None = None) -> Iterator[Site]:
    """Have a router at the site for as long as the block lasts, perhaps beside others."""
    settings = site.entry("tools").router_settings(peers=beside)
    if kind == OURS:
        with zenoh.open(_config(settings)):
            yield site
        return
    program = zenohd()
    assert program is not None
    config = site.folder / f"zenohd-{parse_endpoint(site.at)[1]}.json5"
    config.write_text(format_settings(settings))
    log = (site.folder / "zenohd.log").open("wb")
    child = subprocess.Popen([program, "-c", str(config)], stdout=log, stderr=log)
    try:
        _await(site.at, child)
        yield site
    finally:
        child.terminate()
        child.wait(PATIENCE_S)
        log.close()


def _await(at: str, child: subprocess.Popen[bytes]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not accepts_connections(at):
        with contextlib.suppress(subprocess.TimeoutExpired):
            raise RuntimeError(f"zenohd ended with exit code {child.wait(0.02)}; its log is beside its configuration")
        if time.monotonic() > until:
            raise TimeoutError(f"zenohd does not listen at {at}")
