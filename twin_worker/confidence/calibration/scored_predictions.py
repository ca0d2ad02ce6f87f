"""Predictions and the positions flown afterwards, as written by `assess`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from twin_worker.confidence.calibration_table import UncertaintyFeatures, uncertainty_features
from twin_worker.confidence.table_files import ANY, group_chain, group_setting
from twin_worker.confidence.tube_and_horizon import LaggedForecasts
from twin_worker.numerics.prediction_errors import AHEAD, axes_error

_MIN_STARTS = 30  # minimum predictions of a setting that forms a fold of its own
_PATH_KEYS = ("path", "spread", "flown")
_FEATURES = ("spread", "revision", "path")
_ROW_KEYS = ("t0", "length", "predicted_length", "group", "method", "flight")


@dataclass(frozen=True)
class ScoredPredictions:
    """Predictions (s of them) on the common look-ahead grid of k points.

    Attributes:
        t0: start times, (s,) [s since 1970]
        path: predicted positions, NED, (s, k, 3) [m]
        features: ensemble spread, forecast revision and predicted path, (s, k, 3) [m]
        flown: flown positions, NED, nan where unknown, (s, k, 3) [m]
        length, predicted_length: path length so far, never below two seconds of ground speed, (s, k) [m]
        group, method, flight: names, (s,)
    """

    t0: np.ndarray
    path: np.ndarray
    features: UncertaintyFeatures
    flown: np.ndarray
    length: np.ndarray
    predicted_length: np.ndarray
    group: np.ndarray
    method: np.ndarray
    flight: np.ndarray

    def __len__(self) -> int:
        return len(self.t0)

    def select(self, rows: np.ndarray) -> "ScoredPredictions":
        """Return the predictions of these rows."""
        features = UncertaintyFeatures(self.features.spread[rows], self.features.revision[rows], self.path[rows])
        return replace(
            self, features=features, **{name: getattr(self, name)[rows] for name in ("path", "flown", *_ROW_KEYS)}
        )

    def errors(self) -> np.ndarray:
        """Return errors along, cross, vertical and the distance, nan where unknown, (s, k, 4) [m]."""
        return axes_error(self.path, self.flown)

    def in_group(self, group: str) -> np.ndarray:
        """Return which predictions belong to a group or parent group, (s,) bool."""
        is_member = {name: group in group_chain(name) for name in set(self.group.tolist())}
        return np.array([is_member[name] for name in self.group.tolist()], bool)

    def spans_settings(self, group: str) -> bool:
        """Return whether a group spans several settings (law, airframe, parameters) with enough predictions."""
        return ANY in group and len(set(self._settings().tolist())) > 1

    def folds(self, group: str) -> np.ndarray:
        """Return the validation fold of each prediction, (s,): its setting if the group has several, else its flight.

        A table of several settings is used for settings without a table, so validation leaves out settings.
        """
        return np.unique(self._settings() if self.spans_settings(group) else self.flight, return_inverse=True)[1]

    def _settings(self) -> np.ndarray:
        """Return the setting of each prediction, (s,); rare settings are merged with the most common one."""
        names = np.array([group_setting(name) for name in self.group.tolist()])
        unique, count = np.unique(names, return_counts=True)
        rare = np.isin(names, unique[count < _MIN_STARTS])
        return np.where(rare, unique[np.argmax(count)], names)


def read(paths: Sequence[Path]) -> ScoredPredictions:
    """Read and concatenate files of scored predictions.

    Raises:
        ValueError: when a file was not written by `assess`.
    """
    return concatenate([_read_file(path) for path in paths])


def concatenate(parts: Sequence[ScoredPredictions]) -> ScoredPredictions:
    """Concatenate sets of predictions."""
    features = UncertaintyFeatures(
        *(np.concatenate([getattr(part.features, name) for part in parts]) for name in _FEATURES)
    )
    names = ("path", "flown", *_ROW_KEYS)
    return ScoredPredictions(
        features=features, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    )


def _read_file(path: Path) -> ScoredPredictions:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ("ahead", *_PATH_KEYS, *_ROW_KEYS)}
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{path.name}: found no scored predictions ({error}); write them with `assess`") from None
    s, k = len(arrays["t0"]), len(AHEAD)
    if not np.array_equal(arrays.pop("ahead"), AHEAD):
        raise ValueError(f"{path.name}: found another look-ahead grid, expected 0 to 180 s in {k} points; assess again")
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_PATH_KEYS, (s, k, 3))
    shapes |= dict.fromkeys(("length", "predicted_length"), (s, k))
    for name, value in arrays.items():
        if value.shape != shapes.get(name, (s,)):
            raise ValueError(
                f"{path.name}: found {name} of shape {value.shape}, expected {shapes.get(name, (s,))}; assess again"
            )
    spread = arrays.pop("spread")
    revision = revisions(arrays["t0"], arrays["path"], arrays["flight"])
    methods = arrays["method"].tolist()
    features = [
        uncertainty_features(*row, AHEAD) for row in zip(spread, revision, arrays["path"], methods, strict=True)
    ]
    stacked = (np.array([getattr(item, name) for item in features]).reshape(s, k, 3) for name in _FEATURES)
    return ScoredPredictions(features=UncertaintyFeatures(*stacked), **arrays)


def revisions(t0: np.ndarray, path: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Compute the forecast revision of each prediction within its flight, nan where undefined, (s, k, 3) [m]."""
    out = np.full(path.shape, np.nan)
    for name in dict.fromkeys(flight.tolist()):
        lagged = LaggedForecasts()
        rows = np.flatnonzero(flight == name)
        for r in rows[np.argsort(t0[rows])]:
            revision = lagged.revision(float(t0[r]), AHEAD, path[r])
            out[r] = np.nan if revision is None else revision
            lagged.add(float(t0[r]), AHEAD, path[r])
    return out
