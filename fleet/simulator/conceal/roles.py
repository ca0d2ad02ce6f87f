"""Roles of the flights: control, one effect, two separable effects, one uncatalogued effect."""

from math import ceil

import numpy as np

from fleet.simulator.conceal.effects import HIDDEN, UNKNOWN

_SINGLE, _COMPOUND, _UNKNOWN = 50 / 140, 16 / 140, 14 / 140
_OVERLAPPING = (  # pairs of channels that are not separable
    {"air", "airspeed"},
    {"air", "heading"},
    {"air", "gps"},
    {"force", "imu"},
    {"imu", "heading"},
    {"force", "pitch"},
    {"gps", "baro"},
)
_GLOBAL_EFFECTS = {"air_density", "turbulence"}  # affect all channels: never combined
EffectNames = tuple[str, ...]
"""Names of the hidden effects of one flight."""


def counts(flights: int) -> dict[str, int]:
    """Distribute the flights over the roles.

    Raises:
        ValueError: when there are fewer than 6 flights.
    """
    if flights < 6:
        raise ValueError(f"flights: found {flights}, expected 6 at least, so that each role has one; ask for more")
    single, compound = ceil(flights * _SINGLE), ceil(flights * _COMPOUND)
    unknown = max(round(flights * _UNKNOWN), 1)
    control = flights - single - compound - unknown
    return {"control": control, "single": single, "compound": compound, "unknown": unknown}


def singles(rng: np.random.Generator, airframe: str, n: int) -> list[EffectNames]:
    """Draw `n` effects without repetition until all are used."""
    return [(name,) for name in _draw_cycling(rng, [x for x, h in HIDDEN.items() if airframe in h.airframes], n)]


def unknowns(rng: np.random.Generator, airframe: str, n: int) -> list[EffectNames]:
    """Draw `n` uncatalogued effects."""
    return [(name,) for name in _draw_cycling(rng, [x for x, h in UNKNOWN.items() if airframe in h.airframes], n)]


def compounds(rng: np.random.Generator, airframe: str, n: int) -> list[EffectNames]:
    """Draw `n` separable pairs, least used effects first."""
    names = [x for x, h in HIDDEN.items() if airframe in h.airframes]
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :] if are_separable(a, b)]
    use_count: dict[str, int] = dict.fromkeys(names, 0)
    out: list[EffectNames] = []
    for _ in range(n):
        min_count = min(use_count[a] + use_count[b] for a, b in pairs)
        rarest = [pair for pair in pairs if use_count[pair[0]] + use_count[pair[1]] == min_count]
        a, b = rarest[int(rng.integers(len(rarest)))]
        use_count[a], use_count[b] = use_count[a] + 1, use_count[b] + 1
        out.append((a, b))
    return out


def are_separable(a: str, b: str) -> bool:
    """Return whether two effects are separable in one flight."""
    if {a, b} & _GLOBAL_EFFECTS:
        return False
    channels = {HIDDEN[a].channel, HIDDEN[b].channel}
    if len(channels) == 1 or channels in _OVERLAPPING:
        return False
    return not ("servo" in channels and channels & {"roll", "pitch", "yaw"})


def _draw_cycling(rng: np.random.Generator, names: list[str], n: int) -> list[str]:
    out: list[str] = []
    while len(out) < n:
        out += [names[i] for i in rng.permutation(len(names))]
    return out[:n]
