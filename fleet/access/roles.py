"""Permissions and size limits by topic: the single table behind the router's rules and every reader."""

from typing import NamedTuple

ROOT = "parauav"
GATEWAY, WORKER, VIEWER, TOOLS = "gateway", "worker", "viewer", "tools"
ROUTER_ROLE = "router"
ROLES = (GATEWAY, WORKER, VIEWER, TOOLS)
"""Roles that a certificate or a password proves; the commands of `fleet` have the role `tools`."""

KB, MB = 1 << 10, 1 << 20
MOST_ASKED = 512 * KB  # payload of a query: a mission of 1,000 items, or 1,000 ids [bytes]
LIVE = "@live"  # liveliness tokens of processes


class Said(NamedTuple):
    """Permissions and size limit of one topic.

    Attributes:
        publishers: roles that may publish it and reply to queries on it
        max_bytes: largest payload [bytes]
        queriers: roles that may query it
    """

    by: tuple[str, ...]
    most: int
    asked: tuple[str, ...] = ROLES


SAID: dict[str, Said] = {
    "sample": Said((GATEWAY,), 256 * KB),
    "status": Said((GATEWAY,), 64 * KB),
    "mission": Said((GATEWAY,), MB),
    "params": Said((GATEWAY,), MB),
    "history": Said((GATEWAY,), 32 * MB),
    "model": Said((WORKER,), 256 * KB),
    "prediction": Said((WORKER,), 256 * KB),
    "mismatch": Said((WORKER,), 256 * KB),
    "alert": Said((GATEWAY, WORKER), 64 * KB),  # from the gateway: a second sender
    "@fleet/state": Said((WORKER,), MB),
    "@fleet/prediction": Said((WORKER,), 32 * MB),  # 4 KB for each of its aircraft
    "@gateway": Said((GATEWAY,), MB),
    "@claim": Said((WORKER,), MB),
    "@handover": Said((WORKER,), 32 * MB, asked=(WORKER,)),  # the complete twin of an aircraft
}
MOST = max(said.most for said in SAID.values())
MESSAGE_MOST = MOST + MB  # largest message that a session reassembles from fragments [bytes]


def keys(topic: str) -> str:
    """Return the keys of one topic: `parauav/*/sample`, `parauav/@claim/*`."""
    return f"{ROOT}/{topic}/*" if topic.startswith("@") else f"{ROOT}/*/{topic}"
