"""Answer queries about a worker's aircraft: newest predictions, on any grid or all at once, and what-ifs."""

import copy
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import msgspec
from msgspec import Raw

from fleet.bus.codec import EncodedMessage, Stamp, encode
from fleet.contract import Prediction, Predictions, Proposal, WhatIf
from twin_worker.ownership.twin_store import OwnedTwin, data_time
from twin_worker.proposals.proposer import Proposer
from twin_worker.twin.state.state import Twin
from twin_worker.whatif import answer_query, read_grid, read_query, resample

_log = logging.getLogger(__name__)
StampedMessages = Iterator[tuple[Any, Stamp]]


class QueryHandlers:
    """Query handlers; each answer carries the aircraft's fencing token.

    Args:
        writer: id of the bus session
        owned_twins: returns the ready twins, by UAV id
    """

    def __init__(self, writer: int, owned_twins: Callable[[], list[OwnedTwin]]) -> None:
        self._writer, self._owned_twins = writer, owned_twins

    def predictions(self, uav: int | None, parameters: dict[str, str], payload: bytes) -> StampedMessages:
        """Return the newest prediction of one aircraft or all, on the requested grid, or the result of a what-if.

        Raises:
            ValueError: when the grid or the query is invalid or cannot be answered; the message states the reason.
        """
        grid = read_grid(parameters)
        if payload:
            what_if = read_query(payload)
            if uav is None:
                raise ValueError(
                    "what if: found a query for every aircraft, expected one; ask e.g. parauav/7/prediction"
                )
            what_ifs = [(owned, _run_what_if(owned, what_if)) for owned in self.select(uav)]
            return self.with_stamps((owned, resample(prediction, grid)) for owned, prediction in what_ifs)
        latest = ((owned, latest_prediction(owned)) for owned in self.select(uav))
        if grid is None:
            return self.with_stamps(latest)
        return self.with_stamps((owned, made and resample(made.message(), grid)) for owned, made in latest)

    def all_predictions(self) -> Predictions:
        """Return the newest prediction of every owned aircraft."""
        encoded = [
            (Raw(latest.payload), owned.epoch)
            for owned in self._owned_twins()
            if (latest := latest_prediction(owned)) is not None
        ]
        predictions, epochs = (tuple(column) for column in zip(*encoded, strict=True)) if encoded else ((), ())
        return Predictions(t=time.time(), predictions=predictions, epochs=epochs)

    def proposals(self, uav: int | None, proposer: Proposer) -> StampedMessages:
        """Return the proposals in force; for one aircraft without any, compute one on request."""
        proposals = [
            (owned, proposal) for owned in self.select(uav) for proposal in proposer.current(owned.twin.config.uav)
        ]
        if uav is not None and not proposals:
            proposals = [
                (owned, proposal) for owned in self.select(uav) if (proposal := _propose(owned, proposer)) is not None
            ]
        return self.with_stamps(proposals)

    def select(self, uav: int | None) -> list[OwnedTwin]:
        """Return the requested aircraft if owned; all for None."""
        return [owned for owned in self._owned_twins() if uav in (None, owned.twin.config.uav)]

    def with_stamps(self, pairs: Iterable[tuple[OwnedTwin, Any]]) -> StampedMessages:
        """Pair each message with its stamp; skip None."""
        return ((message, Stamp(owned.epoch, self._writer)) for owned, message in pairs if message is not None)


def copy_twin(owned: OwnedTwin) -> Twin:
    """Return a copy of a twin between two of its steps."""
    with owned.lock:
        return copy.deepcopy(owned.twin)


def _run_what_if(owned: OwnedTwin, what_if: WhatIf) -> Prediction:
    """Run a what-if on a copy of the twin, on the caller's thread; an internal error becomes a `ValueError`."""
    twin = copy_twin(owned)
    try:
        return answer_query(twin, what_if)
    except ValueError:
        raise
    except Exception as error:  # an error in one query must not stop the others
        _log.exception("%s: a what-if failed", twin.name)
        raise ValueError(f"{twin.name}: found an internal error ({error}), expected a prediction; report it") from None


def _propose(owned: OwnedTwin, proposer: Proposer) -> Proposal | None:
    """Compute a proposal on request, on the caller's thread; an internal error becomes a `ValueError`."""
    try:
        return proposer.on_request(owned.twin.config.uav, data_time(owned))
    except Exception as error:  # an error in one query must not stop the others
        _log.exception("%s: a requested proposal failed", owned.twin.name)
        reason = f"found an internal error ({error}), expected a proposal"
        raise ValueError(f"{owned.twin.name}: {reason}; report it") from None


def latest_prediction(owned: OwnedTwin) -> EncodedMessage | None:
    """Return the newest prediction, encoded with its law and parameters; None before the first."""
    prediction, control = owned.twin.prediction.latest, owned.twin.prediction.controller
    if prediction is None:
        return None
    if owned.encoded is None or owned.encoded[0] is not prediction:
        complete = prediction
        if control is not None and prediction.controller is None:
            complete = msgspec.structs.replace(prediction, controller=control.to_message())
        owned.encoded = prediction, EncodedMessage(Prediction, prediction.uav, encode(complete))
    return owned.encoded[1]
