"""Clock of a DataFlash log: assign a log time to every message, and reject times corrupted by damage.

Logs since 2015 stamp all messages (TimeUS), earlier ones most (TimeMS), those of 2014 hardly more than GPS fixes: their
messages of constant rate are interpolated between the fixes, and an event gets the time of the last stamp before it.
"""

from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fleet.telemetry.onboard_logs.dataflash.records import Damage, Format, Records

LEAP_S = 1.0  # a stamp further from its neighbours in the file is damaged [s]
BACK_S = 5.0  # a larger step back is another start in the same file [s]
LONGEST_GAP_S = 86_400.0
PERIOD_S = 0.1  # period of messages without time or stamps around them [s]
PAUSE_S = 30.0  # longest pause at the end of a block, where later stamps are missing [s]
_REACH, _QUORUM = 5, 3  # neighbours compared on each side, and their minimum number


def stamp_of(form: Format, weekly: bool = False) -> tuple[str, float] | None:
    """Return the column of the time since boot and its unit [s].

    Args:
        form: format of the messages
        use_gps_week: use the GPS time of the week, for logs without time since boot
    """
    if "TimeUS" in form.columns:
        return "TimeUS", 1e-6
    if form.name.startswith("GPS"):
        names = ("T", "TimeMS", "Time") if weekly else ("T",)  # TimeMS of GPS is the time of the week
        return next(((name, 1e-3) for name in names if name in form.columns), None)
    return ("TimeMS", 1e-3) if form.columns[:1] == ("TimeMS",) else None


class Clock:
    """Assign times to the messages of one pass, block by block."""

    def __init__(self, damage: Damage, counted: frozenset[str], start: float = 0.0, weekly: bool = False) -> None:
        self.start = start  # time of messages before the first stamp [s]
        self.newest = float("-inf")  # [s]
        self.first: float | None = None  # first stamp [s]
        self._damage = damage
        self._counted = counted  # messages of constant rate that may have no time
        self._weekly = weekly
        self._recent = np.zeros(0)  # last valid stamps, in file order
        self._anchor: tuple[float, float] | None = None  # (place, time) of the last stamp
        self._held: dict[Format, Records] = {}  # counted messages before their next stamp

    def stamp(self, block: list[Records], last: bool = False) -> list[Records]:
        """Return the stamped messages of a block; counted ones after the last stamp follow with the next block."""
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
        """Separate records with time stamp from those without."""
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
        """Drop messages with implausible stamps; return position and time of the others in file order."""
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
        if not len(places):  # no stamp: count from the start of the file
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
    """Return for each stamp the medians of the stamps before and after it; infinite with too few neighbours."""
    n = len(t)
    before, after = np.full(n, -np.inf), np.full(n, np.inf)
    if n > _REACH:
        middle = np.sort(sliding_window_view(t, _REACH), axis=-1)[:, _REACH // 2]
        before[_REACH:], after[:-_REACH] = middle[:-1], middle[1:]
    for few in range(_QUORUM, min(_REACH, n)):
        before[few], after[n - 1 - few] = np.median(t[:few]), np.median(t[n - few :])
    return before, after


def counted_times(place: np.ndarray, places: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Interpolate the times of messages of constant rate between stamps.

    Args:
        place: positions of the messages in the file, increasing, (n,)
        places: positions of the stamps, increasing, (m,), m >= 1
        times: times of the stamps, increasing, (m,) [s]
    Returns:
        times of the messages, (n,) [s]
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
