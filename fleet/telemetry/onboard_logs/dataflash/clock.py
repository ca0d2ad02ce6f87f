"""The clock of a DataFlash log: gives every message its log time, and refuses times that damage made.

Logs since 2015 stamp all (TimeUS), those before most (TimeMS), those of 2014 little but satellite fixes: there,
messages of a steady rate are counted between the fixes, and an event has the time of the last stamp before it.
"""

from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fleet.telemetry.onboard_logs.dataflash.records import Damage, Format, Records

LEAP_S = 1.0  # a stamp further from its neighbours in the file is damage
BACK_S = 5.0  # further back than this from the newest: another start in the same file
LONGEST_GAP_S = 86_400.0
PERIOD_S = 0.1  # of messages without time, where no stamp tells
PAUSE_S = 30.0  # so long may the log pause where a block ends and nothing can confirm it
_REACH, _QUORUM = 5, 3  # neighbours asked on each side, and how few will do


def stamp_of(form: Format, weekly: bool = False) -> tuple[str, float] | None:
    """Name the column that holds the time since boot, and its seconds.

    Args:
        form: of the messages
        weekly: nothing in this log tells the time since boot, so the satellites' time of the week serves
    """
    if "TimeUS" in form.columns:
        return "TimeUS", 1e-6
    if form.name.startswith("GPS"):
        names = ("T", "TimeMS", "Time") if weekly else ("T",)  # its TimeMS is the week's, not ours
        return next(((name, 1e-3) for name in names if name in form.columns), None)
    return ("TimeMS", 1e-3) if form.columns[:1] == ("TimeMS",) else None


class Clock:
    """Stamp the messages of one reading, block after block."""

    def __init__(self, damage: Damage, counted: frozenset[str], start: float = 0.0, weekly: bool = False) -> None:
        self.start = start  # of what stands before the first stamp [s]
        self.newest = float("-inf")  # [s]
        self.first: float | None = None  # first stamp [s]
        self._damage = damage
        self._counted = counted  # names of a steady rate, should they carry no time
        self._weekly = weekly
        self._recent = np.zeros(0)  # the last good stamps, in the order of the file
        self._anchor: tuple[float, float] | None = None  # (place, time) of the last stamp
        self._held: dict[Format, Records] = {}  # counted, waiting for the stamp after them

    def stamp(self, block: list[Records], last: bool = False) -> list[Records]:
        """Return the messages of a block, stamped; those counted since the last stamp come with the next block."""
        timed, rest = self._own([r for r in block if r.form.name != "FMT"])
        places, times = self._sound(timed)
        timed = [r for r in timed if len(r)]
        fresh = len(places) > 0
        if self._anchor is not None:
            places, times = np.append(self._anchor[0], places), np.append(self._anchor[1], times)
        counted = [r for r in rest if r.form.name in self._counted]
        events = [r for r in rest if r.form.name not in self._counted]
        for r in events:
            at = np.searchsorted(places, r.place)
            r.t = np.append(self.first if self.first is not None else self.start, times)[at]
        found = [r for r in self._count(counted, places, times, last or not fresh) if len(r)]
        if fresh:
            self._anchor = (float(places[-1]), float(times[-1]))
        elif found:
            self._anchor = max((float(r.place[-1]), float(r.t[-1])) for r in found)
        return timed + events + found

    def _own(self, block: list[Records]) -> tuple[list[Records], list[Records]]:
        """Separate those with a stamp of their own from those without."""
        timed, rest = [], []
        for r in block:
            stamp = stamp_of(r.form, self._weekly)
            if stamp is None:
                rest.append(r)
            else:
                r.t = getattr(r, stamp[0]) * stamp[1]
                timed.append(r)
        return timed, rest

    def _sound(self, timed: list[Records]) -> tuple[np.ndarray, np.ndarray]:
        """Drop messages whose stamp cannot be; return place and time of the others, in the order of the file."""
        if not timed:
            return np.zeros(0), np.zeros(0)
        place = np.concatenate([r.place for r in timed]).astype(float)
        t = np.concatenate([r.t for r in timed])
        order = np.argsort(place, kind="stable")
        good = np.empty(len(t), bool)
        good[order] = self._believed(t[order], place[order])
        stops = np.cumsum([len(r) for r in timed])
        for i, (r, stop) in enumerate(zip(timed, stops, strict=True)):
            mask = good[stop - len(r) : stop]
            if not mask.all():
                timed[i] = r.taken(mask)
        order = order[good[order]]
        return place[order], np.maximum.accumulate(t[order])

    def _believed(self, t: np.ndarray, place: np.ndarray) -> np.ndarray:
        known = np.where(np.isfinite(t), t, -1.0)
        before, after = neighbours(np.concatenate([self._recent, known]))
        before, after = before[len(self._recent) :], after[len(self._recent) :]
        unconfirmed = np.isfinite(before) & ~np.isfinite(after)
        latest = np.where(unconfirmed, before + PAUSE_S, after + LEAP_S)
        leaps = (known < before - LEAP_S) | (known > latest) | (known < 0)
        back = ~leaps & (known < self.newest - BACK_S)
        if np.isfinite(self.newest):
            leaps |= known > self.newest + LONGEST_GAP_S
        for kind, bad in (("messages whose time leaps", leaps), ("messages from before, as of another start", back)):
            if bad.any():
                self._damage.note(kind, int(place[np.argmax(bad)]), int(bad.sum()))
        good = ~leaps & ~back
        if good.any():
            self.newest = max(self.newest, float(known[good].max()))
            self.first = float(known[good][0]) if self.first is None else self.first
            self._recent = np.append(self._recent, known[good])[-_REACH:]
        return good

    def _count(self, counted: list[Records], places: np.ndarray, times: np.ndarray, final: bool) -> Iterator[Records]:
        for r in counted:
            held = self._held.pop(r.form, None)
            self._held[r.form] = r if held is None else held.and_then(r)
        if not len(places):  # no stamp at all: count from before the file
            places, times = np.array([-1.0]), np.array([self.start])
        for form, r in list(self._held.items()):
            n = len(r) if final else int(np.searchsorted(r.place, places[-1]))
            t = counted_times(r.place, places, times)
            ready = r.taken(np.arange(n))
            ready.t = t[:n]
            yield ready
            del self._held[form]
            if n < len(r):
                self._held[form] = r.taken(np.arange(n, len(r)))


def neighbours(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each stamp the median of those before and of those after it; infinite where there are too few."""
    n = len(t)
    before, after = np.full(n, -np.inf), np.full(n, np.inf)
    if n > _REACH:
        middle = np.sort(sliding_window_view(t, _REACH), axis=-1)[:, _REACH // 2]
        before[_REACH:], after[:-_REACH] = middle[:-1], middle[1:]
    for few in range(_QUORUM, min(_REACH, n)):
        before[few], after[n - 1 - few] = np.median(t[:few]), np.median(t[n - few :])
    return before, after


def counted_times(place: np.ndarray, places: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Spread messages of a steady rate between the stamps around them.

    Args:
        place: where they stand in the file, rising, (n,)
        places: where stamps stand, rising, (m,), m >= 1
        times: what those say, rising, (m,) [s]
    Returns:
        their times (n,) [s]
    """
    before = np.searchsorted(place, places)  # messages before each stamp
    u, first = np.unique(before, return_index=True)
    last = np.append(first[1:], len(before)) - 1
    k = np.arange(len(place))
    low = np.searchsorted(u, k, side="right") - 1
    high = np.minimum(low + 1, len(u) - 1)
    since = k + 0.5 - u[np.maximum(low, 0)]
    span = np.where(high > low, u[high] - u[np.maximum(low, 0)], 1)
    step = np.where(high > low, (times[first[high]] - times[last[np.maximum(low, 0)]]) / np.maximum(span, 1), PERIOD_S)
    step = np.where(low < 0, PERIOD_S, step)
    start = np.where(low < 0, times[first[0]], times[last[np.maximum(low, 0)]])
    return start + since * step
