"""View of a ULog topic for the table: fields as arrays, other topics interpolated to the same times."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

BRIDGE_S = 1.5  # maximum gap for interpolation [s]
_STRAY_S = 1.0  # maximum difference of a stamp from its neighbours in the file [s]


class Topic:
    """One topic: `t` [s], and fields as attributes; `q[0]`, `q[1]` … form a tuple, `current.lat` is nested."""

    def __init__(self, t: np.ndarray, data: Mapping[str, np.ndarray], others: Mapping[str, "Topic"]) -> None:
        self.t, self._data, self._others = t, data, others
        self._at: np.ndarray | None = None  # times to interpolate to; None: own times
        self._prefix = ""

    def __getattr__(self, name: str) -> Any:
        """Return a field; a missing field raises AttributeError, so that the table row does not apply."""
        if name.startswith("_"):
            raise AttributeError(name)
        key = self._prefix + name
        if key in self._data:
            return self._values(key)
        many = [f"{key}[{i}]" for i in range(32) if f"{key}[{i}]" in self._data]
        if many:
            return tuple(self._values(one) for one in many)
        if any(field.startswith(key + ".") for field in self._data):
            return self._like(self._at, key + ".")
        raise AttributeError(name)

    def beside(self, name: str) -> "Topic":
        """Return another topic interpolated to the times of this one; the second instance is `name.1`."""
        if name not in self._others:
            raise AttributeError(name)
        return self._others[name]._like(self.t, "")

    def strip(self) -> None:
        """Drop the fields but keep the times."""
        self._data = {}

    def part(self, begin: int, end: int) -> "Topic":
        """Return a range of its rows, with the other topics complete."""
        return Topic(self.t[begin:end], {name: values[begin:end] for name, values in self._data.items()}, self._others)

    def __len__(self) -> int:
        return len(self.t)

    def _like(self, at: np.ndarray | None, prefix: str) -> "Topic":
        other = Topic(self.t, self._data, self._others)
        other._at, other._prefix = at, prefix
        return other

    def _values(self, key: str) -> np.ndarray:
        values = self._data[key].astype(float)
        return values if self._at is None else _between(self._at, self.t, values)


def _between(at: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate linearly; NaN outside and in gaps."""
    if len(t) < 2:
        return np.full(len(at), np.nan)
    k = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    known = (at >= t[0]) & (at <= t[-1]) & (t[k] - t[k - 1] <= BRIDGE_S)
    return np.where(known, np.interp(at, t, values), np.nan)


def in_order(stamp_us: np.ndarray) -> np.ndarray:
    """Return row indices in time order, without duplicate or outlying stamps."""
    if len(stamp_us) < 2 or (np.diff(stamp_us) > 0).all():
        return np.arange(len(stamp_us))
    near = np.abs(stamp_us - median_filter(stamp_us, 5, mode="nearest")) < _STRAY_S * 1e6
    kept = np.flatnonzero(near)
    order = kept[np.argsort(stamp_us[kept], kind="stable")]
    return order[np.concatenate([[True], np.diff(stamp_us[order]) > 0])] if len(order) else order
