"""Convert boot time to fleet time: slewed offset, wrap correction, jump detection. Compiled.

fleet = boot + offset, and offset = min(arrival - boot) over the last 15 to 30 s: the message with the least
delay gives the best estimate. Source: minimum-delay filter as in NTP (RFC 5905, section 10). The offset is slewed. A
clock that falls behind faster (a slow or paused simulator) is re-anchored, forward only.
"""

from math import inf, isnan, nan

import numba as nb
import numpy as np

WRAP_BOOT_S = 2**32 * 1e-3  # time_boot_ms [s]
WRAP_USEC_S = 2**32 * 1e-6  # time_usec truncated to 32 bit [s]
BACK_S = 1.0  # a larger step back is a jump, not a late message [s]
LEAP_S = 2.0  # a larger lead over arrival is a jump [s]
CONFIRM = 3  # consecutive messages that confirm a jump
WARM_UP_S = 1.0  # time after an anchor in which the offset may step [s]
BUCKET_S = 15.0  # length of a bucket; the minimum covers one to two buckets [s]
LATELY = 0.01  # weight of the newest delay in the mean
SLEW = 2e-3  # maximum slew rate of the offset [s/s]
SLEW_FAST = 0.1  # the same for an offset error above the next limit [s/s]
PLAIN_S = 0.25  # offset error above which the fast slew applies [s]
BEHIND_S = 1.0  # minimum delay of a window above which the offset is re-anchored [s]

(
    OFFSET,  # fleet time minus message time [s]
    NEWEST,  # newest unwrapped message time; nan before the first [s]
    JUMPS,  # number of detected jumps
    WRAP,  # wrap period of the message time; 0: none [s]
    ARRIVAL,  # arrival of the newest message
    ANCHORED,  # arrival at the last anchor
    LATEST,  # newest fleet time returned
    SUSPECTS,  # consecutive messages that indicate a jump
    LEAST,  # minimum delay of this bucket [s]
    LEAST_BEFORE,  # minimum delay of the previous bucket [s]
    BUCKET,  # arrival at the start of this bucket
    DELAY,  # smoothed arrival minus fleet time [s]
    WORST,  # maximum since the last reset [s]
    ADVANCE,  # sum of the forward re-anchoring steps [s]
    LENGTH,
) = range(15)
BOOT, USEC, USEC32, NONE = range(4)
"""Time source of a message: time_boot_ms, time_usec, time_usec truncated to 32 bit, none."""


def new_clock(wrap_s: float = 0.0) -> np.ndarray:
    """Return the initial state of one clock, (STATE_SIZE,)."""
    clock = np.zeros(LENGTH)
    clock[NEWEST], clock[LATEST], clock[WRAP] = nan, -inf, wrap_s
    return clock


def new_clocks() -> np.ndarray:
    """Return the clocks of one aircraft, (3, STATE_SIZE): boot, and two for `time_usec` not counted from boot."""
    return np.stack([new_clock(WRAP_BOOT_S), new_clock(), new_clock(WRAP_USEC_S)])


@nb.njit(cache=True)
def read(clock, raw_s, arrival, latest):
    """Return the fleet time of a message [s since 1970]; nan while a jump is suspected.

    Args:
        clock: state, changed in place, (STATE_SIZE,)
        raw_s: time stamp of the message [s]
        arrival: when it arrived, fleet clock [s since 1970]
        latest: newest fleet time returned; a new anchor is later [s since 1970]
    """
    if isnan(clock[NEWEST]):
        return _anchor(clock, raw_s, arrival, latest)
    own = unwrap(clock, raw_s)
    step, passed = own - clock[NEWEST], arrival - clock[ARRIVAL]
    if step < -BACK_S or step > passed + LEAP_S:
        clock[SUSPECTS] += 1
        if clock[SUSPECTS] < CONFIRM:
            return nan
        clock[JUMPS] += 1
        return _anchor(clock, raw_s, arrival, max(latest, clock[LATEST]))
    clock[SUSPECTS] = 0
    if step > 0:
        _follow(clock, arrival - own, arrival, passed)
        clock[NEWEST], clock[ARRIVAL] = own, arrival
        delay = max(arrival - own - clock[OFFSET], 0.0)
        clock[DELAY] += LATELY * (delay - clock[DELAY])
        clock[WORST] = max(clock[WORST], delay)
    return _at(clock, own)


@nb.njit(cache=True)
def unwrap(clock, raw_s):
    """Unwrap a message time to the value nearest to the newest one [s]."""
    if clock[WRAP] == 0.0 or isnan(clock[NEWEST]):
        return raw_s
    return raw_s + np.rint((clock[NEWEST] - raw_s) / clock[WRAP]) * clock[WRAP]


@nb.njit(cache=True)
def _at(clock, own_s):
    t = own_s + clock[OFFSET]
    clock[LATEST] = max(clock[LATEST], t)
    return t


@nb.njit(cache=True)
def now(clock, arrival):
    """Return the fleet time of a message without time stamp: the newest, extrapolated by at most 0.5 s."""
    if isnan(clock[NEWEST]):
        clock[LATEST] = max(clock[LATEST], arrival)
        return arrival
    return _at(clock, clock[NEWEST] + min(max(arrival - clock[ARRIVAL], 0.0), 0.5))


@nb.njit(cache=True)
def _anchor(clock, own, arrival, latest):
    clock[OFFSET] = max(arrival, latest + 1e-3) - own
    clock[NEWEST], clock[ARRIVAL], clock[ANCHORED], clock[BUCKET] = own, arrival, arrival, arrival
    clock[LEAST], clock[LEAST_BEFORE], clock[SUSPECTS] = arrival - own, arrival - own, 0
    return _at(clock, own)


@nb.njit(cache=True)
def _follow(clock, delay, arrival, passed):
    if arrival - clock[BUCKET] > BUCKET_S:
        clock[LEAST_BEFORE], clock[LEAST], clock[BUCKET] = clock[LEAST], delay, arrival
    clock[LEAST] = min(clock[LEAST], delay)
    least = min(clock[LEAST], clock[LEAST_BEFORE])
    error = least - clock[OFFSET]
    if error > BEHIND_S:
        anchor = max(least, delay - BEHIND_S)  # the minimum may be 30 s old, the newest delay an outlier
        clock[ADVANCE] += anchor - clock[OFFSET]
        clock[OFFSET], clock[LEAST], clock[LEAST_BEFORE] = anchor, delay, delay
        clock[ANCHORED] = clock[BUCKET] = arrival
        return
    if arrival - clock[ANCHORED] < WARM_UP_S:
        clock[OFFSET] += min(error, 0.0)
        return
    most = max(passed, 0.0) * (SLEW_FAST if error < -PLAIN_S else SLEW)
    clock[OFFSET] += min(max(error, -most), most)


@nb.njit(cache=True)
def tell(clocks, tick, raw_s, arrival):
    """Return the fleet time of one message of an aircraft [s since 1970]; nan while a jump is suspected.

    Args:
        clocks: states, changed in place, (3, STATE_SIZE)
        tick: BOOT, USEC, USEC32 or NONE
        raw_s: time stamp of the message [s]
        arrival: when it arrived, fleet clock [s since 1970]
    """
    boot = clocks[BOOT]
    latest = max(clocks[BOOT, LATEST], clocks[USEC, LATEST], clocks[USEC32, LATEST])
    if tick == NONE:
        return now(boot, arrival)
    if tick == BOOT:
        return read(boot, raw_s, arrival, latest)
    if not isnan(boot[NEWEST]):
        own = raw_s
        if tick == USEC32:
            own += np.rint((boot[NEWEST] - raw_s) / WRAP_USEC_S) * WRAP_USEC_S
        if abs(own - boot[NEWEST]) < BACK_S:
            return _at(boot, own)
    return read(clocks[tick], raw_s, arrival, latest)


def jumps(clocks: np.ndarray) -> int:
    """Return the number of detected jumps."""
    return int(clocks[:, JUMPS].max())
