"""Attempts of one role at what belongs to another, each with a rightful certificate or password of its own."""

from collections.abc import Callable
from contextlib import ExitStack
from queue import SimpleQueue

import zenoh

from fleet.access.roles import LIVE, ROOT, TOPIC_RULES

from .site import PATIENCE_S, Site
from .trying import (
    FORGED,
    IDS,
    RIGHT,
    ROUNDS,
    UNTRIED,
    Admitted,
    Attempt,
    drained,
    fresh,
    only_asked,
    only_heard,
    until,
)


def _publishing(topic: str, by: str) -> Attempt:
    """Make the attempt of one role to publish another's topic."""

    def attempt(site: Site) -> str:
        name = fresh(topic)
        with (
            site.session(TOPIC_RULES[topic].publishers[0]) as owner,
            site.session(by) as forger,
            site.session("tools") as reader,
        ):
            return only_heard(reader, name, lambda: owner.put(name, RIGHT), lambda: forger.put(name, FORGED))

    attempt.__name__ = f"{topic.lstrip('@')}_by_{by}"
    attempt.__doc__ = f"Publish {topic} as {by}."
    return attempt


viewer_predicts = _publishing("prediction", "viewer")


def forged_token(site: Site) -> str:
    """Pretend to be a live worker, by a liveliness token of viewer, gateway and tools."""
    name = f"{ROOT}/{LIVE}/worker/{next(IDS):016x}/0-49/1"
    seen: SimpleQueue[str] = SimpleQueue()
    with ExitStack() as held:
        watching, *forgers, owner = (
            held.enter_context(site.session(role)) for role in ("worker", "viewer", "gateway", "tools", "worker")
        )
        tokens = [forger.liveliness().declare_token(f"{name}-forged") for forger in forgers]
        tokens.append(owner.liveliness().declare_token(name))  # one that nobody holds is gone at once
        watch = watching.liveliness().declare_subscriber(
            f"{ROOT}/{LIVE}/**", lambda sample: seen.put(str(sample.key_expr)), history=True
        )
        found = {seen.get(timeout=PATIENCE_S), *drained(seen, 0.3)}
        found |= {str(one.ok.key_expr) for one in watching.liveliness().get(f"{ROOT}/{LIVE}/**") if one.ok is not None}
        watch.undeclare()
        del tokens
    if found != {name}:
        raise Admitted(f"{sorted(found)} were seen")
    return "only the worker's own token was seen"


def twin_asked_for(site: Site) -> str:
    """Ask a worker to hand a twin over, as a viewer: the question alone would take the aircraft away."""
    name = fresh("@handover")
    with site.session("worker") as worker, site.session("viewer") as viewer, site.session("worker") as heir:
        return only_asked(worker, name, lambda: heir.get(name, payload=RIGHT), lambda: viewer.get(name, payload=FORGED))


def forged_answer(site: Site) -> str:
    """Answer a query for predictions, as a viewer."""
    name = fresh("prediction")

    def answering(said: bytes) -> Callable[[zenoh.Query], None]:
        def reply(query: zenoh.Query) -> None:
            with query:
                query.reply(name, said)

        return reply

    with site.session("worker") as worker, site.session("viewer") as viewer, site.session("tools") as tools:
        for session, said in ((viewer, FORGED), (worker, RIGHT)):
            session.declare_queryable(name, answering(said), complete=False)
        found: list[bytes] = []

        def ask() -> bool:
            every = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE, "timeout": 2.0}
            found.extend(one.ok.payload.to_bytes() for one in tools.get(name, **every) if one.ok is not None)
            return found.count(RIGHT) >= ROUNDS

        if not until(ask):
            raise Admitted(UNTRIED)
    if FORGED in found:
        raise Admitted("the forged answer came")
    return f"{len(found)} answers, all by the worker"


def withdrawn(site: Site) -> str:
    """Delete what another role published."""
    name = fresh("prediction")
    with site.session("worker") as worker, site.session("tools") as forger, site.session("viewer") as reader:
        return only_heard(reader, name, lambda: worker.put(name, RIGHT), lambda: forger.delete(name))


def strange_key(site: Site) -> str:
    """Publish on a key of no topic."""
    name = f"{ROOT}/{next(IDS)}"
    with site.session("gateway") as gateway, site.session("viewer") as reader:

        def right() -> None:
            gateway.put(f"{name}/sample", RIGHT)

        return only_heard(reader, f"{name}/**", right, lambda: gateway.put(f"{name}/trapdoor", FORGED))


def router_reconfigured(site: Site) -> str:
    """Read the router's own settings on the bus, and switch its access control off."""
    with site.session("tools") as tools:
        router = f"@/{tools.info.routers_zid()[0]}/router"
        if found := [str(one.ok.key_expr) for one in tools.get(f"{router}/**", timeout=0.5) if one.ok is not None]:
            raise Admitted(f"it read {found[:2]}")
        tools.put(f"{router}/config/access_control/enabled", b"false")
    return viewer_predicts(site)


BY_ROLE: tuple[Attempt, ...] = (
    viewer_predicts,
    _publishing("prediction", "gateway"),
    _publishing("sample", "worker"),
    _publishing("@gateway", "tools"),
    _publishing("@claim", "viewer"),
    *(_publishing("approval", role) for role in ("viewer", "tools", "worker", "gateway")),
    *(_publishing(topic, "operator") for topic in ("proposal", "execution")),
    *(forged_token, twin_asked_for, forged_answer, withdrawn, strange_key, router_reconfigured),
)
