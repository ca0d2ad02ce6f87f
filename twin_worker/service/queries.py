"""What one worker answers about its aircraft: the newest predictions, on any grid or all at once, and what-ifs."""

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
    """Answers under the claim of each aircraft.

    Args:
        writer: of the bus
        holding: gives those whose twins are here, by UAV id
    """

    def __init__(self, writer: int, holding: Callable[[], list[Held]]) -> None:
        self._writer, self._holding = writer, holding

    def predictions(self, uav: int | None, asked: dict[str, str], payload: bytes) -> Stamped:
        """Return the newest prediction of one aircraft or all, on the grid that is asked for, or what one supposes.

        Raises:
            ValueError: when grid or question are absurd, or cannot be answered; the sentence says why.
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
        """Return the newest prediction of every aircraft held."""
        found = [(Raw(made.payload), held.epoch) for held in self._holding() if (made := told(held)) is not None]
        predictions, epochs = (tuple(each) for each in zip(*found, strict=True)) if found else ((), ())
        return Predictions(t=time.time(), predictions=predictions, epochs=epochs)

    def of(self, uav: int | None) -> list[Held]:
        """Return the aircraft asked for, all for None, if it is held."""
        return [held for held in self._holding() if uav in (None, held.twin.uav)]

    def stamped(self, pairs: Iterable[tuple[Held, Any]]) -> Stamped:
        """Put the claim beside what there is to tell."""
        return ((message, Stamp(held.epoch, self._writer)) for held, message in pairs if message is not None)

    def _supposed(self, uav: int | None, asked: WhatIf) -> list[tuple[Held, Prediction]]:
        """Let a copy of one twin fly what a query supposes.

        Raises:
            ValueError: when it names no single aircraft, or this one cannot be flown so.
        """
        if uav is None:
            raise ValueError("what if: found a query for every aircraft, expected one; ask e.g. parauav/7/prediction")
        return [(held, suppose(held, asked)) for held in self.of(uav)]


def suppose(held: Held, asked: WhatIf) -> Prediction:
    """Copy the twin between two messages and let the copy answer, on the asker's thread.

    Raises:
        ValueError: when it cannot answer; the sentence says why.
    """
    with held.lock:
        twin = copy.deepcopy(held.twin)
    try:
        return answer(twin, asked)
    except ValueError:
        raise
    except Exception as error:  # a defect met by a question must not stop the answers
        _log.exception("%s: a what-if failed", twin.name)
        raise ValueError(f"what if: {twin.name} met a defect ({error}), expected a prediction; report it") from None


def told(held: Held) -> Wire | None:
    """Return the newest prediction with the law and parameters it was flown by, packed once; None before any."""
    made, control = held.twin.prediction, held.twin.control
    if made is None:
        return None
    if held.told is None or held.told[0] is not made:
        known = control is None or made.controller is not None
        whole = made if known else msgspec.structs.replace(made, controller=control.wire())  # type: ignore[union-attr]
        held.told = made, Wire(Prediction, made.uav, encode(whole))
    return held.told[1]
