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
MAX_STEP_BACK_S = 1.0  # a larger step back is a jump, not a late message [s]
MAX_LEAP_S = 2.0  # a larger lead over arrival is a jump [s]
CONFIRM_COUNT = 3  # consecutive messages that confirm a jump
WARM_UP_S = 1.0  # time after an anchor in which the offset may step [s]
BUCKET_S = 15.0  # length of a bucket; the minimum covers one to two buckets [s]
DELAY_SMOOTHING = 0.01  # weight of the newest delay in the mean
SLEW = 2e-3  # maximum slew rate of the offset [s/s]
SLEW_FAST = 0.1  # the same for an offset error above the next limit [s/s]
FAST_SLEW_ERROR_S = 0.25  # offset error above which the fast slew applies [s]
REANCHOR_DELAY_S = 1.0  # minimum delay of a window above which the offset is re-anchored [s]

(
    OFFSET,  # fleet time minus message time [s]
    NEWEST_OWN,  # newest unwrapped message time; nan before the first [s]
    JUMPS,  # number of detected jumps
    WRAP,  # wrap period of the message time; 0: none [s]
    ARRIVAL,  # arrival of the newest message
    ANCHORED,  # arrival at the last anchor
    LATEST_T,  # newest fleet time returned
    SUSPECTS,  # consecutive messages that indicate a jump
    MIN_DELAY,  # minimum delay of this bucket [s]
    PREVIOUS_MIN_DELAY,  # minimum delay of the previous bucket [s]
    BUCKET_START,  # arrival at the start of this bucket
    DELAY,  # smoothed arrival minus fleet time [s]
    WORST_DELAY,  # maximum since the last reset [s]
    ADVANCE,  # sum of the forward re-anchoring steps [s]
    STATE_SIZE,
) = range(15)
BOOT, USEC, USEC32, NONE = range(4)
"""Time source of a message: time_boot_ms, time_usec, time_usec truncated to 32 bit, none."""


def new_clock(wrap_s: float = 0.0) -> np.ndarray:
    """Return the initial state of one clock, (STATE_SIZE,)."""
    clock = np.zeros(STATE_SIZE)
    clock[NEWEST_OWN], clock[LATEST_T], clock[WRAP] = nan, -inf, wrap_s
    return clock


def new_clocks() -> np.ndarray:
    """Return the clocks of one aircraft, (3, STATE_SIZE): boot, and two for `time_usec` not counted from boot."""
    return np.stack([new_clock(WRAP_BOOT_S), new_clock(), new_clock(WRAP_USEC_S)])


@nb.njit(cache=True)
def fleet_time(clock, raw_s, arrival, latest):
    """Return the fleet time of a message [s since 1970]; nan while a jump is suspected.

    Args:
        clock: state, changed in place, (STATE_SIZE,)
        raw_s: time stamp of the message [s]
        arrival: when it arrived, fleet clock [s since 1970]
        latest: newest fleet time returned; a new anchor is later [s since 1970]
    """
    if isnan(clock[NEWEST_OWN]):
        return _anchor(clock, raw_s, arrival, latest)
    own = unwrap(clock, raw_s)
    step, elapsed = own - clock[NEWEST_OWN], arrival - clock[ARRIVAL]
    if step < -MAX_STEP_BACK_S or step > elapsed + MAX_LEAP_S:
        clock[SUSPECTS] += 1
        if clock[SUSPECTS] < CONFIRM_COUNT:
            return nan
        clock[JUMPS] += 1
        return _anchor(clock, raw_s, arrival, max(latest, clock[LATEST_T]))
    clock[SUSPECTS] = 0
    if step > 0:
        _slew(clock, arrival - own, arrival, elapsed)
        clock[NEWEST_OWN], clock[ARRIVAL] = own, arrival
        delay = max(arrival - own - clock[OFFSET], 0.0)
        clock[DELAY] += DELAY_SMOOTHING * (delay - clock[DELAY])
        clock[WORST_DELAY] = max(clock[WORST_DELAY], delay)
    return _to_fleet_time(clock, own)


@nb.njit(cache=True)
def unwrap(clock, raw_s):
    """Unwrap a message time to the value nearest to the newest one [s]."""
    if clock[WRAP] == 0.0 or isnan(clock[NEWEST_OWN]):
        return raw_s
    return raw_s + np.rint((clock[NEWEST_OWN] - raw_s) / clock[WRAP]) * clock[WRAP]


@nb.njit(cache=True)
def _to_fleet_time(clock, own_s):
    t = own_s + clock[OFFSET]
    clock[LATEST_T] = max(clock[LATEST_T], t)
    return t


@nb.njit(cache=True)
def extrapolated_time(clock, arrival):
    """Return the fleet time of a message without time stamp: the newest, extrapolated by at most 0.5 s."""
    if isnan(clock[NEWEST_OWN]):
        clock[LATEST_T] = max(clock[LATEST_T], arrival)
        return arrival
    return _to_fleet_time(clock, clock[NEWEST_OWN] + min(max(arrival - clock[ARRIVAL], 0.0), 0.5))


@nb.njit(cache=True)
def _anchor(clock, own, arrival, latest):
    clock[OFFSET] = max(arrival, latest + 1e-3) - own
    clock[NEWEST_OWN], clock[ARRIVAL], clock[ANCHORED], clock[BUCKET_START] = own, arrival, arrival, arrival
    clock[MIN_DELAY], clock[PREVIOUS_MIN_DELAY], clock[SUSPECTS] = arrival - own, arrival - own, 0
    return _to_fleet_time(clock, own)


@nb.njit(cache=True)
def _slew(clock, delay, arrival, elapsed):
    if arrival - clock[BUCKET_START] > BUCKET_S:
        clock[PREVIOUS_MIN_DELAY], clock[MIN_DELAY], clock[BUCKET_START] = clock[MIN_DELAY], delay, arrival
    clock[MIN_DELAY] = min(clock[MIN_DELAY], delay)
    min_delay = min(clock[MIN_DELAY], clock[PREVIOUS_MIN_DELAY])
    error = min_delay - clock[OFFSET]
    if error > REANCHOR_DELAY_S:
        anchor = max(min_delay, delay - REANCHOR_DELAY_S)  # the minimum may be 30 s old, the newest delay an outlier
        clock[ADVANCE] += anchor - clock[OFFSET]
        clock[OFFSET], clock[MIN_DELAY], clock[PREVIOUS_MIN_DELAY] = anchor, delay, delay
        clock[ANCHORED] = clock[BUCKET_START] = arrival
        return
    if arrival - clock[ANCHORED] < WARM_UP_S:
        clock[OFFSET] += min(error, 0.0)
        return
    max_slew = max(elapsed, 0.0) * (SLEW_FAST if error < -FAST_SLEW_ERROR_S else SLEW)
    clock[OFFSET] += min(max(error, -max_slew), max_slew)


@nb.njit(cache=True)
def message_time(clocks, tick, raw_s, arrival):
    """Return the fleet time of one message of an aircraft [s since 1970]; nan while a jump is suspected.

    Args:
        clocks: states, changed in place, (3, STATE_SIZE)
        tick: BOOT, USEC, USEC32 or NONE
        raw_s: time stamp of the message [s]
        arrival: when it arrived, fleet clock [s since 1970]
    """
    boot = clocks[BOOT]
    latest = max(clocks[BOOT, LATEST_T], clocks[USEC, LATEST_T], clocks[USEC32, LATEST_T])
    if tick == NONE:
        return extrapolated_time(boot, arrival)
    if tick == BOOT:
        return fleet_time(boot, raw_s, arrival, latest)
    if not isnan(boot[NEWEST_OWN]):
        own = raw_s
        if tick == USEC32:
            own += np.rint((boot[NEWEST_OWN] - raw_s) / WRAP_USEC_S) * WRAP_USEC_S
        if abs(own - boot[NEWEST_OWN]) < MAX_STEP_BACK_S:
            return _to_fleet_time(boot, own)
    return fleet_time(clocks[tick], raw_s, arrival, latest)


def jumps(clocks: np.ndarray) -> int:
    """Return the number of detected jumps."""
    return int(clocks[:, JUMPS].max())
