"""Messages dated by the gateway's clock, placed on the time axis of telemetry, which may be behind that clock."""

from dataclasses import dataclass

_TOLERATED_S = 0.5  # telemetry is behind by as much on any radio link: such a delay counts as none [s]


@dataclass
class Delay:
    """How far the times of telemetry are behind the gateway's clock, by the order of arrival.

    Samples are dated by the aircraft's clock, status messages by the gateway's. A sample of time t that arrives after
    a status of time G is delayed by G - t at least; the greatest of these bounds between two status messages is the
    delay. A simulator slower than real time, or one that paused, falls behind without limit.

    Attributes:
        gateway_t: newest time of a status [s since 1970]
        bound: greatest lower bound since that status [s]
        known: in force since that status [s]
    """

    gateway_t: float = float("-inf")
    bound: float = float("-inf")
    known: float = 0.0

    @property
    def now(self) -> float:
        """Return the delay of the newest sample [s]; 0 where it is a usual one."""
        return _unusual(max(self.known, self.bound))

    def take_sample(self, newest: float, leapt: bool) -> None:
        """Learn that telemetry up to `newest` has arrived [s since 1970]; of a leap only what follows it counts."""
        bound = self.gateway_t - newest
        self.bound = bound if leapt else max(self.bound, bound)
        self.known = 0.0 if leapt else self.known

    def of_status(self, t: float, newest: float) -> float:
        """Return delay at a status of time `t`, before it is taken; the first one is taken to come with a sample."""
        if self.gateway_t == float("-inf"):
            return _unusual(t - newest)
        return self.known if self.bound == float("-inf") else _unusual(self.bound)

    def take_status(self, t: float, newest: float) -> None:
        """Learn that a status of time `t` has arrived, telemetry up to `newest` before it [s since 1970]."""
        self.known = self.of_status(t, newest)
        self.gateway_t, self.bound = max(t, self.gateway_t), float("-inf")


def _unusual(delay: float) -> float:
    return delay if _TOLERATED_S < delay < float("inf") else 0.0
