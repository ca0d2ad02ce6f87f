"""Calibrate the simulation on nominal flights: coefficients, actuator timing, noise, spread, chance gains."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from twin_worker.diagnosis.baseline.fit import drag_uncertainty, fit, fit_timing, terms_in_wind
from twin_worker.diagnosis.data.card import AircraftCard, FaultHypothesis
from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.inference.isolation.block_means import BLOCK_ROWS, BlockMeans, block_sigma
from twin_worker.diagnosis.inference.isolation.isolate import scan
from twin_worker.diagnosis.inference.isolation.nuisance import (
    MAX_SPREAD_RATIO,
    drift_modes,
    drift_slopes,
    list_nuisances,
)
from twin_worker.diagnosis.inference.isolation.search import best_hypotheses, has_size
from twin_worker.diagnosis.inference.isolation.unmodelled import find_anomalies, find_changed_coefficients
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNELS, Baseline, Noise, wind_is_nominal
from twin_worker.diagnosis.model.envelope import nominal_envelope
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.weather import fit_wind, weather_hypotheses

_ROUNDS = 10  # expectation-maximisation rounds
_ROWS_PER_SAMPLE = 4.0  # whitened rows per independent sample: whitening is incomplete
_NOISE_MARGIN = 1.05  # noise of new flights over that of the calibration flights
_LIFT_SLOPES = 2.5, 10.0  # plausible lift slopes [1/rad]
_MAX_RMS_RATIO = 4.0  # largest rms residual of a nominal flight over that of the others
_N_MODEL_CHANNELS = CHANNELS.index("gps_x")  # the first channels test the simulation, the rest compare two sensors
_MIN_USUAL = 0.6  # least usual mean square of a channel

ReportProgress = Callable[[str], None]


def calibrate(
    flights: Sequence[FlightData], card: AircraftCard, progress: ReportProgress = lambda message: None
) -> Baseline:
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
    progress("fitting the lags of servos and engine")
    timing = fit_timing(flights, card, vane)
    card = replace(card, body=replace(card.body, lag=timing.servo + timing.delay))
    base, winds = fit(flights, card, timing, vane)
    progress("fitting without each flight in turn")
    parts = list(flights) if len(flights) > 1 else halves(flights[0])
    partial_fits = [fit([f for f in parts if f is not part], card, timing, vane)[0] for part in parts]
    modelled_flights = list(map(ModelledFlight, parts, partial_fits))
    others = [{name: b.coef[name] - x for name, x in base.coef.items()} for b in partial_fits]
    whole_flights = [ModelledFlight(flight, base) for flight in flights]
    drag = drag_uncertainty(terms_in_wind(whole_flights, winds))
    base = replace(base, others=(*others, drag), envelope=nominal_envelope(whole_flights))
    _check_plausible(base)
    winds = [fit_wind(modelled, np.zeros(4)) for modelled in modelled_flights]
    _check_consistent(modelled_flights, winds)
    base = with_statistics(base, modelled_flights, winds)
    return with_chance_gains(base, modelled_flights, winds, progress)


def with_statistics(
    base: Baseline,
    modelled_flights: Sequence[ModelledFlight],
    winds: Sequence[np.ndarray],
    remove_mean: bool = False,
) -> Baseline:
    """Return the baseline with noise, spreads and usual residuals from left-out flights.

    Args:
        base: fitted on all flights
        modelled_flights: each flight under the coefficients of the others
        winds: weather of each flight, (4,)
        remove_mean: subtract the mean residual of each flight
    """
    base = _with_noise(base, modelled_flights, winds, remove_mean)
    flights = _whitened_flights(base, modelled_flights, winds)
    usual = np.median([whitened.mean_square() for whitened in flights], axis=0)
    floor = base.noise.sigma / np.sqrt(BLOCK_ROWS)  # of white noise
    sigma = np.maximum(np.sqrt(np.mean([block_sigma(whitened) ** 2 for whitened in flights], axis=0)), floor)
    return replace(base, usual=np.maximum(usual, _MIN_USUAL), block_sigma=sigma)


def with_chance_gains(
    base: Baseline,
    modelled_flights: Sequence[ModelledFlight],
    winds: Sequence[np.ndarray],
    progress: ReportProgress,
) -> Baseline:
    """Return the baseline with the gains that each effect and change reaches on left-out flights.

    Args:
        base: with the statistics of these flights
        modelled_flights: each flight under the coefficients of the others
        winds: weather of each flight, (4,)
        progress: callback for progress messages
    """
    progress("computing the chance gains of nominal flights")
    chance: dict[str, float] = {}
    block_chance: dict[str, float] = {}
    for whitened in _whitened_flights(base, modelled_flights, winds):
        scanned = scan(whitened)
        reached = [
            scored for scored in scanned if has_size(scored.hypothesis)
        ]  # the gain of a wrong sign is not reached
        for scored in (*reached, *best_hypotheses(whitened, scanned)):
            chance[scored.kind] = max(chance.get(scored.kind, 0.0), scored.gain)
        means = BlockMeans(whitened, base.block_sigma)
        without = means.cost(())
        for scored in reached:
            gain = without - means.cost((scored.hypothesis,))
            block_chance[scored.kind] = max(block_chance.get(scored.kind, 0.0), gain)
        for anomaly in (*find_anomalies(whitened), *find_changed_coefficients(whitened)):
            chance[anomaly.kind] = max(chance.get(anomaly.kind, 0.0), anomaly.net_gain)
    return replace(base, chance=chance, block_chance=block_chance)


def _whitened_flights(
    base: Baseline, modelled_flights: Sequence[ModelledFlight], winds: Sequence[np.ndarray]
) -> list[WhitenedResiduals]:
    """Return the residuals of left-out flights under the noise and the nuisances of the baseline."""
    flights = []
    for modelled, w in zip(modelled_flights, winds, strict=True):
        own = replace(modelled.base, noise=base.noise, spread=base.spread, others=base.others)
        weather = weather_hypotheses(w) if wind_is_nominal(base) else ()
        flights.append(WhitenedResiduals(modelled.with_base(own), weather))
    return flights


def _check_plausible(base: Baseline) -> None:
    """Reject a calibration that contradicts itself or the aircraft card."""
    worst = min(base.r2, key=lambda name: base.r2[name])
    if base.r2[worst] < 0.0:
        raise ValueError(
            f"{', '.join(base.flights)}: found {worst} explained to {base.r2[worst]:.0%}, expected "
            "consistent nominal flights of one aircraft; leave out flights with a fault or wind"
        )
    slope = -1.0 / base.coef["alpha"][1]
    if base.card.known and base.vane and not _LIFT_SLOPES[0] < slope < _LIFT_SLOPES[1]:
        raise ValueError(
            f"{base.card.name}: found a lift slope of {slope:.1f} per rad with its mass and wing area, expected "
            f"{_LIFT_SLOPES[0]:g} to {_LIFT_SLOPES[1]:g}; use the card of this aircraft"
        )


def _check_consistent(modelled_flights: list[ModelledFlight], winds: list[np.ndarray]) -> None:
    """Reject nominal flights if one deviates from the others.

    Gusts raise the scatter of all air channels together: the scatter of a channel is compared with that of the others.
    """
    pairs = zip(modelled_flights, winds, strict=True)
    residual_rows = [modelled.residuals(weather_hypotheses(w))[modelled.ok] for modelled, w in pairs]
    residual_rows = [x[:, :_N_MODEL_CHANNELS] for x in residual_rows]
    rms = np.array([np.sqrt((x**2).mean(axis=0)) for x in residual_rows])
    for k, (modelled, x) in enumerate(zip(modelled_flights, residual_rows, strict=True)):
        usual = np.maximum(np.median(np.delete(rms, k, axis=0), axis=0), 1e-6)
        scatter = x.std(axis=0) / usual
        ratio = np.maximum(scatter / max(float(np.median(scatter)), 1.0), np.abs(x.mean(axis=0)) / usual)
        worst = int(np.argmax(ratio))
        if ratio[worst] > _MAX_RMS_RATIO:
            raise ValueError(
                f"{modelled.flight.name}: found {CHANNELS[worst]} {ratio[worst]:.0f} times as far from the simulation "
                "as on the other flights, expected nominal flights; leave it out, and diagnose it"
            )


def halves(flight: FlightData) -> list[FlightData]:
    """Split a flight into halves with disjoint valid rows."""
    middle = np.median(flight.t[flight.ok])
    return [replace(flight, ok=flight.ok & side) for side in (flight.t < middle, flight.t >= middle)]


def _with_noise(
    base: Baseline, modelled_flights: Sequence[ModelledFlight], winds: Sequence[np.ndarray], remove_mean: bool
) -> Baseline:
    """Estimate the noise and the spread of every nuisance from left-out flights."""
    weathers = [weather_hypotheses(w) for w in winds]
    residual_rows = [modelled.residuals(g) for modelled, g in zip(modelled_flights, weathers, strict=True)]
    if remove_mean:
        residual_rows = [
            x - x[modelled.ok].mean(axis=0) for x, modelled in zip(residual_rows, modelled_flights, strict=True)
        ]
    nuisances = list_nuisances(base.vane)
    slopes = [_slopes(modelled, g, x) for modelled, g, x in zip(modelled_flights, weathers, residual_rows, strict=True)]
    modes = drift_modes(base.vane)
    floors = np.array([*(n.floor for n in nuisances), *(mode.floor for mode in modes)])
    noise = _noise(residual_rows, modelled_flights)
    for _ in range(2):
        spread, means = _spreads(noise, floors, modelled_flights, residual_rows, slopes)
        noise = _noise([x + J @ m for x, J, m in zip(residual_rows, slopes, means, strict=True)], modelled_flights)
    for k, n in enumerate(nuisances):
        if n.effect.name == "wind_steady":
            spread[k] = max(spread[k], np.sqrt(np.mean([w[n.index] ** 2 for w in winds])))
    names = [*(n.name for n in nuisances), *(mode.name for mode in modes)]
    spread_by_name = dict(zip(names, spread.tolist(), strict=True))
    return replace(base, noise=Noise(noise.ar, noise.sigma * _NOISE_MARGIN), spread=spread_by_name)


def _slopes(modelled: ModelledFlight, weather: tuple[FaultHypothesis, ...], residual_rows: np.ndarray) -> np.ndarray:
    """Return the derivative of the residuals with respect to each nuisance, (n, c, nuisances)."""
    nuisances = list_nuisances(modelled.base.vane)
    own = np.stack(
        [(modelled.residuals((*weather, n.hypothesis(n.step))) - residual_rows) / n.step for n in nuisances], axis=2
    )
    return np.concatenate([own, drift_slopes(own, drift_modes(modelled.base.vane), modelled.t)], axis=2)


def _spreads(
    noise: Noise,
    floors: np.ndarray,
    modelled_flights: Sequence[ModelledFlight],
    residual_rows: list[np.ndarray],
    slopes: list[np.ndarray],
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Estimate the spreads of the nuisances by expectation-maximisation; return them and the values of each flight.

    A nuisance that is not observable on a flight does not change its spread.  Source: Dempster, Laird & Rubin 1977.
    """
    parts = []
    for modelled, x, J in zip(modelled_flights, residual_rows, slopes, strict=True):
        white = noise.whiten(J)[modelled.ok]
        flat, e = white.reshape(-1, white.shape[2]), noise.whiten(x)[modelled.ok].ravel()
        parts.append((flat.T @ flat / _ROWS_PER_SAMPLE, -flat.T @ e / _ROWS_PER_SAMPLE))
    spread = floors.copy()
    for _ in range(_ROUNDS):
        inverse = [np.linalg.inv(A + np.diag(spread**-2.0)) for A, _ in parts]
        means = [P @ b for P, (_, b) in zip(inverse, parts, strict=True)]
        spread = np.sqrt(np.mean([m * m + np.diag(P) for m, P in zip(means, inverse, strict=True)], axis=0))
        spread = np.clip(spread, floors, MAX_SPREAD_RATIO * floors)
    return spread, means


def _noise(residual_rows: list[np.ndarray], modelled_flights: Sequence[ModelledFlight]) -> Noise:
    """Fit a second-order autoregression and its innovations to each channel."""
    n = len(CHANNELS)
    ar, sigma = np.zeros((n, 2)), np.ones(n)
    for c in range(n):
        A, y = [], []
        for x, modelled in zip(residual_rows, modelled_flights, strict=True):
            good = modelled.ok[2:] & modelled.ok[1:-1] & modelled.ok[:-2]
            A.append(np.column_stack([x[1:-1, c], x[:-2, c]])[good])
            y.append(x[2:, c][good])
        stacked, value = np.concatenate(A), np.concatenate(y)
        if not np.any(value):
            continue
        ridge = 1e-3 * np.linalg.norm(value) * np.eye(2)
        ar[c] = np.linalg.lstsq(np.vstack([stacked, ridge]), np.concatenate([value, [0.0, 0.0]]), rcond=None)[0]
        sigma[c] = np.sqrt(np.mean((value - stacked @ ar[c]) ** 2)) + 1e-9
    return Noise(ar, sigma)
