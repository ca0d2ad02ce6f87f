"""Delay of telemetry time behind the gateway clock."""

from dataclasses import dataclass

_TOLERATED_S = 0.5  # usual delay of a radio link; treated as zero [s]


@dataclass
class ArrivalDelay:
    """Estimate how far telemetry times are behind the gateway clock, from the order of arrival.

    Samples have aircraft time, status messages have gateway time. A sample of time t that arrives after a status of
    time G is delayed by at least G - t. The largest such bound between two status messages is the delay. The delay of
    a simulator that is paused or slower than real time is unbounded.

    Attributes:
        gateway_t: newest time of a status [s since 1970]
        bound: largest lower bound since that status [s]
        established: delay established at that status [s]
    """

    gateway_t: float = float("-inf")
    bound: float = float("-inf")
    established: float = 0.0

    @property
    def newest_sample_delay(self) -> float:
        """Return the delay of the newest sample [s]; 0 within the tolerance."""
        return _zero_if_tolerated(max(self.established, self.bound))

    def on_sample(self, newest: float, clock_jumped: bool) -> None:
        """Update with telemetry up to `newest` [s since 1970]; a clock jump discards earlier bounds."""
        bound = self.gateway_t - newest
        self.bound = bound if clock_jumped else max(self.bound, bound)
        self.established = 0.0 if clock_jumped else self.established

    def delay_at_status(self, t: float, newest: float) -> float:
        """Return the delay at a status of time `t` before `on_status`; the first status follows a sample."""
        if self.gateway_t == float("-inf"):
            return _zero_if_tolerated(t - newest)
        return self.established if self.bound == float("-inf") else _zero_if_tolerated(self.bound)

    def on_status(self, t: float, newest: float) -> None:
        """Update with a status of time `t` that follows telemetry up to `newest` [s since 1970]."""
        self.established = self.delay_at_status(t, newest)
        self.gateway_t, self.bound = max(t, self.gateway_t), float("-inf")


def _zero_if_tolerated(delay: float) -> float:
    return delay if _TOLERATED_S < delay < float("inf") else 0.0
