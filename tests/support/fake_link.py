"""A link without a thread, for tests of what stands between links; and patience for those that have one."""

import threading
from collections import defaultdict

from fleet.process import logs
from gateway.__main__ import COMPILING
from gateway.link_spec import read_spec
from gateway.links.link import Batch
from tests.support.talker import Ears

PATIENCE_S = 60.0  # an upper bound; every wait ends with its condition


def beside_compiling(errors: str) -> str:
    """Give what a gateway said on standard error, but for what it says of compiling on a cold or busy machine."""
    return "".join(line for line in untimed(errors) if line != f"gateway: {COMPILING}\n")


def untimed(log: str) -> list[str]:
    """Give the lines of a log without their times; every line has one."""
    found = [logs.strip_time(line) for line in log.splitlines(keepends=True)]
    assert all(one != line for one, line in zip(found, log.splitlines(keepends=True), strict=True)), log
    return found


class FakeLink:
    """It remembers what was sent, and to whom."""

    def __init__(self, text: str = "udpin:127.0.0.1:1", known_peers: tuple = ()):
        self.spec = read_spec(text)
        self.dropped = self.unsent = 0
        self.known_peers = known_peers
        self.sent: list = []

    def start(self, number, out, stop):
        out.put(Batch(number, ended=True))

    def send(self, where, data, messages=1):
        self.sent.append((where, data))

    def close(self):
        pass

    def told(self) -> dict:
        """Names of the messages sent to each far end since the last time."""
        names = defaultdict(list)
        for where, data in self.sent:
            names[where] += [message.get_type() for message in Ears().feed(data)]
        self.sent.clear()
        return dict(names)


def until(condition):
    """Wait for a condition, looking every few milliseconds."""
    event, waited = threading.Event(), 0.0
    while not (found := condition()):
        event.wait(0.005)
        waited += 0.005
        assert waited < PATIENCE_S, "waited in vain"
    return found


def pieces(heard) -> list:
    """Give what was heard piece by piece: arrival, sender, bytes."""
    cut = zip(heard.start.tolist(), heard.stop.tolist(), strict=True)
    return [
        (heard.arrival[i], heard.senders[heard.sender[i]], heard.buf[a:b].tobytes()) for i, (a, b) in enumerate(cut)
    ]
