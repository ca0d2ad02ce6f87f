"""Answer queries about a worker's aircraft: newest predictions, on any grid or all at once, and what-ifs."""

import copy
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import msgspec
from msgspec import Raw

from fleet.bus.codec import Stamp, Wire, encode
from fleet.contract import Prediction, Predictions, WhatIf
from twin_worker.ownership.twin_store import Held
from twin_worker.whatif import query
from twin_worker.whatif.answer import answer
from twin_worker.whatif.resample import resample, wanted

_log = logging.getLogger(__name__)
Stamped = Iterator[tuple[Any, Stamp]]


class Answers:
    """Query handlers; each answer carries the aircraft's fencing token.

    Args:
        writer: id of the bus session
        owned_twins: returns the ready twins, by UAV id
    """

    def __init__(self, writer: int, holding: Callable[[], list[Held]]) -> None:
        self._writer, self._holding = writer, holding

    def predictions(self, uav: int | None, asked: dict[str, str], payload: bytes) -> Stamped:
        """Return the newest prediction of one aircraft or all, on the requested grid, or the result of a what-if.

        Raises:
            ValueError: when the grid or the query is invalid or cannot be answered; the message states the reason.
        """
        grid = wanted(asked)
        if payload:
            supposed = self._supposed(uav, query.read(payload))
            return self.stamped((held, resample(made, grid)) for held, made in supposed)
        found = ((held, told(held)) for held in self.of(uav))
        if grid is None:
            return self.stamped(found)
        return self.stamped((held, made and resample(made.message(), grid)) for held, made in found)

    def at_once(self) -> Predictions:
        """Return the newest prediction of every owned aircraft."""
        found = [(Raw(made.payload), held.epoch) for held in self._holding() if (made := told(held)) is not None]
        predictions, epochs = (tuple(each) for each in zip(*found, strict=True)) if found else ((), ())
        return Predictions(t=time.time(), predictions=predictions, epochs=epochs)

    def of(self, uav: int | None) -> list[Held]:
        """Return the requested aircraft if owned; all for None."""
        return [held for held in self._holding() if uav in (None, held.twin.uav)]

    def stamped(self, pairs: Iterable[tuple[Held, Any]]) -> Stamped:
        """Pair each message with its stamp; skip None."""
        return ((message, Stamp(held.epoch, self._writer)) for held, message in pairs if message is not None)

    def _supposed(self, uav: int | None, asked: WhatIf) -> list[tuple[Held, Prediction]]:
        """Run a what-if on a copy of one twin.

        Raises:
            ValueError: when it does not select a single aircraft, or its twin cannot run it; ask one UAV.
        """
        if uav is None:
            raise ValueError("what if: found a query for every aircraft, expected one; ask e.g. parauav/7/prediction")
        return [(held, suppose(held, asked)) for held in self.of(uav)]


def suppose(held: Held, asked: WhatIf) -> Prediction:
    """Run a what-if on a copy of the twin, on the caller's thread.

    Raises:
        ValueError: when it cannot be answered; the message states the reason.
    """
    with held.lock:
        twin = copy.deepcopy(held.twin)
    try:
        return answer(twin, asked)
    except ValueError:
        raise
    except Exception as error:  # an error in one query must not stop the others
        _log.exception("%s: a what-if failed", twin.name)
        raise ValueError(f"{twin.name}: found an internal error ({error}), expected a prediction; report it") from None


def told(held: Held) -> Wire | None:
    """Return the newest prediction, encoded with its law and parameters; None before the first."""
    made, control = held.twin.prediction, held.twin.control
    if made is None:
        return None
    if held.told is None or held.told[0] is not made:
        known = control is None or made.controller is not None
        whole = made if known else msgspec.structs.replace(made, controller=control.wire())  # type: ignore[union-attr]
        held.told = made, Wire(Prediction, made.uav, encode(whole))
    return held.told[1]
