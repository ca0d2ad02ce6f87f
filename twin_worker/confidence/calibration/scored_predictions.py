"""Predictions and the positions flown afterwards, as written by `assess`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from twin_worker.confidence.calibration_table import Doubt, doubt_of
from twin_worker.confidence.groups import ANY, setting, wider
from twin_worker.confidence.lagged_ensemble import Earlier
from twin_worker.numerics.prediction_errors import AHEAD, axes_error

_LEAST = 30  # minimum predictions of a setting that forms a fold of its own
_WHOLE = ("path", "spread", "flown")
_ROWS = ("t0", "length", "predicted_length", "group", "method", "flight")


@dataclass(frozen=True)
class Scored:
    """Predictions (s of them) on the common look-ahead grid of k points.

    Attributes:
        t0: start times, (s,) [s since 1970]
        path: predicted positions, NED, (s, k, 3) [m]
        features: ensemble spread and forecast revision, (s, k, 3) [m]
        flown: flown positions, NED, nan where unknown, (s, k, 3) [m]
        length, predicted_length: path length so far, never below two seconds of ground speed, (s, k) [m]
        group, method, flight: names, (s,)
    """

    t0: np.ndarray
    path: np.ndarray
    doubt: Doubt
    flown: np.ndarray
    length: np.ndarray
    predicted_length: np.ndarray
    group: np.ndarray
    method: np.ndarray
    flight: np.ndarray

    def __len__(self) -> int:
        return len(self.t0)

    def part(self, rows: np.ndarray) -> "Scored":
        """Return the predictions of these rows."""
        doubt = Doubt(self.doubt.spread[rows], self.doubt.revision[rows])
        return replace(self, doubt=doubt, **{name: getattr(self, name)[rows] for name in ("path", "flown", *_ROWS)})

    def errors(self) -> np.ndarray:
        """Return errors along, cross, vertical and the distance, nan where unknown, (s, k, 4) [m]."""
        return axes_error(self.path, self.flown)

    def within(self, group: str) -> np.ndarray:
        """Return which predictions belong to a group or parent group, (s,) bool."""
        named = {name: group in wider(name) for name in set(self.group.tolist())}
        return np.array([named[name] for name in self.group.tolist()], bool)

    def several(self, group: str) -> bool:
        """Return whether a group spans several settings (law, airframe, parameters) with enough predictions."""
        return ANY in group and len(set(self._settings().tolist())) > 1

    def folds(self, group: str) -> np.ndarray:
        """Return the validation fold of each prediction, (s,): its setting if the group has several, else its flight.

        A table of several settings is used for settings without a table, so validation leaves out settings.
        """
        return np.unique(self._settings() if self.several(group) else self.flight, return_inverse=True)[1]

    def _settings(self) -> np.ndarray:
        """Return the setting of each prediction, (s,); rare settings are merged with the most common one."""
        names = np.array([setting(name) for name in self.group.tolist()])
        known, count = np.unique(names, return_counts=True)
        few = np.isin(names, known[count < _LEAST])
        return np.where(few, known[np.argmax(count)], names)


def read(paths: Sequence[Path]) -> Scored:
    """Read and concatenate files of scored predictions.

    Raises:
        ValueError: when a file was not written by `assess`.
    """
    return joined([_read(path) for path in paths])


def joined(parts: Sequence[Scored]) -> Scored:
    """Concatenate sets of predictions."""
    doubt = Doubt(*(np.concatenate([getattr(part.doubt, name) for part in parts]) for name in ("spread", "revision")))
    names = ("path", "flown", *_ROWS)
    return Scored(doubt=doubt, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _read(path: Path) -> Scored:
    try:
        with np.load(path, allow_pickle=False) as file:
            held = {name: file[name] for name in ("ahead", *_WHOLE, *_ROWS)}
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{path.name}: found no scored predictions ({error}); write them with `assess`") from None
    s, k = len(held["t0"]), len(AHEAD)
    if not np.array_equal(held.pop("ahead"), AHEAD):
        raise ValueError(f"{path.name}: found another look-ahead grid, expected 0 to 180 s in {k} points; assess again")
    wanted: dict[str, tuple[int, ...]] = dict.fromkeys(_WHOLE, (s, k, 3))
    wanted |= dict.fromkeys(("length", "predicted_length"), (s, k))
    for name, value in held.items():
        if value.shape != wanted.get(name, (s,)):
            raise ValueError(
                f"{path.name}: found {name} of shape {value.shape}, expected {wanted.get(name, (s,))}; assess again"
            )
    spread = held.pop("spread")
    revision = revisions(held["t0"], held["path"], held["flight"])
    methods = held["method"].tolist()
    each = [doubt_of(*row, AHEAD) for row in zip(spread, revision, methods, strict=True)]
    stacked = (np.array([getattr(one, name) for one in each]).reshape(s, k, 3) for name in ("spread", "revision"))
    return Scored(doubt=Doubt(*stacked), **held)


def revisions(t0: np.ndarray, path: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Compute the forecast revision of each prediction within its flight, nan where undefined, (s, k, 3) [m]."""
    out = np.full(path.shape, np.nan)
    for name in dict.fromkeys(flight.tolist()):
        earlier = Earlier()
        rows = np.flatnonzero(flight == name)
        for r in rows[np.argsort(t0[rows])]:
            revision = earlier.revised(float(t0[r]), AHEAD, path[r])
            out[r] = np.nan if revision is None else revision
            earlier.add(float(t0[r]), AHEAD, path[r])
    return out
