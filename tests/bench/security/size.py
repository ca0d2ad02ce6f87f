"""Attempts to send too much, by the rightful role."""

from fleet.access.roles import MAX_MESSAGE_BYTES, MAX_QUERY_BYTES, TOPIC_RULES

from .site import Site
from .trying import FORGED, RIGHT, Attempt, fresh, only_asked, only_heard


def oversize(site: Site) -> str:
    """Publish more than a topic may hold."""
    return _published(
        site, "status", RIGHT * (TOPIC_RULES["status"].max_bytes // len(RIGHT)), TOPIC_RULES["status"].max_bytes
    )


def oversize_fragments(site: Site) -> str:
    """Publish more than any session puts together, so that memory does not fill before anything is looked at."""
    return _published(site, "history", RIGHT, MAX_MESSAGE_BYTES)


def oversize_question(site: Site) -> str:
    """Ask with more than a question may hold."""
    name = fresh("prediction")
    huge = FORGED * (MAX_QUERY_BYTES // len(FORGED) + 100)
    with site.session("worker") as worker, site.session("viewer") as viewer:
        return only_asked(worker, name, lambda: viewer.get(name, payload=RIGHT), lambda: viewer.get(name, payload=huge))


def _published(site: Site, topic: str, right: bytes, most: int) -> str:
    name, huge = fresh(topic), FORGED * (most // len(FORGED) + 100)
    with site.session("gateway") as gateway, site.session("viewer") as reader:
        return only_heard(reader, name, lambda: gateway.put(name, right), lambda: gateway.put(name, huge))


BY_SIZE: tuple[Attempt, ...] = (oversize, oversize_fragments, oversize_question)
