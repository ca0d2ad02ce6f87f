"""Permissions and size limits by topic: the single table behind the router's rules and every reader."""

from typing import NamedTuple

ROOT = "parauav"
GATEWAY, WORKER, VIEWER, TOOLS, OPERATOR = "gateway", "worker", "viewer", "tools", "operator"
ROUTER_ROLE = "router"
ROLES = (GATEWAY, WORKER, VIEWER, TOOLS, OPERATOR)
"""Roles that a certificate or a password proves.

The commands of `fleet` have the role `tools`, except `fleet approve` and `fleet undo`: only an operator may approve.
"""

KB, MB = 1 << 10, 1 << 20
MAX_QUERY_BYTES = 512 * KB  # payload of a query: a mission of 1,000 items, or 1,000 ids [bytes]
LIVE = "@live"  # liveliness tokens of processes


class TopicRule(NamedTuple):
    """Permissions and size limit of one topic.

    Attributes:
        publishers: roles that may publish it and reply to queries on it
        max_bytes: largest payload [bytes]
        queriers: roles that may query it
    """

    publishers: tuple[str, ...]
    max_bytes: int
    queriers: tuple[str, ...] = ROLES


TOPIC_RULES: dict[str, TopicRule] = {
    "sample": TopicRule((GATEWAY,), 256 * KB),
    "status": TopicRule((GATEWAY,), 64 * KB),
    "mission": TopicRule((GATEWAY,), MB),
    "params": TopicRule((GATEWAY,), MB),
    "history": TopicRule((GATEWAY,), 32 * MB),
    "model": TopicRule((WORKER,), 256 * KB),
    "prediction": TopicRule((WORKER,), 256 * KB),
    "mismatch": TopicRule((WORKER,), 256 * KB),
    "alert": TopicRule((GATEWAY, WORKER), 64 * KB),  # from the gateway: a second sender
    "proposal": TopicRule((WORKER,), MB),
    "approval": TopicRule((OPERATOR,), 64 * KB),
    "execution": TopicRule((GATEWAY,), 256 * KB),
    "@fleet/state": TopicRule((WORKER,), MB),
    "@fleet/sample": TopicRule((GATEWAY,), MB),
    "@fleet/prediction": TopicRule((WORKER,), 32 * MB),  # 4 KB for each of its aircraft
    "@world/wind": TopicRule((WORKER,), MB),
    "@world/siblings": TopicRule((WORKER,), MB),
    "@gateway": TopicRule((GATEWAY,), MB),
    "@claim": TopicRule((WORKER,), MB),
    "@handover": TopicRule((WORKER,), 32 * MB, queriers=(WORKER,)),  # the complete twin of an aircraft
}
MAX_BYTES = max(rule.max_bytes for rule in TOPIC_RULES.values())
MAX_MESSAGE_BYTES = MAX_BYTES + MB  # largest message that a session reassembles from fragments [bytes]


def topic_keys(topic: str) -> str:
    """Return the keys of one topic: `parauav/*/sample`, `parauav/@claim/*`."""
    return f"{ROOT}/{topic}/*" if topic.startswith("@") else f"{ROOT}/*/{topic}"
