"""Parameters an aircraft told before: found again by its board, believed only once they are checked."""

import random
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.autopilots.laws import NAMES
from fleet.telemetry.mavlink.aircraft_link import Craft
from fleet.telemetry.mavlink.microservices.params import HASH
from gateway.onboard.cache import Cache, Card
from gateway.onboard.dialects import ANY, DIALECTS

ASK_S = 1.0  # between two questions of the same [s]
TRIES = 4  # in vain, then everything is asked for anew
AT_ONCE = 10  # parameters
OTHERS = 20  # looked at, of those no twin reads
FENCES = ("FENCE_", "GF_")


class Recall:
    """The way from a board's number to parameters in force: the hash over all, or every one that matters and some more.

    Args:
        craft: the aircraft
        cache: what aircraft told before
    """

    def __init__(self, craft: Craft, cache: Cache) -> None:
        self.over = False  # adopted, or to be asked for as if nothing were known
        self._craft, self._cache = craft, cache
        self._to = (craft.system, craft.component)
        self._card: Card | None = None
        self._names: list[str] = []
        self._asked, self._tries, self._left = float("-inf"), 0, -1

    @property
    def key(self) -> str:
        """Name the aircraft's file; empty where its board has no number."""
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
        """Keep what is known whole by now."""
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
        """Name every parameter a twin reads and some of the others, every time other ones."""
        steady = [name for name in sorted(card.values) if not name.startswith(fickle or "\0")]
        vital = [name for name in steady if name in NAMES or name.startswith(FENCES)]
        others = sorted(set(steady).difference(vital))
        return vital + random.Random(now).sample(others, min(OTHERS, len(others)))

    def _open(self) -> list[str]:
        """List what has to be heard before anything can be believed."""
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
