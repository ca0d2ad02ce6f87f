"""The router's side of the table: access control by role and limits on message size, as Zenoh's configuration.

Everything not named is denied. What comes in is what a role may say, ask and listen to; what goes out is what any role
may know, which is everything but the twins that workers hand to each other. `**` never matches a chunk that begins with
`@`, so these are named one by one.
"""

from itertools import groupby
from typing import Any

from fleet.access.roles import LIVE, MOST_ASKED, ROLES, ROOT, ROUTER_ROLE, SAID, WORKER, keys

CERTIFICATE, PASSWORD = "cert_common_names", "usernames"  # what tells a role, by the words of the configuration
_STAMP = 16  # attachment of a result [bytes]
_SAY = ("put", "reply", "declare_queryable")
_ALL = (*_SAY, "query", "declare_subscriber", "liveliness_token", "liveliness_query", "declare_liveliness_subscriber")
_EVERY = f"{ROOT}/**"
_LIVE = f"{ROOT}/{LIVE}/**"


def access_control(known_by: str = CERTIFICATE) -> dict[str, Any]:
    """Return `access_control`; `known_by`: what tells the router a role, CERTIFICATE or PASSWORD."""
    control = [topic for topic in SAID if topic.startswith("@")]
    common = [_EVERY, *(keys(topic) for topic in control if SAID[topic].asked == ROLES)]
    rules = [
        _rule("hear", ("declare_subscriber", "query"), "ingress", common),
        _rule("attend", ("liveliness_query", "declare_liveliness_subscriber"), "ingress", [_LIVE]),
        _rule("know", _ALL, "egress", [*common, _LIVE]),
        _rule("live", ("liveliness_token",), "ingress", [f"{ROOT}/{LIVE}/{WORKER}/**"]),
        _rule("route", (*_ALL, "delete"), "", [_EVERY, *map(keys, control), _LIVE]),
    ]
    held = {role: ["hear", "attend", "know"] for role in ROLES} | {ROUTER_ROLE: ["route"]}
    held[WORKER].append("live")
    for role in ROLES:
        hidden = [keys(topic) for topic, said in SAID.items() if role in said.asked != ROLES]
        own = [
            _rule(f"{role} says", _SAY, "ingress", [keys(topic) for topic, said in SAID.items() if role in said.by]),
            _rule(f"{role} asks", ("query",), "ingress", hidden),
            _rule(f"{role} knows", _ALL, "egress", hidden),
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
    """Return what keeps large messages out, by Zenoh's configuration paths."""
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
