"""THE TABLE of who says what on the bus, and how large it may be: the router's rules and every reader follow it."""

from typing import NamedTuple

ROOT = "parauav"
GATEWAY, WORKER, VIEWER, TOOLS = "gateway", "worker", "viewer", "tools"
ROUTER_ROLE = "router"
ROLES = (GATEWAY, WORKER, VIEWER, TOOLS)
"""What a process shows a certificate or a password for; the commands of `fleet` are tools."""

KB, MB = 1 << 10, 1 << 20
MOST_ASKED = 512 * KB  # payload of a query: another mission of 1,000 items, a thousand ids [bytes]
LIVE = "@live"  # tokens of processes that are present


class Said(NamedTuple):
    """Who may say a topic, who may ask for it, and the most bytes of one message.

    Attributes:
        by: roles that may publish it and answer for it
        most: largest payload [bytes]
        asked: roles that may query it
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
    "alert": Said((GATEWAY, WORKER), 64 * KB),  # of the gateway: a second sender
    "@fleet/state": Said((WORKER,), MB),
    "@fleet/prediction": Said((WORKER,), 32 * MB),  # 4 KB for each of its aircraft
    "@gateway": Said((GATEWAY,), MB),
    "@claim": Said((WORKER,), MB),
    "@handover": Said((WORKER,), 32 * MB, asked=(WORKER,)),  # all that is known of an aircraft
}
MOST = max(said.most for said in SAID.values())
MESSAGE_MOST = MOST + MB  # what a session puts together from fragments before anything looks at it [bytes]


def keys(topic: str) -> str:
    """Return the keys of one topic: `parauav/*/sample`, `parauav/@claim/*`."""
    return f"{ROOT}/{topic}/*" if topic.startswith("@") else f"{ROOT}/*/{topic}"
