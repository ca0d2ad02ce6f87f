"""View of a topic of an onboard log for the table: fields as arrays, other topics interpolated to the same times."""

from collections.abc import Mapping
from typing import Any

import numpy as np

MAX_INTERPOLATION_S = 1.5  # maximum gap for interpolation [s]
_MAX_STAMP_ERROR_S = 1.0  # maximum difference of a stamp from its neighbours in the file [s]


class Topic:
    """One topic: `t` [s], and fields as attributes; `q[0]`, `q[1]` … form a tuple, `current.lat` is nested."""

    def __init__(self, t: np.ndarray, data: Mapping[str, np.ndarray], topics: Mapping[str, "Topic"]) -> None:
        self.t, self._data, self._topics = t, data, topics
        self._query_t: np.ndarray | None = None  # times to interpolate to; None: own times
        self._prefix = ""

    def __getattr__(self, name: str) -> Any:
        """Return a field; a missing field raises AttributeError, so that the table row does not apply."""
        if name.startswith("_"):
            raise AttributeError(name)
        key = self._prefix + name
        if key in self._data:
            return self._values(key)
        elements = [f"{key}[{i}]" for i in range(32) if f"{key}[{i}]" in self._data]
        if elements:
            return tuple(self._values(element) for element in elements)
        if any(field.startswith(key + ".") for field in self._data):
            return self._view(self._query_t, key + ".")
        raise AttributeError(name)

    def field(self, name: str) -> Any:
        """Return a field by its full name, which may contain dots and brackets.

        Raises:
            AttributeError: if there is none; the table row does not apply.
        """
        if name not in self._data:
            raise AttributeError(name)
        return self._values(name)

    def interpolated(self, name: str) -> "Topic":
        """Return another topic interpolated to the times of this one; the second instance is `name.1`."""
        if name not in self._topics:
            raise AttributeError(name)
        return self._topics[name]._view(self.t, "")

    def drop_fields(self) -> None:
        """Drop the fields but keep the times."""
        self._data = {}

    def rows_between(self, begin: int, end: int) -> "Topic":
        """Return a range of its rows, with the other topics complete."""
        return Topic(self.t[begin:end], {name: values[begin:end] for name, values in self._data.items()}, self._topics)

    def __len__(self) -> int:
        return len(self.t)

    def _view(self, query_t: np.ndarray | None, prefix: str) -> "Topic":
        view = Topic(self.t, self._data, self._topics)
        view._query_t, view._prefix = query_t, prefix
        return view

    def _values(self, key: str) -> np.ndarray:
        values = self._data[key].astype(float)
        return values if self._query_t is None else _interpolate(self._query_t, self.t, values)


def _interpolate(query_t: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate linearly; NaN outside and in gaps."""
    if len(t) < 2:
        return np.full(len(query_t), np.nan)
    index = np.clip(np.searchsorted(t, query_t), 1, len(t) - 1)
    in_range = (query_t >= t[0]) & (query_t <= t[-1]) & (t[index] - t[index - 1] <= MAX_INTERPOLATION_S)
    return np.where(in_range, np.interp(query_t, t, values), np.nan)


def time_order(stamp_us: np.ndarray) -> np.ndarray:
    """Return row indices in time order, without duplicate or outlying stamps."""
    if len(stamp_us) < 2 or (np.diff(stamp_us) > 0).all():
        return np.arange(len(stamp_us))
    from scipy.ndimage import median_filter  # deferred import: stamps are seldom out of order

    near = np.abs(stamp_us - median_filter(stamp_us, 5, mode="nearest")) < _MAX_STAMP_ERROR_S * 1e6
    valid = np.flatnonzero(near)
    order = valid[np.argsort(stamp_us[valid], kind="stable")]
    return order[np.concatenate([[True], np.diff(stamp_us[order]) > 0])] if len(order) else order
