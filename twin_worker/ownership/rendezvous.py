"""Assign aircraft to workers by rendezvous hashing among the workers whose range contains the id. Pure functions."""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from hashlib import blake2b

import numpy as np

_GOLDEN, _MIX = np.uint64(0x9E3779B97F4A7C15), (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)


def owners(uavs: Iterable[int], workers: Mapping[str, range]) -> dict[int, str]:
    """Return the assigned worker of each aircraft; an id outside every range has none.

    If a worker leaves, only its own aircraft move; if one joins, it only acquires: all other assignments stay.

    Args:
        uavs: ids
        workers: id range of every live worker, by name
    Source: Thaler and Ravishankar 1998, highest random weight.
    """
    ids = np.fromiter(uavs, np.int64)
    names = sorted(workers)  # deterministic tie-break by name
    if not len(ids) or not names:
        return {}
    low = np.array([[workers[name].start] for name in names])
    high = np.array([[workers[name].stop] for name in names])
    allowed = (low <= ids) & (ids < high)
    salt = np.array([[_number(name)] for name in names], np.uint64)
    weight = np.where(allowed, _mixed(_mixed(ids.astype(np.uint64)) ^ salt), np.uint64(0))
    best = weight.argmax(axis=0)
    return {int(ids[k]): names[best[k]] for k in np.flatnonzero(allowed.any(axis=0))}


def owner(uav: int, workers: Mapping[str, range]) -> str | None:
    """Return the assigned worker of one aircraft; None outside every range."""
    return owners([uav], workers).get(uav)


@lru_cache(maxsize=1024)
def _number(name: str) -> int:
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "big")


def _mixed(x: np.ndarray) -> np.ndarray:
    """Mix 64 bits so that each output bit depends on all input bits.

    Source: Steele, Lea and Flood 2014, SplitMix64.
    """
    with np.errstate(over="ignore"):
        x = x + _GOLDEN
        x = (x ^ (x >> _S30)) * _MIX[0]
        x = (x ^ (x >> _S27)) * _MIX[1]
    return x ^ (x >> _S31)
