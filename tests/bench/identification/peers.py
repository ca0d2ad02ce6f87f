"""Public identification packages behind one face."""

PEERS: dict = {}


def absent() -> dict[str, str]:
    return {}


def versions(wanted: list[str]) -> dict[str, str]:
    return {}
