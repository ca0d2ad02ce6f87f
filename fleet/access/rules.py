"""Access control by role and limits on message size, generated from the permission table as Zenoh configuration.

Everything not listed is denied. Ingress: what a role may publish, query and subscribe to. Egress: everything except the
twins exchanged between workers. `**` never matches a chunk that begins with `@`, so those keys are listed one by one.
"""

from itertools import groupby
from typing import Any

from fleet.access.roles import LIVE, MAX_QUERY_BYTES, ROLES, ROOT, ROUTER_ROLE, TOPIC_RULES, WORKER, topic_keys

CERTIFICATE, PASSWORD = "cert_common_names", "usernames"  # proof of a role, named as in Zenoh's configuration
_STAMP_BYTES = 16  # attachment of a result [bytes]
_PUBLISH = ("put", "reply", "declare_queryable")
_ALL = (
    *_PUBLISH,
    "query",
    "declare_subscriber",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
_UAV_KEYS = f"{ROOT}/**"
_LIVE_KEYS = f"{ROOT}/{LIVE}/**"


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
        hidden = [
            topic_keys(topic) for topic, topic_rule in TOPIC_RULES.items() if role in topic_rule.queriers != ROLES
        ]
        own = [
            _rule(
                f"{role} publishes",
                _PUBLISH,
                "ingress",
                [topic_keys(topic) for topic, topic_rule in TOPIC_RULES.items() if role in topic_rule.publishers],
            ),
            _rule(f"{role} queries", ("query",), "ingress", hidden),
            _rule(f"{role} receives", _ALL, "egress", hidden),
        ]
        rules += (own := [rule for rule in own if rule["key_exprs"]])
        role_rules[role] += [rule["id"] for rule in own]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": role, identified_by: [role]} for role in role_rules],
        "policies": [{"subjects": [role], "rules": names} for role, names in role_rules.items()],
    }


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
    return {
        "id": name,
        "flows": ["ingress"],
        "messages": list(messages),
        "key_exprs": key_exprs,
        "size_limit": max_bytes,
    }
