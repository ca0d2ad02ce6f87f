"""Table of autopilot parameters: names, defaults, ranges, older names."""

from collections.abc import Mapping
from math import isfinite
from typing import NamedTuple


class ParameterSpec(NamedTuple):
    """One parameter: name, default and range in autopilot units, factor to SI, older names with their factor."""

    name: str
    default: float
    factor: float
    low: float
    high: float
    old_names: tuple[tuple[str, float], ...] = ()  # (older name, older unit in units of the new one)


def eas2tas(altitude_m: float) -> float:
    """Return the ratio of true to equivalent airspeed at a height above sea level [m]. Source: ISA, troposphere."""
    h = min(max(altitude_m, -500.0), 11_000.0) if isfinite(altitude_m) else 0.0
    return float((1 - 2.25577e-5 * h) ** (-4.25588 / 2))


def lookup(spec: ParameterSpec, values: Mapping[str, float]) -> float | None:
    """Return the value by current or older name; None if it is missing, not finite or out of range."""
    for name, unit in ((spec.name, 1.0), *spec.old_names):
        value = values.get(name)
        if value is not None and isfinite(value) and spec.low <= value * unit <= spec.high:
            return value * unit
    return None
