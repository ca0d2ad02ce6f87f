"""Recommend the manoeuvre that separates two hypotheses: the one in which they differ most per second."""

from collections.abc import Iterator

import numpy as np

from twin_worker.diagnosis.data.fault_hypothesis import FaultHypothesis
from twin_worker.diagnosis.data.flight import DT, STEP_S, FlightData, decimated
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals

_BANK, _SLOPE = np.radians(20.0), np.radians(3.0)
_FAST, _SLOW = 1.06, 0.94  # of the usual airspeed
_RATE_S = 1.0  # interval of command changes
_BUSY_PERCENTILE = 85  # percentile of those changes
_MIN_DURATION_S = 6.0  # least duration of a manoeuvre on this flight
_MIN_DENSITY_RATIO = 1.3  # least ratio to the mean of the flight for a recommendation
_REQUIRED_POWER = 150.0  # squared whitened difference that separates two hypotheses
_LONGEST_S = 600.0


def recommend_manoeuvre(whitened: WhitenedResiduals, hypothesis: FaultHypothesis, rival: FaultHypothesis) -> str:
    """Describe the manoeuvre with which the next diagnosis separates two hypotheses."""
    power = _difference_power(whitened, hypothesis, rival)
    density = {name: float(power[mask].mean()) / STEP_S for name, mask in _long_manoeuvres(whitened)}
    mean_density = float(power[whitened.ok].mean()) / STEP_S
    best = max(density, key=lambda name: density[name], default="")
    if not best or _REQUIRED_POWER / max(density[best], 1e-9) > _LONGEST_S:
        return "no manoeuvre of this flight separates them: vary speed, throttle and bank beyond this flight"
    seconds = _REQUIRED_POWER / density[best]
    if density[best] < _MIN_DENSITY_RATIO * mean_density:
        return f"no manoeuvre of this flight separates them better than the others: record {seconds:.0f} s more"
    return (
        f"{best}: {density[best] / mean_density:.1f} times the mean information of this flight; fly {seconds:.0f} "
        "s of it"
    )


def _difference_power(whitened: WhitenedResiduals, hypothesis: FaultHypothesis, rival: FaultHypothesis) -> np.ndarray:
    """Return the squared whitened difference of two hypotheses, the nuisances profiled out, (n,)."""
    d = whitened.residuals((hypothesis,)) - whitened.residuals((rival,))
    hidden = np.linalg.solve(whitened.Ann, np.einsum("tci,tc->i", whitened.Jn, d))
    return ((d - whitened.Jn @ hidden) ** 2).sum(axis=1)


def _long_manoeuvres(whitened: WhitenedResiduals) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each manoeuvre of sufficient duration with its rows, (n,) bool."""
    for name, mask in _manoeuvres(whitened.modelled.flight):
        mask = decimated(mask) & whitened.ok
        if mask.sum() * STEP_S >= _MIN_DURATION_S:
            yield name, mask


def _manoeuvres(flight: FlightData) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each manoeuvre with its rows on the grid of the flight, (n,) bool."""
    r = flight.readings
    speed = np.hypot(np.hypot(r["v_n"], r["v_e"]), r["v_d"])
    air = r.get("Va", speed)
    usual = float(np.median(air[flight.ok]))
    yield "turns", np.abs(r["phi"]) > _BANK
    yield "climbs", -r["v_d"] > np.sin(_SLOPE) * speed
    yield "descents", r["v_d"] > np.sin(_SLOPE) * speed
    yield "fast flight", air > _FAST * usual
    yield "slow flight", air < _SLOW * usual
    steps = round(_RATE_S / DT)
    for k, name in enumerate(("aileron doublets", "elevator doublets", "rudder doublets", "throttle steps")):
        change = np.abs(flight.commands - np.roll(flight.commands, steps, axis=0))[:, k]
        yield name, (change > np.percentile(change[flight.ok], _BUSY_PERCENTILE)) & (change > 0.0)
