"""Proposal in scene coordinates: its options with their predicted paths, checked on arrival."""

from typing import NamedTuple

from fleet.contract import Option, Prediction, Proposal, ProposedPath, TwinState
from viewer.store.forecast import ScenePrediction, check_prediction
from viewer.store.place import SceneFrame

MAX_PROPOSALS = 8  # proposals of one UAV that are stored
MAX_OPTIONS, MAX_PATHS = 3, 4  # options of one UAV, and paths of an option, that are shown


class SceneProposal(NamedTuple):
    """Checked proposal: the message, and the paths of each option in scene coordinates."""

    message: Proposal
    paths: tuple[tuple[ScenePrediction, ...], ...]

    @property
    def options(self) -> tuple[Option, ...]:
        """Return the options shown."""
        return self.message.options[:MAX_OPTIONS]

    def is_valid(self, t: float) -> bool:
        """Return whether the options may be approved at data time `t` [s since 1970]."""
        return bool(self.message.options) and t < self.message.valid_until


def check_proposal(message: Proposal, scene_frame: SceneFrame, received: float) -> SceneProposal:
    """Check a proposal.

    Args:
        message: as received, untrusted
        scene_frame: frame of the scene
        received: arrival, monotonic [s]
    Raises:
        ValueError: when a path is not valid; the worker must resend.
        OutOfRangeError: when a path is farther than 100 km from the fleet.
    """
    paths = tuple(
        tuple(path for one in option.paths[:MAX_PATHS] if (path := _path(message, one, scene_frame, received)))
        for option in message.options[:MAX_OPTIONS]
    )
    return SceneProposal(message, paths)


def _path(message: Proposal, path: ProposedPath, scene_frame: SceneFrame, received: float) -> ScenePrediction | None:
    """Return a checked path, as of a prediction of that aircraft; None for an empty one."""
    prediction = Prediction(
        uav=path.uav,
        t=message.t,
        state=TwinState.PREDICTING,
        method="",
        origin=path.origin,
        ahead=path.ahead,
        path=path.path,
        prediction_region_half_axes=path.prediction_region_half_axes,
    )
    return check_prediction(prediction, scene_frame, received)
