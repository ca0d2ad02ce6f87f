"""Record flight events on the twin; the next prediction reports the newest one."""

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

from fleet.contract import EVENT_TEXTS, Event

if TYPE_CHECKING:
    from twin_worker.twin.state.state import Twin


@dataclass(frozen=True)
class FlightEvent:
    """An event, its time [s since 1970], and its message with details."""

    event: Event
    t: float
    message: str


def record_event(twin: "Twin", event: Event, t: float, details: str = "") -> None:
    """Record an event and request a new prediction."""
    twin.prediction.add_event(event, t, EVENT_TEXTS[event] + (f" ({details})" if details else ""))
    twin.prediction.predict_timer.expire()


def discard_prediction(twin: "Twin", *, is_first: bool = False) -> None:
    """End the running prediction: more is known of the route that the aircraft already flies."""
    twin.prediction.invalidate(is_first=is_first)
    twin.confidence.tracker.censor_open()
    twin.prediction.selector.clear()


def invalidate_prediction(
    twin: "Twin", event: Event | None, t: float, details: str = "", *, is_first: bool = False, known_t: float = inf
) -> None:
    """Invalidate the running prediction as of time `t`; record `event` unless it is None.

    The controller continues from its newest state until `t`, and until `known_t`: the last report before the change.

    A twin that continues another worker's rollout keeps it if `is_first`: the twin receives its first mission or its
    first parameters, with which that worker made the rollout.
    """
    twin.onboard.plan_changed(t, twin.prediction.controller_memory(min(t, known_t)))
    discard_prediction(twin, is_first=is_first)
    if event is not None:
        record_event(twin, event, t, details)
