"""Calibrate the simulation on nominal flights: coefficients, actuator timing, noise, spread, chance gains."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from twin_worker.diagnosis.baseline.fit import fit, fit_timing, loose
from twin_worker.diagnosis.data.card import Card
from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.diagnosis.data.flight import Flight
from twin_worker.diagnosis.inference.isolation.nuisance import WIDEST, nuisances, wandering, wanders
from twin_worker.diagnosis.inference.isolation.select_hypotheses import best
from twin_worker.diagnosis.inference.isolation.unmodelled import oddities
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.model.baseline import CHANNELS, Baseline, Noise, is_weather
from twin_worker.diagnosis.model.residual import Case
from twin_worker.diagnosis.model.weather import fit_wind, wind

_ROUNDS = 10  # expectation-maximisation rounds
_FADED = 4.0  # whitened rows per independent sample: whitening is incomplete
_SAFE = 1.05  # noise of new flights over that of the calibration flights
_SLOPES = 2.5, 10.0  # plausible lift slopes [1/rad]
_ODD = 4.0  # largest rms residual of a nominal flight over that of the others
_FLOWN = CHANNELS.index("gps_x")  # the first channels test the simulation, the rest compare two sensors
_LEAST_USUAL = 0.6  # least usual mean square of a channel

Say = Callable[[str], None]


def calibrate(flights: Sequence[Flight], card: Card, say: Say = lambda word: None) -> Baseline:
    """Calibrate the simulation on nominal flights.

    Args:
        flights: nominal flights; more flights and more excitation improve the result
        card: the aircraft, or `card.UNKNOWN`
        progress: callback for progress messages
    Raises:
        ValueError: if there is no flight, or the flights are not nominal flights of one aircraft.
    """
    if not flights:
        raise ValueError("calibrate: found no nominal flight, expected one at least; add recordings")
    vane = all(flight.vane for flight in flights)
    say("fitting the lags of servos and engine")
    timing = fit_timing(flights, card, vane)
    card = replace(card, body=replace(card.body, lag=timing.servo + timing.delay))
    base, winds = fit(flights, card, timing, vane)
    say("fitting without each flight in turn")
    parts = list(flights) if len(flights) > 1 else halves(flights[0])
    left = [fit([f for f in parts if f is not one], card, timing, vane)[0] for one in parts]
    cases = [Case(one, without) for one, without in zip(parts, left, strict=True)]
    others = tuple({name: b.coef[name] - x for name, x in base.coef.items()} for b in left)
    base = replace(base, others=(*others, loose([Case(flight, base) for flight in flights], winds)))
    _believable(base)
    _alike(cases)
    return settled(base, cases, [fit_wind(case, np.zeros(4)) for case in cases], say)


def settled(
    base: Baseline, cases: Sequence[Case], winds: Sequence[np.ndarray], say: Say, level: bool = False
) -> Baseline:
    """Return the baseline with noise, spreads, usual residuals and chance gains from left-out flights.

    Args:
        base: fitted on all flights
        modelled_flights: each flight under the coefficients of the others
        winds: weather of each flight, (4,)
        progress: callback for progress messages
        remove_mean: subtract the mean residual of each flight
    """
    base = _with_noise(base, cases, winds, level)
    say("computing the chance gains of nominal flights")
    chance: dict[str, float] = {}
    usual = []
    for case, w in zip(cases, winds, strict=True):
        sight = Sight(replaced(case, base), wind(w) if is_weather(base) else ())
        usual.append(sight.left())
        for found in best(sight, ()):
            chance[found.kind] = max(chance.get(found.kind, 0.0), found.gain)
        for odd in oddities(sight, sight):
            chance[odd.kind] = max(chance.get(odd.kind, 0.0), odd.worth)
    return replace(base, chance=chance, usual=np.maximum(np.median(usual, axis=0), _LEAST_USUAL))


def _believable(base: Baseline) -> None:
    """Reject a calibration that contradicts itself or the aircraft card."""
    worst = min(base.r2, key=lambda name: base.r2[name])
    if base.r2[worst] < 0.0:
        raise ValueError(
            f"{', '.join(base.flights)}: found {worst} explained to {base.r2[worst]:.0%}, expected "
            "consistent nominal flights of one aircraft; leave out flights with a fault or wind"
        )
    slope = -1.0 / base.coef["alpha"][1]
    if base.card.known and base.vane and not _SLOPES[0] < slope < _SLOPES[1]:
        raise ValueError(
            f"{base.card.name}: found a lift slope of {slope:.1f} per rad with its mass and wing area, expected "
            f"{_SLOPES[0]:g} to {_SLOPES[1]:g}; use the card of this aircraft"
        )


def _alike(cases: list[Case]) -> None:
    """Reject nominal flights if one deviates from the others."""
    rows = [case.residuals(wind(fit_wind(case, np.zeros(4))))[case.ok] for case in cases]
    rms = np.array([np.sqrt((x**2).mean(axis=0)) for x in rows])
    for k, case in enumerate(cases):
        ratio = rms[k] / np.maximum(np.median(np.delete(rms, k, axis=0), axis=0), 1e-6)
        ratio = np.where(np.arange(len(CHANNELS)) < _FLOWN, ratio, 0.0)
        worst = int(np.argmax(ratio))
        if ratio[worst] > _ODD:
            raise ValueError(
                f"{case.flight.name}: found {CHANNELS[worst]} {ratio[worst]:.0f} times as far from the simulation as "
                "on the other flights, expected nominal flights; leave it out, and diagnose it"
            )


def halves(flight: Flight) -> list[Flight]:
    """Split a flight into halves with disjoint valid rows."""
    middle = np.median(flight.t[flight.ok])
    return [replace(flight, ok=flight.ok & side) for side in (flight.t < middle, flight.t >= middle)]


def replaced(case: Case, base: Baseline) -> Case:
    """Return the flight under its coefficients with the noise and spreads of another baseline."""
    own = replace(
        case.base, noise=base.noise, spread=base.spread, usual=base.usual, chance=base.chance, others=base.others
    )
    return Case(case.flight, own, like=case)


def _with_noise(base: Baseline, cases: Sequence[Case], winds: Sequence[np.ndarray], level: bool) -> Baseline:
    """Estimate the noise and the spread of every nuisance from left-out flights."""
    granted = [wind(w) for w in winds]
    rows = [case.residuals(g) for case, g in zip(cases, granted, strict=True)]
    if level:
        rows = [x - x[case.ok].mean(axis=0) for x, case in zip(rows, cases, strict=True)]
    several = nuisances(base.vane)
    slopes = [_slopes(case, g, x) for case, g, x in zip(cases, granted, rows, strict=True)]
    noise = _noise(rows, cases)
    for _ in range(2):
        spread, means = _spreads(noise, cases, rows, slopes)
        noise = _noise([x + J @ m for x, J, m in zip(rows, slopes, means, strict=True)], cases)
    for k, n in enumerate(several):
        if n.effect.name == "wind_steady":
            spread[k] = max(spread[k], np.sqrt(np.mean([w[n.index] ** 2 for w in winds])))
    names = [*(n.name for n in several), *(one.name for one in wanders(several, base.vane))]
    named = dict(zip(names, spread.tolist(), strict=True))
    return replace(base, noise=Noise(noise.ar, noise.sigma * _SAFE), spread=named)


def _slopes(case: Case, granted: tuple[Guess, ...], rows: np.ndarray) -> np.ndarray:
    """Return the derivative of the residuals with respect to each nuisance, (n, c, nuisances)."""
    several = nuisances(case.base.vane)
    own = np.stack([(case.residuals((*granted, n.guess(n.step))) - rows) / n.step for n in several], axis=2)
    return np.concatenate([own, wandering(own, wanders(several, case.base.vane), case.t)], axis=2)


def _spreads(
    noise: Noise, cases: Sequence[Case], rows: list[np.ndarray], slopes: list[np.ndarray]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Estimate the spreads of the nuisances by expectation-maximisation; return them and the values of each flight.

    A nuisance that is not observable on a flight does not change its spread.  Source: Dempster, Laird & Rubin 1977.
    """
    several = nuisances(cases[0].base.vane)
    floors = np.array([*(n.floor for n in several), *(one.floor for one in wanders(several, cases[0].base.vane))])
    parts = []
    for case, x, J in zip(cases, rows, slopes, strict=True):
        white = noise.whiten(J)[case.ok]
        flat, e = white.reshape(-1, white.shape[2]), noise.whiten(x)[case.ok].ravel()
        parts.append((flat.T @ flat / _FADED, -flat.T @ e / _FADED))
    spread = floors.copy()
    for _ in range(_ROUNDS):
        inverse = [np.linalg.inv(A + np.diag(spread**-2.0)) for A, _ in parts]
        means = [P @ b for P, (_, b) in zip(inverse, parts, strict=True)]
        spread = np.sqrt(np.mean([m * m + np.diag(P) for m, P in zip(means, inverse, strict=True)], axis=0))
        spread = np.clip(spread, floors, WIDEST * floors)
    return spread, means


def _noise(rows: list[np.ndarray], cases: Sequence[Case]) -> Noise:
    """Fit a second-order autoregression and its innovations to each channel."""
    n = len(CHANNELS)
    ar, sigma = np.zeros((n, 2)), np.ones(n)
    for c in range(n):
        A, y = [], []
        for x, case in zip(rows, cases, strict=True):
            good = case.ok[2:] & case.ok[1:-1] & case.ok[:-2]
            A.append(np.column_stack([x[1:-1, c], x[:-2, c]])[good])
            y.append(x[2:, c][good])
        stacked, value = np.concatenate(A), np.concatenate(y)
        if not np.any(value):
            continue
        ridge = 1e-3 * np.linalg.norm(value) * np.eye(2)
        ar[c] = np.linalg.lstsq(np.vstack([stacked, ridge]), np.concatenate([value, [0.0, 0.0]]), rcond=None)[0]
        sigma[c] = np.sqrt(np.mean((value - stacked @ ar[c]) ** 2)) + 1e-9
    return Noise(ar, sigma)
