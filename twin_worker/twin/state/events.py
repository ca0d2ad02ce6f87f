"""Record flight events on the twin; the next prediction reports the newest one."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fleet.contract import SENTENCES, Event

if TYPE_CHECKING:
    from twin_worker.twin.state.state import Twin


@dataclass(frozen=True)
class Note:
    """An event, its time [s since 1970], and its message with details."""

    event: Event
    t: float
    said: str


def note(twin: "Twin", event: Event, t: float, particulars: str = "") -> None:
    """Record an event and request a new prediction."""
    said = SENTENCES[event] + (f" ({particulars})" if particulars else "")
    twin.noted, twin.predict_t = Note(event, t if np.isfinite(t) else 0.0, said), -np.inf


def void(twin: "Twin", event: Event | None, t: float, particulars: str = "") -> None:
    """Invalidate the running prediction as of time `t`; record `event` unless it is None."""
    twin.since, twin.predict_t, twin.spread_t, twin.base, twin.put_off = t, -np.inf, -np.inf, None, None
    twin.record.forget()
    twin.contest.forget()
    if event is not None:
        note(twin, event, t, particulars)
