"""Take an event down on the twin: the newest one is what the next prediction tells."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fleet.contract import SENTENCES, Event

if TYPE_CHECKING:
    from twin_worker.twin.state.state import Twin


@dataclass(frozen=True)
class Note:
    """An event, when it was [s since 1970], and its sentence with particulars."""

    event: Event
    t: float
    said: str


def note(twin: "Twin", event: Event, t: float, particulars: str = "") -> None:
    """Tell of an event, with a new prediction at once."""
    said = SENTENCES[event] + (f" ({particulars})" if particulars else "")
    twin.noted, twin.predict_t = Note(event, t if np.isfinite(t) else 0.0, said), -np.inf


def void(twin: "Twin", event: Event | None, t: float, particulars: str = "") -> None:
    """End the running prediction: the aircraft flies by something else from `t` on; no event is told for None."""
    twin.since, twin.predict_t, twin.spread_t, twin.base, twin.put_off = t, -np.inf, -np.inf, None, None
    twin.record.forget()
    twin.contest.forget()
    if event is not None:
        note(twin, event, t, particulars)
