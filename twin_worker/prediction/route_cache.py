"""Routes of the predictions, cached: missions change rarely, and a route takes as long to unroll as a rollout."""

from collections.abc import Mapping
from functools import lru_cache

from fleet.contract import Item
from fleet.frames import Origin
from fleet.mission import ROUTE_PARAMS, Route, unroll_route

_CACHE_SIZE = 1024  # cached routes


def cached_route(
    items: tuple[Item, ...],
    seq: int,
    origin: Origin,
    params: Mapping[str, float],
    first: int,
    *,
    jumps: Mapping[int, int] | None = None,
) -> Route:
    """Return the cached, read-only result of `fleet.mission.unroll_route`: legs from item `seq` on."""
    used = tuple((name, params[name]) for name in ROUTE_PARAMS if name in params)
    return _cached_route(items, seq, origin, used, (first, tuple((jumps or {}).items())))


@lru_cache(maxsize=_CACHE_SIZE)
def _cached_route(
    items: tuple[Item, ...],
    seq: int,
    origin: Origin,
    params: tuple[tuple[str, float], ...],
    start: tuple[int, tuple[tuple[int, int], ...]],
) -> Route:
    first, jumps = start
    return unroll_route(items, seq=seq, origin=origin, params=dict(params), first=first, jumps_taken=dict(jumps))
