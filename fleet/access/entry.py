"""Address of the router and credentials (certificates, or role and password) as Zenoh configuration."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fleet.access.papers import Papers, papers_of, password_of
from fleet.access.roles import MESSAGE_MOST, ROLES, ROUTER_ROLE, TOOLS
from fleet.access.rules import CERTIFICATE, PASSWORD, access_control, limits

ROUTER = "tcp/127.0.0.1:7447"
_TLS = "transport/link/tls"
_WORDS = "transport/auth/usrpwd"
_FULL = "transport/link/tx/queue/congestion_control"
_REFUSED_MS = 10_000  # an accepted session takes less, also on a busy machine


def endpoint(router: str) -> tuple[str, int]:
    """Split `tcp/127.0.0.1:7447` into host and port.

    Raises:
        ValueError: when it is not a tcp or tls endpoint.
    """
    kind, _, rest = router.partition("/")
    host, _, port = rest.rpartition(":")
    if kind not in ("tcp", "tls") or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"--router: found {router!r}, expected e.g. {ROUTER}; name protocol, host and port")
    return host.strip("[]"), int(port)


@dataclass(frozen=True)
class Entry:
    """Address of the router and credentials of one process.

    Attributes:
        endpoint: of the router
        role: of this process, one of ROLES
        certificates: folder of `ca.pem` and of the role's `.pem` and `.key`; None: no TLS
        passwords: file of lines `role:password`; None: no passwords
    """

    at: str = ROUTER
    role: str = TOOLS
    certificates: Path | None = None
    passwords: Path | None = None

    def __post_init__(self) -> None:
        """Validate the combination.

        Raises:
            ValueError: when endpoint and certificates do not match.
        """
        endpoint(self.at)
        if self.at.startswith("tls/") != (self.certificates is not None):
            with_ = "without" if self.certificates is None else "with"
            raise ValueError(
                f"--router: found {self.at} {with_} certificates, expected tls/… and `certificates` in the file of "
                "--config, or neither; see deploy/README.md"
            )

    @property
    def mutual(self) -> bool:
        """Return whether a certificate identifies the role."""
        return self.certificates is not None and self.passwords is None

    def papers(self) -> Papers | None:
        """Find the certificate of this role; None where the role uses a password or nothing.

        Raises:
            ValueError: when it is missing, expired, or readable by others.
            OSError: when it cannot be read.
        """
        return papers_of(self.certificates, self.role) if self.certificates and not self.passwords else None

    def session(self, *, patient: bool = False) -> dict[str, Any]:
        """Return the settings of a client session by Zenoh configuration path; `retry`: start without a router, too.

        Raises:
            ValueError: when a file is missing, expired, or readable by others.
            OSError: when one cannot be read.
        """
        out = _common("peer" if patient else "client", connect=[self.at], listen=[])  # a client would wait in `open`
        out |= {"connect/timeout_ms": -1 if patient else _REFUSED_MS, "connect/exit_on_failure": not patient}
        if self.certificates is not None:
            out[f"{_TLS}/root_ca_certificate"] = str(self.certificates / "ca.pem")
        if (own := self.papers()) is not None:
            out[f"{_TLS}/connect_certificate"] = str(own.certificate)
            out[f"{_TLS}/connect_private_key"] = str(own.key)
            out[f"{_TLS}/enable_mtls"] = True
        if self.passwords is not None:
            out |= {f"{_WORDS}/user": self.role, f"{_WORDS}/password": password_of(self.passwords, self.role)}
        return out

    def router(self, listen: list[str] | None = None, beside: list[str] | None = None) -> dict[str, Any]:
        """Return the settings of the router by Zenoh configuration path.

        Args:
            listen: endpoints; None: `endpoint`
            peers: other routers of the site
        Raises:
            ValueError: as `session`.
            OSError: as `session`.
        """
        out = _common("router", connect=beside or [], listen=listen or [self.at]) | limits()
        out |= {"connect/timeout_ms": -1, "connect/exit_on_failure": False}
        if self.certificates is not None:
            papers = papers_of(self.certificates, ROUTER_ROLE)
            ways = ("listen", "connect") if beside and self.mutual else ("listen",)
            for way in ways:
                out[f"{_TLS}/{way}_certificate"] = str(papers.certificate)
                out[f"{_TLS}/{way}_private_key"] = str(papers.key)
            out[f"{_TLS}/root_ca_certificate"] = str(self.certificates / "ca.pem")
            out[f"{_TLS}/enable_mtls"] = self.mutual
            out[f"{_TLS}/close_link_on_expiration"] = True
        if self.passwords is not None:
            for role in ROLES:
                password_of(self.passwords, role)
            out[f"{_WORDS}/dictionary_file"] = str(self.passwords)
            if beside:
                own = password_of(self.passwords, ROUTER_ROLE)
                out |= {f"{_WORDS}/user": ROUTER_ROLE, f"{_WORDS}/password": own}
        if self.mutual or self.passwords is not None:
            out["access_control"] = access_control(CERTIFICATE if self.mutual else PASSWORD)
        return out


def _common(mode: str, *, connect: list[str], listen: list[str]) -> dict[str, Any]:
    return {
        "mode": mode,
        "connect/endpoints": connect,
        "listen/endpoints": listen,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "transport/link/tx/lease": 1000,
        "transport/link/tx/keep_alive": 4,
        "transport/link/tx/queue/size/data_low": 16,  # batches of 64 kB: enough for large replies on a busy machine
        f"{_FULL}/drop/max_wait_before_drop_fragments": 500_000,  # total for a large reply [us]
        "transport/link/rx/max_message_size": MESSAGE_MOST,
        "transport/shared_memory/enabled": False,  # a killed process would leave its segment mapped by all others
    }
