"""Attempts to send too much, by the rightful role."""

from fleet.access.roles import MESSAGE_MOST, MOST_ASKED, SAID

from .site import Site
from .trying import FORGED, RIGHT, Attempt, fresh, only_asked, only_heard


def oversize(site: Site) -> str:
    """Publish more than a topic may hold."""
    return _published(site, "status", RIGHT * (SAID["status"].most // len(RIGHT)), SAID["status"].most)


def oversize_fragments(site: Site) -> str:
    """Publish more than any session puts together, so that memory does not fill before anything is looked at."""
    return _published(site, "history", RIGHT, MESSAGE_MOST)


def oversize_question(site: Site) -> str:
    """Ask with more than a question may hold."""
    name = fresh("prediction")
    huge = FORGED * (MOST_ASKED // len(FORGED) + 100)
    with site.session("worker") as worker, site.session("viewer") as viewer:
        return only_asked(worker, name, lambda: viewer.get(name, payload=RIGHT), lambda: viewer.get(name, payload=huge))


def _published(site: Site, topic: str, right: bytes, most: int) -> str:
    name, huge = fresh(topic), FORGED * (most // len(FORGED) + 100)
    with site.session("gateway") as gateway, site.session("viewer") as reader:
        return only_heard(reader, name, lambda: gateway.put(name, right), lambda: gateway.put(name, huge))


BY_SIZE: tuple[Attempt, ...] = (oversize, oversize_fragments, oversize_question)
