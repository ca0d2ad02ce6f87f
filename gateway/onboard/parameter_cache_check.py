"""Verification of cached parameters, identified by the board number of the aircraft, before they are used."""

import random
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.autopilots.laws import NAMES
from fleet.telemetry.mavlink.aircraft_link import Craft
from fleet.telemetry.mavlink.microservices.params import HASH
from gateway.onboard.cache import Cache, Card
from gateway.onboard.dialects import ANY, DIALECTS

ASK_S = 1.0  # between two equal requests [s]
TRIES = 4  # unsuccessful attempts after which everything is requested again
AT_ONCE = 10  # parameters per request
OTHERS = 20  # parameters checked among those that no twin reads
FENCES = ("FENCE_", "GF_")


class Recall:
    """Check of cached parameters against the aircraft: by the hash over all, or by all relevant ones and a sample.

    Args:
        aircraft: the aircraft
        cache: parameters and missions of earlier connections
    """

    def __init__(self, craft: Craft, cache: Cache) -> None:
        self.over = False  # adopted, or rejected so that all parameters must be requested
        self._craft, self._cache = craft, cache
        self._to = (craft.system, craft.component)
        self._card: Card | None = None
        self._names: list[str] = []
        self._asked, self._tries, self._left = float("-inf"), 0, -1

    @property
    def key(self) -> str:
        """Return the cache key of the aircraft; empty if its board has no number."""
        craft = self._craft
        return f"{craft.autopilot}-{craft.board}-{craft.system}" if craft.board else ""

    def ask(self, now: float) -> list[Any]:
        """Return the messages to send now; `now` is fleet time [s since 1970]."""
        if self._card is None and self.key:
            self._begin(now)
        if not self.over and self._card is not None:
            self._judge(self._card)
        left = self._open()
        if self.over or (len(left) == self._left and now - self._asked < ASK_S):
            return []
        self._tries = self._tries + 1 if len(left) == self._left else 1
        self._asked, self._left = now, len(left)
        if self._tries > TRIES:
            self.over = True
            return []
        if self._card is None:
            version = (dialect.MAV_CMD_REQUEST_MESSAGE, 0, dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0, 0, 0, 0, 0, 0)
            return [dialect.MAVLink_command_long_message(*self._to, *version)]
        names = left[:AT_ONCE]
        return [dialect.MAVLink_param_request_read_message(*self._to, name.encode(), -1) for name in names]

    def keep(self) -> None:
        """Store parameters and mission in the cache, if complete."""
        book, route = self._craft.params, self._craft.route
        if self.key and book.complete:
            items = route.items if route.complete else ()
            self._cache.keep(self.key, Card(dict(book.values), book.count, book.hash, items))

    def _begin(self, now: float) -> None:
        card, row = self._cache.read(self.key), DIALECTS.get(self._craft.autopilot, ANY)
        if card is None or not card.values or (row.hash and card.hash is None):
            self.over = True
            return
        self._card, self._left = card, -1
        if row.probe:
            self._craft.route.recall(card.items)
        self._names = [row.hash] if row.hash else self._sample(card, row.fickle, now)

    def _sample(self, card: Card, fickle: tuple[str, ...], now: float) -> list[str]:
        """Return every parameter that a twin reads, and a random sample of the others."""
        steady = [name for name in sorted(card.values) if not name.startswith(fickle or "\0")]
        vital = [name for name in steady if name in NAMES or name.startswith(FENCES)]
        others = sorted(set(steady).difference(vital))
        return vital + random.Random(now).sample(others, min(OTHERS, len(others)))

    def _open(self) -> list[str]:
        """Return the parameters not yet received that the check needs."""
        book = self._craft.params
        heard = {HASH} if book.hash is not None else set()
        return [name for name in self._names if name not in heard and name not in book.values]

    def _judge(self, card: Card) -> None:
        book = self._craft.params
        same = all(book.values[name] == card.values[name] for name in self._names if name in book.values)
        same &= book.hash in (None, card.hash) and (not book.count or HASH in self._names or book.count == card.count)
        if not same:
            self.over = True  # another aircraft, or changed since
        elif not self._open():
            book.adopt(card.values | book.values, card.count)
            self.over = True
