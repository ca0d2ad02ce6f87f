"""Boot time to fleet time: an offset with slow drift, wraps undone, jumps noticed and survived.

fleet = boot + offset, and offset = min(arrival - boot) over the last half minute: the message that travelled
fastest tells the offset best. Source: minimum-delay filter as in NTP (RFC 5905, section 10).
"""

from fleet.telemetry.dialects.mavlink import Tick

WRAP_BOOT_S = 2**32 * 1e-3  # time_boot_ms [s]
WRAP_USEC_S = 2**32 * 1e-6  # time_usec cut to 32 bit [s]
BACK_S = 1.0  # going back further than this is a jump, not a late message [s]
LEAP_S = 2.0  # getting ahead of arrival further than this is a jump [s]
CONFIRM = 3  # messages in a row that must agree on a jump
WARM_UP_S = 1.0  # the offset may still step [s]
BUCKET_S = 15.0  # the minimum is over one to two of these [s]
SLEW = 2e-3  # drift the offset may follow [s/s]
SLEW_FAST = 0.1  # when the offset is plainly too late [s/s]
PLAIN_S = 0.25  # what is plainly [s]


class Clock:
    """Map one clock of one aircraft to fleet time."""

    def __init__(self, wrap_s: float = 0.0) -> None:
        self.offset_s = 0.0
        self.jumps = 0
        self.newest_s: float | None = None  # newest own time, wraps undone [s]
        self._wrap_s = wrap_s
        self._arrival = 0.0  # of the newest
        self._anchored = 0.0
        self._latest = float("-inf")  # newest fleet time given out
        self._suspects = 0
        self._least = self._least_before = 0.0
        self._bucket = 0.0

    def fleet(self, raw_s: float, arrival: float, latest: float = float("-inf")) -> float | None:
        """Give the fleet time of a message [s since 1970]; None while a jump is suspected.

        Args:
            raw_s: the message's own time [s]
            arrival: when it arrived, fleet clock [s since 1970]
            latest: newest fleet time already published; a new anchor never lies before it [s since 1970]
        """
        if self.newest_s is None:
            return self._anchor(raw_s, arrival, latest)
        own = self.unwrap(raw_s)
        step, passed = own - self.newest_s, arrival - self._arrival
        if step < -BACK_S or step > passed + LEAP_S:
            self._suspects += 1
            if self._suspects < CONFIRM:
                return None
            self.jumps += 1
            return self._anchor(raw_s, arrival, max(latest, self._latest))
        self._suspects = 0
        if step > 0:
            self._follow(arrival - own, arrival, passed)
            self.newest_s, self._arrival = own, arrival
        return self.at(own)

    def unwrap(self, raw_s: float) -> float:
        """Undo wraps: the value nearest to the newest own time [s]."""
        if not self._wrap_s or self.newest_s is None:
            return raw_s
        return raw_s + round((self.newest_s - raw_s) / self._wrap_s) * self._wrap_s

    def at(self, own_s: float) -> float:
        """Map an own time with its wraps undone, learning nothing from it."""
        t = own_s + self.offset_s
        self._latest = max(self._latest, t)
        return t

    def now(self, arrival: float) -> float:
        """Give the fleet time of a message without a time of its own: the newest, moved on by at most 0.5 s."""
        if self.newest_s is None:
            return arrival
        return self.at(self.newest_s + min(max(arrival - self._arrival, 0.0), 0.5))

    def _anchor(self, own: float, arrival: float, latest: float) -> float:
        self.offset_s = max(arrival, latest + 1e-3) - own
        self.newest_s, self._arrival, self._anchored, self._bucket = own, arrival, arrival, arrival
        self._least = self._least_before = arrival - own
        self._suspects = 0
        return self.at(own)

    def _follow(self, delay: float, arrival: float, passed: float) -> None:
        if arrival - self._bucket > BUCKET_S:
            self._least_before, self._least, self._bucket = self._least, delay, arrival
        self._least = min(self._least, delay)
        error = min(self._least, self._least_before) - self.offset_s
        if arrival - self._anchored < WARM_UP_S:
            self.offset_s += min(error, 0.0)
            return
        most = max(passed, 0.0) * (SLEW_FAST if error < -PLAIN_S else SLEW)
        self.offset_s += min(max(error, -most), most)


class Clocks:
    """The clocks of one aircraft: boot, and those of `time_usec` where it does not count from boot."""

    def __init__(self) -> None:
        self.boot = Clock(WRAP_BOOT_S)
        self._usec = {Tick.USEC: Clock(), Tick.USEC32: Clock(WRAP_USEC_S)}
        self._latest = float("-inf")

    @property
    def jumps(self) -> int:
        """Count the jumps noticed."""
        return max(clock.jumps for clock in (self.boot, *self._usec.values()))

    def fleet(self, tick: Tick, raw_s: float, arrival: float) -> float | None:
        """Give the fleet time of a message [s since 1970]; None while a jump is suspected."""
        t = self._fleet(tick, raw_s, arrival)
        if t is not None:
            self._latest = max(self._latest, t)
        return t

    def _fleet(self, tick: Tick, raw_s: float, arrival: float) -> float | None:
        if tick is Tick.NONE:
            return self.boot.now(arrival)
        if tick is Tick.BOOT_MS:
            return self.boot.fleet(raw_s, arrival, self._latest)
        if self.boot.newest_s is not None:
            own = raw_s
            if tick is Tick.USEC32:
                own += round((self.boot.newest_s - raw_s) / WRAP_USEC_S) * WRAP_USEC_S
            if abs(own - self.boot.newest_s) < BACK_S:
                return self.boot.at(own)
        return self._usec[tick].fleet(raw_s, arrival, self._latest)
