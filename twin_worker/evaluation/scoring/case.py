"""One evaluated start: the forecasts of every method, and the actual flight."""

from dataclasses import dataclass

import numpy as np

from fleet.frames import Origin

OURS = "ours"


@dataclass(frozen=True)
class MethodForecast:
    """Forecast of one method at one start.

    Attributes:
        path: NED, (k, 3) [m]
        source: the method itself, or the fallback that replaced it
        tube: half-axes along, cross, vertical, (k, 3) [m]; None where the method has none
        horizon_s: confidence horizon [s]; nan where the method has none
    """

    path: np.ndarray
    source: str
    tube: np.ndarray | None = None
    horizon_s: float = float("nan")


@dataclass(frozen=True)
class EvaluationStart:
    """One start with the data available at that time.

    Attributes:
        flight, uav: flight name and UAV id
        t: time of look-ahead 0 [s since 1970]
        first_s: time since the first sample [s]
        ahead: look-ahead of every method, rising, (k,) [s]
        origin: of the NED frame of all paths
        speed: over ground, climb included [m/s]
        no_route_reason: why the aircraft follows no mission; empty: it follows one
        group: calibration group of ours: method / law / vehicle / parameters
        forecasts: by method
        spread: ensemble spread of ours along, cross, vertical, (k, 3) [m]; nan without an ensemble
    """

    flight: str
    uav: int
    t: float
    first_s: float
    ahead: np.ndarray
    origin: Origin
    speed: float
    no_route_reason: str
    group: str
    forecasts: dict[str, MethodForecast]
    spread: np.ndarray


@dataclass(frozen=True)
class EvaluationCase:
    """One start and the actual flight after it.

    Attributes:
        start: the start
        positions: flown positions, NED, nan where unknown, (k, 3) [m]
        length: path length flown, at least two seconds of ground speed, (k,) [m]
        phase: climb, level, turn or descent, from the flight after the start
        route: mission on board, NED, (n, 3) [m]
        exclusion: reason for exclusion; empty: included
    """

    start: EvaluationStart
    positions: np.ndarray
    length: np.ndarray
    phase: str
    route: np.ndarray
    exclusion: str
