"""Standard deviations of fitted effects, and the manoeuvre that would distinguish two effects."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from fleet.effects import Body, Onset
from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.data.flight import DT, STEP_S, FlightData, decimated
from twin_worker.diagnosis.inference.isolation.refine import refine, slope_steps
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals

_BLOCK = 50  # rows of a block of the sandwich, 10 s
_PARTS = 4  # parts of the jackknife
_MIN_GATE = 0.01  # least gate value at which an effect is active
_MODEL_ERROR = 0.05  # relative model error of a parameter: 91 % of 147 true values of blind tests lie within 2 sigma
_CLOCK_S = 0.01  # uncertainty of message time stamps [s]


def covariances(
    whitened: WhitenedResiduals, weather: tuple[FaultHypothesis, ...], hypotheses: Sequence[FaultHypothesis]
) -> list[np.ndarray]:
    """Return the parameter covariance of each fitted hypothesis, (k, k).

    Sum of a sandwich estimate over blocks of 10 s (effects joint, nuisances profiled out), a jackknife that leaves out
    each quarter of the active time, and a floor.
    Source: White 1982 (sandwich); Efron & Tibshirani 1993, section 11.5.
    """
    whitened.condition_on(weather)
    sandwich = _sandwich(whitened, hypotheses)
    out, offset = [], 0
    for i, hypothesis in enumerate(hypotheses):
        k = len(hypothesis.par)
        others = (*weather, *(g for n, g in enumerate(hypotheses) if n != i))
        own = sandwich[offset : offset + k, offset : offset + k] + _jackknife(whitened, others, hypothesis)
        out.append(own + np.diag(_floor(whitened, hypothesis)))
        offset += k
    return out


def _floor(whitened: WhitenedResiduals, hypothesis: FaultHypothesis) -> np.ndarray:
    """Return the least variance, (k,): time stamps, model error, and the nominal spread of the aircraft.

    An effect that is always present is not separable from the nominal spread.
    """
    times = np.array([p.unit == "s" for p in hypothesis.effect.parameters])
    usual = np.zeros(len(times))
    for n in whitened.nuisances:
        if hypothesis.onset.kind is Onset.ALWAYS and (n.effect.name, n.target) == (
            hypothesis.effect.name,
            hypothesis.target,
        ):
            usual[n.index] = whitened.spread(n)
    return times * _CLOCK_S**2 + (_MODEL_ERROR * np.array(hypothesis.par)) ** 2 + usual**2


def reported_sigma(hypothesis: FaultHypothesis, covariance: np.ndarray, body: Body) -> dict[str, float]:
    """Propagate a parameter covariance to the standard deviations of the reported values."""
    effect, par = hypothesis.effect, np.array(hypothesis.par)
    reference = effect.values(par, body)
    h = slope_steps(hypothesis) * 1e-2
    J: dict[str, np.ndarray] = {}
    for k in range(len(par)):
        moved = effect.values(par + h[k] * np.eye(len(par))[k], body)
        for name, x in moved.items():
            change = x - reference[name]
            if name == "from_deg":
                change = (change + 180.0) % 360.0 - 180.0
            J.setdefault(name, np.zeros(len(par)))[k] = change / h[k]
    return {name: float(np.sqrt(max(row @ covariance @ row, 0.0))) for name, row in J.items()}


def _sandwich(whitened: WhitenedResiduals, hypotheses: Sequence[FaultHypothesis]) -> np.ndarray:
    e = whitened.clipped(hypotheses)
    columns = []
    for i, hypothesis in enumerate(hypotheses):
        others = [g for n, g in enumerate(hypotheses) if n != i]
        par = np.array(hypothesis.par)
        for k, h in enumerate(slope_steps(hypothesis)):
            moved = hypothesis.with_parameters(par + h * np.eye(len(par))[k])
            moved = moved if moved.par[k] != par[k] else hypothesis.with_parameters(par - h * np.eye(len(par))[k])
            columns.append((whitened.clipped([*others, moved]) - e) / (moved.par[k] - par[k] or 1.0))
    J = np.stack(columns, axis=2)
    C = np.einsum("tci,tcj->ij", J, whitened.Jn)
    inverse = np.linalg.pinv(np.einsum("tci,tcj->ij", J, J) - C @ np.linalg.solve(whitened.Ann, C.T))
    free = J - whitened.Jn @ np.linalg.solve(whitened.Ann, C.T)
    score = np.einsum("tci,tc->ti", free, e)
    blocks = np.add.reduceat(score, np.arange(0, len(score), _BLOCK), axis=0)
    covariance = inverse @ (blocks.T @ blocks) @ inverse
    inflation = np.sqrt(np.maximum(np.diag(inverse) / np.maximum(np.diag(covariance), 1e-300), 1.0))
    return covariance * np.outer(inflation, inflation)


def _jackknife(
    whitened: WhitenedResiduals, conditions: tuple[FaultHypothesis, ...], hypothesis: FaultHypothesis
) -> np.ndarray:
    """Return the jackknife covariance over the quarters of the active time, (k, k)."""
    whitened.condition_on(conditions)
    t = whitened.modelled.t
    active_t = t[(hypothesis.onset.gate(t) > _MIN_GATE) & whitened.ok]
    if len(active_t) < 4 * _BLOCK:
        return np.zeros((len(hypothesis.par),) * 2)
    edges = np.quantile(active_t, np.linspace(0, 1, _PARTS + 1))
    fits = []
    for low, high in pairwise(edges):
        part = whitened.part((t < low) | (t >= high))
        fits.append(refine(part, hypothesis, iterations=2, move_onset=False).hypothesis.par)
    deviation = np.array(fits) - np.mean(fits, axis=0)
    return (_PARTS - 1) / _PARTS * deviation.T @ deviation


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
    d = whitened.residuals((hypothesis,)) - whitened.residuals((rival,))
    hidden = np.linalg.solve(whitened.Ann, np.einsum("tci,tc->i", whitened.Jn, d))
    power = ((d - whitened.Jn @ hidden) ** 2).sum(axis=1)
    rows = {name: decimated(mask) & whitened.ok for name, mask in _manoeuvres(whitened.modelled.flight)}
    long = {name: mask for name, mask in rows.items() if mask.sum() * STEP_S >= _MIN_DURATION_S}
    density = {name: float(power[mask].mean()) / STEP_S for name, mask in long.items()}
    mean_density = float(power[whitened.ok].mean()) / STEP_S
    best = max(density, key=lambda name: density[name], default="")
    if not best or _REQUIRED_POWER / max(density[best], 1e-9) > _LONGEST_S:
        return "no manoeuvre of this flight separates them: vary speed, throttle and bank beyond this flight"
    seconds = _REQUIRED_POWER / density[best]
    if density[best] < _MIN_DENSITY_RATIO * mean_density:
        return f"no manoeuvre of this flight separates them better than the others: record {seconds:.0f} s more"
    ratio = density[best] / mean_density
    return f"{best}: {ratio:.1f} times the mean information of this flight; fly {seconds:.0f} s of it"


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
