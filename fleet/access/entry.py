"""Address of the router and credentials as Zenoh configuration; access rules by role."""

from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from fleet.access.papers import find_certificate, read_password
from fleet.access.roles import (
    LIVE,
    MAX_MESSAGE_BYTES,
    MAX_QUERY_BYTES,
    ROLES,
    ROOT,
    ROUTER_ROLE,
    TOOLS,
    TOPIC_RULES,
    WORKER,
    topic_keys,
)

CERTIFICATE, PASSWORD = "cert_common_names", "usernames"  # proof of a role, named as in Zenoh's configuration
_STAMP_BYTES = 16  # attachment of a result [bytes]
_PUBLISH = ("put", "reply", "declare_queryable")
_ALL = (
    *(*_PUBLISH, "query", "declare_subscriber"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)
_UAV_KEYS = f"{ROOT}/**"
_LIVE_KEYS = f"{ROOT}/{LIVE}/**"
_NO_SAMPLES, _OTHER_REGIONS = "no samples", "other regions"  # a rule, and its subject
_ALLOW_ALL = {"enabled": True, "default_permission": "allow", "rules": [], "subjects": [], "policies": []}


def access_control(identified_by: str = CERTIFICATE) -> dict[str, Any]:
    """Return `access_control`; `identified_by`: proof of a role, CERTIFICATE or PASSWORD."""
    control = [topic for topic in TOPIC_RULES if topic.startswith("@")]
    common = [_UAV_KEYS, *(topic_keys(topic) for topic in control if TOPIC_RULES[topic].queriers == ROLES)]
    rules = [
        _rule("subscribe", ("declare_subscriber", "query"), "ingress", common),
        _rule("watch liveliness", ("liveliness_query", "declare_liveliness_subscriber"), "ingress", [_LIVE_KEYS]),
        _rule("receive", _ALL, "egress", [*common, _LIVE_KEYS]),
        _rule("declare liveliness", ("liveliness_token",), "ingress", [f"{ROOT}/{LIVE}/{WORKER}/**"]),
        _rule("route", (*_ALL, "delete"), "", [_UAV_KEYS, *map(topic_keys, control), _LIVE_KEYS]),
    ]
    role_rules = {role: ["subscribe", "watch liveliness", "receive"] for role in ROLES} | {ROUTER_ROLE: ["route"]}
    role_rules[WORKER].append("declare liveliness")
    for role in ROLES:
        published = [topic_keys(topic) for topic, rule in TOPIC_RULES.items() if role in rule.publishers]
        hidden = [topic_keys(topic) for topic, rule in TOPIC_RULES.items() if role in rule.queriers != ROLES]
        own = [
            _rule(f"{role} publishes", _PUBLISH, "ingress", published),
            _rule(f"{role} queries", ("query",), "ingress", hidden),
            _rule(f"{role} receives", _ALL, "egress", hidden),
        ]
        own = [allowed for allowed in own if allowed["key_exprs"]]
        rules += own
        role_rules[role] += [allowed["id"] for allowed in own]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": role, identified_by: [role]} for role in role_rules],
        "policies": [{"subjects": [role], "rules": names} for role, names in role_rules.items()],
    }


def without_samples(control: dict[str, Any], interfaces: list[str]) -> dict[str, Any]:
    """Return access control that also forwards no sample to routers of other regions.

    Where roles are known these are all routers, else whatever is connected over `interfaces`.
    """
    sample_keys = [topic_keys("sample"), topic_keys("@fleet/sample")]
    rule = _rule(_NO_SAMPLES, ("put",), "egress", sample_keys) | {"permission": "deny"}
    subjects, policies = control["subjects"], control["policies"]
    if subjects:  # a rule by interface has no effect: what any subject of a connection may receive is forwarded
        policies = [
            one | {"rules": [*one["rules"], _NO_SAMPLES]} if one["subjects"] == [ROUTER_ROLE] else one
            for one in policies
        ]
    else:
        subjects = [{"id": _OTHER_REGIONS, "interfaces": interfaces}]
        policies = [{"subjects": [_OTHER_REGIONS], "rules": [_NO_SAMPLES]}]
    return control | {"rules": [*control["rules"], rule], "subjects": subjects, "policies": policies}


def message_limits() -> dict[str, Any]:
    """Return the size limits of messages by Zenoh configuration path."""
    by_size = sorted(TOPIC_RULES, key=lambda topic: TOPIC_RULES[topic].max_bytes)
    filters = [
        _size_filter(("put", "reply"), [topic_keys(topic) for topic in topics], max_bytes + _STAMP_BYTES)
        for max_bytes, topics in groupby(by_size, lambda topic: TOPIC_RULES[topic].max_bytes)
    ]
    query_keys = [_UAV_KEYS, *(topic_keys(topic) for topic in TOPIC_RULES if topic.startswith("@"))]
    return {"low_pass_filter": [*filters, _size_filter(("query",), query_keys, MAX_QUERY_BYTES)]}


def _rule(name: str, messages: tuple[str, ...], flow: str, key_exprs: list[str]) -> dict[str, Any]:
    flows = [flow] if flow else ["ingress", "egress"]
    return {"id": name, "permission": "allow", "flows": flows, "messages": list(messages), "key_exprs": key_exprs}


def _size_filter(messages: tuple[str, ...], key_exprs: list[str], max_bytes: int) -> dict[str, Any]:
    name = f"{' and '.join(messages)} up to {max_bytes}"
    limit = {"flows": ["ingress"], "messages": list(messages), "key_exprs": key_exprs, "size_limit": max_bytes}
    return {"id": name} | limit


ROUTER = "tcp/127.0.0.1:7447"
_TLS = "transport/link/tls"
_AUTH = "transport/auth/usrpwd"
_CONGESTION = "transport/link/tx/queue/congestion_control"
_CONNECT_TIMEOUT_MS = 10_000  # an accepted session takes less, also on a busy machine


def parse_endpoint(router: str, option: str = "--router") -> tuple[str, int]:
    """Split `tcp/127.0.0.1:7447` into host and port; `option` names it in errors.

    Raises:
        ValueError: when it is not a tcp or tls endpoint.
    """
    kind, _, rest = router.partition("/")
    host, _, port = rest.rpartition(":")
    if kind not in ("tcp", "tls") or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"{option}: found {router!r}, expected e.g. {ROUTER}; name protocol, host and port")
    return host.strip("[]"), int(port)


@dataclass(frozen=True)
class BusConfig:
    """Address of the router and credentials of one process.

    Attributes:
        endpoint: of the router
        role: of this process, one of ROLES
        certificates: folder of `ca.pem` and of the role's `.pem` and `.key`; None: no TLS
        passwords: file of lines `role:password`; None: no passwords
    """

    endpoint: str = ROUTER
    role: str = TOOLS
    certificates: Path | None = None
    passwords: Path | None = None

    def __post_init__(self) -> None:
        """Validate the combination.

        Raises:
            ValueError: when endpoint and certificates do not match.
        """
        parse_endpoint(self.endpoint)
        if self.endpoint.startswith("tls/") != (self.certificates is not None):
            presence = "without" if self.certificates is None else "with"
            raise ValueError(
                f"--router: found {self.endpoint} {presence} certificates, expected tls/… and `certificates` "
                "in the file of --config, or neither; see deploy/README.md"
            )

    @property
    def mutual_tls(self) -> bool:
        """Return whether a certificate identifies the role."""
        return self.certificates is not None and self.passwords is None

    @property
    def identifies_roles(self) -> bool:
        """Return whether the router knows the role of every client, and lets it do what the role may."""
        return self.mutual_tls or self.passwords is not None

    def certificate_pair(self) -> tuple[Path, Path] | None:
        """Find certificate and key of this role; None where the role uses a password or nothing.

        Raises:
            ValueError: when it is missing, expired, or readable by others.
            OSError: when it cannot be read.
        """
        return find_certificate(self.certificates, self.role) if self.certificates and not self.passwords else None

    def session_settings(self, *, retry: bool = False) -> dict[str, Any]:
        """Return the settings of a client session by Zenoh configuration path; `retry`: start without a router, too.

        Raises:
            ValueError: when a file is missing, expired, or readable by others.
            OSError: when one cannot be read.
        """
        mode = "peer" if retry else "client"  # a client would wait in `open`
        out = _common_settings(mode, connect=[self.endpoint], listen=[])
        out |= {"connect/timeout_ms": -1 if retry else _CONNECT_TIMEOUT_MS, "connect/exit_on_failure": not retry}
        if self.certificates is not None:
            out[f"{_TLS}/root_ca_certificate"] = str(self.certificates / "ca.pem")
        if (pair := self.certificate_pair()) is not None:
            out[f"{_TLS}/connect_certificate"], out[f"{_TLS}/connect_private_key"] = map(str, pair)
            out[f"{_TLS}/enable_mtls"] = True
        if self.passwords is not None:
            out |= {f"{_AUTH}/user": self.role, f"{_AUTH}/password": read_password(self.passwords, self.role)}
        return out

    def router_settings(
        self, listen: list[str] | None = None, peers: list[str] | None = None, between: list[str] | None = None
    ) -> dict[str, Any]:
        """Return the settings of the router by Zenoh configuration path.

        Args:
            listen: endpoints; None: `endpoint`
            peers: other routers of the site
            between: network interfaces to routers of other regions, to which no sample is forwarded; with roles, to all
        Raises:
            ValueError: as `session_settings`.
            OSError: as `session_settings`.
        """
        out = _common_settings("router", connect=peers or [], listen=listen or [self.endpoint]) | message_limits()
        out |= {"connect/timeout_ms": -1, "connect/exit_on_failure": False}
        if self.certificates is not None:
            certificate, key = find_certificate(self.certificates, ROUTER_ROLE)
            directions = ("listen", "connect") if peers and self.mutual_tls else ("listen",)
            for direction in directions:
                out[f"{_TLS}/{direction}_certificate"] = str(certificate)
                out[f"{_TLS}/{direction}_private_key"] = str(key)
            out[f"{_TLS}/root_ca_certificate"] = str(self.certificates / "ca.pem")
            out[f"{_TLS}/enable_mtls"] = self.mutual_tls
            out[f"{_TLS}/close_link_on_expiration"] = True
        if self.passwords is not None:
            for role in ROLES:
                read_password(self.passwords, role)
            out[f"{_AUTH}/dictionary_file"] = str(self.passwords)
            if peers:
                password = read_password(self.passwords, ROUTER_ROLE)
                out |= {f"{_AUTH}/user": ROUTER_ROLE, f"{_AUTH}/password": password}
        if self.identifies_roles:
            out["access_control"] = access_control(CERTIFICATE if self.mutual_tls else PASSWORD)
        if between:
            out["access_control"] = without_samples(out.get("access_control", _ALLOW_ALL), between)
        return out


def _common_settings(mode: str, *, connect: list[str], listen: list[str]) -> dict[str, Any]:
    return {
        "mode": mode,
        "connect/endpoints": connect,
        "listen/endpoints": listen,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "transport/link/tx/lease": 1000,
        "transport/link/tx/keep_alive": 4,
        "transport/link/tx/queue/size/data_high": 16,  # buffers of 64 kB: replies about 1,000 aircraft come at once
        "transport/link/tx/queue/size/data": 16,  # samples of 1,000 aircraft come at once
        "transport/link/tx/queue/size/data_low": 16,  # enough for large replies on a busy machine
        f"{_CONGESTION}/drop/max_wait_before_drop_fragments": 500_000,  # total for a large reply [us]
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        "transport/shared_memory/enabled": False,  # a killed process would leave its segment mapped by all others
    }
