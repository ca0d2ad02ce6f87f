"""Access control by role and limits on message size, generated from the permission table as Zenoh configuration.

Everything not listed is denied. Ingress: what a role may publish, query and subscribe to. Egress: everything except the
twins exchanged between workers. `**` never matches a chunk that begins with `@`, so those keys are listed one by one.
"""

from itertools import groupby
from typing import Any

from fleet.access.roles import LIVE, MOST_ASKED, ROLES, ROOT, ROUTER_ROLE, SAID, WORKER, keys

CERTIFICATE, PASSWORD = "cert_common_names", "usernames"  # proof of a role, named as in Zenoh's configuration
_STAMP = 16  # attachment of a result [bytes]
_SAY = ("put", "reply", "declare_queryable")
_ALL = (*_SAY, "query", "declare_subscriber", "liveliness_token", "liveliness_query", "declare_liveliness_subscriber")
_EVERY = f"{ROOT}/**"
_LIVE = f"{ROOT}/{LIVE}/**"


def access_control(known_by: str = CERTIFICATE) -> dict[str, Any]:
    """Return `access_control`; `identified_by`: proof of a role, CERTIFICATE or PASSWORD."""
    control = [topic for topic in SAID if topic.startswith("@")]
    common = [_EVERY, *(keys(topic) for topic in control if SAID[topic].asked == ROLES)]
    rules = [
        _rule("subscribe", ("declare_subscriber", "query"), "ingress", common),
        _rule("watch liveliness", ("liveliness_query", "declare_liveliness_subscriber"), "ingress", [_LIVE]),
        _rule("receive", _ALL, "egress", [*common, _LIVE]),
        _rule("declare liveliness", ("liveliness_token",), "ingress", [f"{ROOT}/{LIVE}/{WORKER}/**"]),
        _rule("route", (*_ALL, "delete"), "", [_EVERY, *map(keys, control), _LIVE]),
    ]
    held = {role: ["subscribe", "watch liveliness", "receive"] for role in ROLES} | {ROUTER_ROLE: ["route"]}
    held[WORKER].append("declare liveliness")
    for role in ROLES:
        hidden = [keys(topic) for topic, said in SAID.items() if role in said.asked != ROLES]
        own = [
            _rule(
                f"{role} publishes", _SAY, "ingress", [keys(topic) for topic, said in SAID.items() if role in said.by]
            ),
            _rule(f"{role} queries", ("query",), "ingress", hidden),
            _rule(f"{role} receives", _ALL, "egress", hidden),
        ]
        rules += (own := [rule for rule in own if rule["key_exprs"]])
        held[role] += [rule["id"] for rule in own]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": role, known_by: [role]} for role in held],
        "policies": [{"subjects": [role], "rules": names} for role, names in held.items()],
    }


def limits() -> dict[str, Any]:
    """Return the size limits of messages by Zenoh configuration path."""
    by_size = sorted(SAID, key=lambda topic: SAID[topic].most)
    filters = [
        _filter(("put", "reply"), [keys(topic) for topic in topics], most + _STAMP)
        for most, topics in groupby(by_size, lambda topic: SAID[topic].most)
    ]
    asked = [_EVERY, *(keys(topic) for topic in SAID if topic.startswith("@"))]
    return {"low_pass_filter": [*filters, _filter(("query",), asked, MOST_ASKED)]}


def _rule(name: str, messages: tuple[str, ...], flow: str, key_exprs: list[str]) -> dict[str, Any]:
    flows = [flow] if flow else ["ingress", "egress"]
    return {"id": name, "permission": "allow", "flows": flows, "messages": list(messages), "key_exprs": key_exprs}


def _filter(messages: tuple[str, ...], key_exprs: list[str], most: int) -> dict[str, Any]:
    name = f"{' and '.join(messages)} up to {most}"
    return {
        "id": name,
        "flows": ["ingress"],
        "messages": list(messages),
        "key_exprs": key_exprs,
        "size_limit": most,
    }
