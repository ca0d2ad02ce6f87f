"""Clock of a DataFlash log: assign a log time to every message, and reject times corrupted by damage.

Logs since 2015 stamp all messages (TimeUS), earlier ones most (TimeMS), those of 2014 hardly more than GPS fixes: their
messages of constant rate are interpolated between the fixes, and an event gets the time of the last stamp before it.
"""

from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fleet.telemetry.onboard_logs.dataflash.records import Damage, Format, Records

MAX_LEAP_S = 1.0  # a stamp further from its neighbours in the file is damaged [s]
MAX_STEP_BACK_S = 5.0  # a larger step back is another start in the same file [s]
MAX_GAP_S = 86_400.0
DEFAULT_PERIOD_S = 0.1  # period of messages without time or stamps around them [s]
MAX_PAUSE_S = 30.0  # longest pause at the end of a block, where later stamps are missing [s]
_NEIGHBOURS, _MIN_NEIGHBOURS = 5, 3  # neighbours compared on each side, and their minimum number


def time_column(form: Format, use_gps_week: bool = False) -> tuple[str, float] | None:
    """Return the column of the time since boot and its unit [s].

    Args:
        form: format of the messages
        use_gps_week: use the GPS time of the week, for logs without time since boot
    """
    if "TimeUS" in form.columns:
        return "TimeUS", 1e-6
    if form.name.startswith("GPS"):
        names = ("T", "TimeMS", "Time") if use_gps_week else ("T",)  # TimeMS of GPS is the time of the week
        return next(((name, 1e-3) for name in names if name in form.columns), None)
    return ("TimeMS", 1e-3) if form.columns[:1] == ("TimeMS",) else None


class LogClock:
    """Assign times to the messages of one pass, block by block."""

    def __init__(
        self, damage: Damage, counted: frozenset[str], start_t: float = 0.0, use_gps_week: bool = False
    ) -> None:
        self.start_t = start_t  # time of messages before the first stamp [s]
        self.newest_t = float("-inf")  # [s]
        self.first_t: float | None = None  # first stamp [s]
        self._damage = damage
        self._counted = counted  # messages of constant rate that may have no time
        self._use_gps_week = use_gps_week
        self._recent = np.zeros(0)  # last valid stamps, in file order
        self._anchor: tuple[float, float] | None = None  # (place, time) of the last stamp
        self._waiting: dict[Format, Records] = {}  # counted messages before their next stamp

    def stamp(self, block: list[Records], last: bool = False) -> list[Records]:
        """Return the stamped messages of a block; counted ones after the last stamp follow with the next block."""
        timed, untimed = self._split_by_stamp([records for records in block if records.format_.name != "FMT"])
        places, times = self._drop_implausible(timed)
        timed = [r for r in timed if len(r)]
        has_stamps = len(places) > 0
        if self._anchor is not None:
            places, times = np.append(self._anchor[0], places), np.append(self._anchor[1], times)
        counted = [r for r in untimed if r.format_.name in self._counted]
        events = [r for r in untimed if r.format_.name not in self._counted]
        for r in events:
            index = np.searchsorted(places, r.place)
            r.t = np.append(self.first_t if self.first_t is not None else self.start_t, times)[index]
        interpolated = [r for r in self._interpolate_counted(counted, places, times, last or not has_stamps) if len(r)]
        if has_stamps:
            self._anchor = (float(places[-1]), float(times[-1]))
        elif interpolated:
            self._anchor = max((float(r.place[-1]), float(r.t[-1])) for r in interpolated)
        return timed + events + interpolated

    def _split_by_stamp(self, block: list[Records]) -> tuple[list[Records], list[Records]]:
        """Separate records with time stamp from those without."""
        timed, untimed = [], []
        for records in block:
            stamp = time_column(records.format_, self._use_gps_week)
            if stamp is None:
                untimed.append(records)
            else:
                records.t = getattr(records, stamp[0]) * stamp[1]
                timed.append(records)
        return timed, untimed

    def _drop_implausible(self, timed: list[Records]) -> tuple[np.ndarray, np.ndarray]:
        """Drop messages with implausible stamps; return position and time of the others in file order."""
        if not timed:
            return np.zeros(0), np.zeros(0)
        place = np.concatenate([records.place for records in timed]).astype(float)
        t = np.concatenate([r.t for r in timed])
        order = np.argsort(place, kind="stable")
        valid = np.empty(len(t), bool)
        valid[order] = self._plausible(t[order], place[order])
        stops = np.cumsum([len(r) for r in timed])
        for i, (r, stop) in enumerate(zip(timed, stops, strict=True)):
            mask = valid[stop - len(r) : stop]
            if not mask.all():
                timed[i] = r.select(mask)
        order = order[valid[order]]
        return place[order], np.maximum.accumulate(t[order])

    def _plausible(self, t: np.ndarray, place: np.ndarray) -> np.ndarray:
        finite_t = np.where(np.isfinite(t), t, -1.0)
        before, after = neighbour_medians(np.concatenate([self._recent, finite_t]))
        before, after = before[len(self._recent) :], after[len(self._recent) :]
        unconfirmed = np.isfinite(before) & ~np.isfinite(after)
        latest = np.where(unconfirmed, before + MAX_PAUSE_S, after + MAX_LEAP_S)
        leaps = (finite_t < before - MAX_LEAP_S) | (finite_t > latest) | (finite_t < 0)
        back = ~leaps & (finite_t < self.newest_t - MAX_STEP_BACK_S)
        if np.isfinite(self.newest_t):
            leaps |= finite_t > self.newest_t + MAX_GAP_S
        for kind, rejected in (
            ("messages whose time leaps", leaps),
            ("messages from before, as of another start", back),
        ):
            if rejected.any():
                self._damage.count(kind, int(place[np.argmax(rejected)]), int(rejected.sum()))
        valid = ~leaps & ~back
        if valid.any():
            self.newest_t = max(self.newest_t, float(finite_t[valid].max()))
            self.first_t = float(finite_t[valid][0]) if self.first_t is None else self.first_t
            self._recent = np.append(self._recent, finite_t[valid])[-_NEIGHBOURS:]
        return valid

    def _interpolate_counted(
        self, counted: list[Records], places: np.ndarray, times: np.ndarray, final: bool
    ) -> Iterator[Records]:
        for records in counted:
            earlier = self._waiting.pop(records.format_, None)
            self._waiting[records.format_] = records if earlier is None else earlier.append(records)
        if not len(places):  # no stamp: count from the start of the file
            places, times = np.array([-1.0]), np.array([self.start_t])
        for form, records in list(self._waiting.items()):
            ready_count = len(records) if final else int(np.searchsorted(records.place, places[-1]))
            t = counted_times(records.place, places, times)
            ready = records.select(np.arange(ready_count))
            ready.t = t[:ready_count]
            yield ready
            del self._waiting[form]
            if ready_count < len(records):
                self._waiting[form] = records.select(np.arange(ready_count, len(records)))


def neighbour_medians(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each stamp the medians of the stamps before and after it; infinite with too few neighbours."""
    n = len(t)
    before, after = np.full(n, -np.inf), np.full(n, np.inf)
    if n > _NEIGHBOURS:
        medians = np.sort(sliding_window_view(t, _NEIGHBOURS), axis=-1)[:, _NEIGHBOURS // 2]
        before[_NEIGHBOURS:], after[:-_NEIGHBOURS] = medians[:-1], medians[1:]
    for count in range(_MIN_NEIGHBOURS, min(_NEIGHBOURS, n)):
        before[count], after[n - 1 - count] = np.median(t[:count]), np.median(t[n - count :])
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
    groups, first = np.unique(before, return_index=True)
    last = np.append(first[1:], len(before)) - 1
    index = np.arange(len(place))
    low = np.searchsorted(groups, index, side="right") - 1
    high = np.minimum(low + 1, len(groups) - 1)
    since = index + 0.5 - groups[np.maximum(low, 0)]
    span = np.where(high > low, groups[high] - groups[np.maximum(low, 0)], 1)
    step = np.where(
        high > low, (times[first[high]] - times[last[np.maximum(low, 0)]]) / np.maximum(span, 1), DEFAULT_PERIOD_S
    )
    step = np.where(low < 0, DEFAULT_PERIOD_S, step)
    start = np.where(low < 0, times[first[0]], times[last[np.maximum(low, 0)]])
    return start + since * step
