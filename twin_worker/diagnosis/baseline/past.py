"""Calibrate on the trusted first part of a flight, to diagnose the rest without other flights.

A short past excites few axes. Every uncertain direction of the coefficients that the rest of the flight excites becomes
a nuisance. An equation that does not predict the left-out pieces is not covered. Effects present from the start are
part of the baseline and never a finding.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fleet.effects import Onset, Stage, catalogue
from fleet.process.sanitise import format_below
from twin_worker.diagnosis.baseline.calibrate import with_statistics
from twin_worker.diagnosis.baseline.fit import (
    RegressionData,
    axial_regression,
    coef_change,
    fit,
    fit_timing,
    pitch_regression,
    stacked_coef,
    terms_in_wind,
)
from twin_worker.diagnosis.data.card import AircraftCard
from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNELS, IGNORED_SIGMA, Baseline, Noise, exclude_equations
from twin_worker.diagnosis.model.residual import EquationTerms, ModelledFlight
from twin_worker.diagnosis.model.weather import RAW_ROWS_PER_SAMPLE, weather_hypotheses

PIECES = 4  # pieces of the past, each predicted from the others
MIN_PAST_S = 40.0  # least length of valid past
CONTEXT_S = 30.0  # past included in the diagnosed part, as data before an onset
UNREACHABLE_GAIN = 1e9  # a gain that no hypothesis reaches
_RIDGE = 0.02  # ridge share for short data
_ROWS_PER_SAMPLE = 4.0  # whitened rows per independent sample: whitening is incomplete
_MIN_VISIBLE_SHARE = 0.1  # least effect of an uncertain direction, as a share of the equation scatter
_MIN_GAIN = 400.0  # least chance gain of any effect
_WIND_SPREAD = 2.5  # least spread of the mean wind [m/s]
_BIAS_RANGE = 50.0  # prior of a sensor bias, in floors
_MIN_AIRSPEED_STD = 0.3  # least scatter of airspeed [m/s]
_PRIOR_STD = (0.1, 10.0, 10.0, 1.0, 1.0)  # airspeed scale, wind [m/s], wind shear [m/s per 100 m]
_MIN_R2 = -0.5  # least share of variance predicted; equations below are ignored

ReportProgress = Callable[[str], None]


def calibrate_past(
    flight: FlightData,
    until: float,
    card: AircraftCard,
    progress: ReportProgress = lambda message: None,
    concealed: FlightData | None = None,
) -> Baseline:
    """Calibrate on the part of a flight before `until` [s, on its own clock].

    Args:
        flight: whole recording; the part after `until` only determines which directions it excites
        until: end of the trusted past
        card: the aircraft, or `card.UNKNOWN`
        progress: callback for progress messages
        concealed: the same flight with concealed channels, to estimate noise and chance gains
    Raises:
        ValueError: if the past is too short; the message gives its length.
    """
    past = part_before(flight, until)
    if past.seconds < MIN_PAST_S:
        raise ValueError(
            f"{flight.name}: found {format_below(past.seconds, MIN_PAST_S)} s of trusted flight before "
            f"{until:.0f} s, expected "
            f"{MIN_PAST_S:.0f} s at least; trust a longer past, or calibrate on other flights"
        )
    progress(f"{flight.name}: calibrating on its own past, {past.seconds:.0f} s of trusted flight")
    timing = fit_timing([past], card, past.vane)
    card = replace(card, body=replace(card.body, lag=timing.servo + timing.delay))
    base, (weather,) = fit([past], card, timing, past.vane, _RIDGE)
    pieces = split(past)
    partial_fits = [fit([replace(past, ok=past.ok & ~piece.ok)], card, timing, past.vane, _RIDGE) for piece in pieces]
    partial_bases, winds = [partial for partial, _ in partial_fits], [w for _, (w,) in partial_fits]
    modelled_flights = list(map(ModelledFlight, pieces, partial_bases))
    r2 = _predicted_share(modelled_flights, winds)
    base = replace(base, others=_uncertain_directions(flight, past, base, weather), r2=r2)
    if concealed is not None:
        concealed_pieces = [replace(part_before(concealed, until), ok=piece.ok) for piece in pieces]
        modelled_flights = list(map(ModelledFlight, concealed_pieces, partial_bases))
    base = with_statistics(base, modelled_flights, winds, progress, remove_mean=True)
    later_s = part_after(flight, until).seconds
    base = exclude_equations(base, [name for name, share in base.r2.items() if share < _MIN_R2])
    modelled_past = ModelledFlight(past, base)
    # the barometer drifts over minutes, and the pieces of the past are too short: ignore it
    is_baro = np.arange(len(CHANNELS)) == CHANNELS.index("baro")
    return replace(
        base,
        noise=Noise(base.noise.ar, np.where(is_baro, IGNORED_SIGMA, base.noise.sigma)),
        block_sigma=np.where(is_baro, IGNORED_SIGMA, base.block_sigma),
        spread=base.spread | _bias_spreads(modelled_past, weather) | _weather_spreads(modelled_past, weather),
        chance=_chance_gains(base, max(later_s, past.seconds) * len(pieces) / past.seconds),
    )


def part_before(flight: FlightData, until: float) -> FlightData:
    """Return the part of a flight before `until` [s, on its own clock]."""
    return _part(flight, slice(0, int(np.searchsorted(flight.t, until))))


def part_after(flight: FlightData, start: float) -> FlightData:
    """Return the part of a flight from `start` on [s, on its own clock]."""
    return _part(flight, slice(int(np.searchsorted(flight.t, start)), None))


def _part(flight: FlightData, span: slice) -> FlightData:
    readings = {name: x[span] for name, x in flight.readings.items()}
    t, commands, place, ok = (x[span] for x in (flight.t, flight.commands, flight.position, flight.ok))
    return replace(flight, t=t, readings=readings, commands=commands, position=place, ok=ok)


def split(past: FlightData, pieces: int = PIECES) -> list[FlightData]:
    """Split the past into pieces of equal valid length, with disjoint valid rows."""
    edges = np.quantile(past.t[past.ok], np.linspace(0.0, 1.0, pieces + 1)[1:-1])
    which = np.searchsorted(edges, past.t, side="right")
    return [replace(past, ok=past.ok & (which == k)) for k in range(pieces)]


def _regressions(terms: EquationTerms) -> dict[str, RegressionData]:
    """Return the regression data of every separately fitted equation."""
    out = {name: RegressionData([terms], name) for name in ("alpha", "beta", "L", "N")}
    return out | {"X": axial_regression([terms]), "M": pitch_regression([terms], terms.modelled.base.coef)}


def _predicted_share(modelled_flights: list[ModelledFlight], winds: list[np.ndarray]) -> dict[str, float]:
    """Return the share of variance of every equation that the other pieces predict."""
    errors: dict[str, list[np.ndarray]] = {}
    measured: dict[str, list[np.ndarray]] = {}
    for terms in terms_in_wind(modelled_flights, winds):
        for name, data in _regressions(terms).items():
            error, y = data.residuals(stacked_coef(terms.modelled.base.coef, name)), data.y[data.ok]
            errors.setdefault(name, []).append(error - error.mean())  # trim may differ
            measured.setdefault(name, []).append(y - y.mean())
    out = {}
    for name, parts in errors.items():
        unexplained, total = (float((np.concatenate(x) ** 2).sum()) for x in (parts, measured[name]))
        out[name] = 1.0 - unexplained / max(total, 1e-12)
    return out


def _uncertain_directions(
    flight: FlightData, past: FlightData, base: Baseline, weather: np.ndarray
) -> tuple[dict[str, np.ndarray], ...]:
    """Return the uncertain coefficient directions that the flight excites, one standard deviation each.

    The posterior covariance of the coefficients of each equation, under a prior in which each term alone may explain
    all variance, in the principal axes of its effect on the whole flight.
    Source: Klein & Morelli 2006, section 5.1 (Bayesian estimation); Golub & Van Loan 2013, section 8.7.
    """
    past_data, flight_data = (
        _regressions(ModelledFlight(part, base).equation_terms(weather_hypotheses(weather))) for part in (past, flight)
    )
    out = []
    for name, data in past_data.items():
        x = stacked_coef(base.coef, name)
        whiten = data.whitener(x)
        A, e = whiten(data.A)[data.lagged_ok], whiten(data.y - data.A @ x)[data.lagged_ok]
        prior_std = np.sqrt((data.y[data.ok] ** 2).mean() / ((data.A[data.ok] ** 2).mean(axis=0) + 1e-12))
        precision = A.T @ A / (_ROWS_PER_SAMPLE * e.var()) + np.diag(prior_std**-2.0)
        root = np.linalg.cholesky(np.linalg.inv(precision))
        B = flight_data[name].A[flight_data[name].ok] @ root
        eigenvalues, eigenvectors = np.linalg.eigh(B.T @ B / len(B))
        visible = np.sqrt(np.maximum(eigenvalues, 0.0)) > _MIN_VISIBLE_SHARE * data.residuals(x).std()
        out += [coef_change(base.coef, name, d) for d in (root @ eigenvectors[:, visible]).T]
    return tuple(out)


def _bias_spreads(modelled: ModelledFlight, weather: np.ndarray) -> dict[str, float]:
    """Return spreads of at least twice the sensor biases in the past, so that they are no finding later."""
    whitened = WhitenedResiduals(modelled, weather_hypotheses(weather))
    floors = np.array([n.floor for n in whitened.nuisances])
    sensors = np.array([n.effect.stage is Stage.SENSOR for n in whitened.nuisances])
    k = len(floors)
    precision = whitened.precision.copy()
    precision[:k] = np.where(sensors, (_BIAS_RANGE * floors) ** -2.0, precision[:k])
    x = np.linalg.solve(whitened.Ann - np.diag(whitened.precision) + np.diag(precision), whitened.bn)[:k]
    entries = zip(whitened.nuisances, x, sensors, strict=True)
    return {n.name: max(modelled.base.spread[n.name], 2.0 * abs(float(bias))) for n, bias, sensor in entries if sensor}


def _weather_spreads(modelled: ModelledFlight, weather: np.ndarray) -> dict[str, float]:
    """Return spreads of wind and airspeed scale, which a past with few headings does not determine.

    Airspeed over the headings and heights of the past determines scale, wind and wind shear jointly.
    """
    s, flow = modelled.corrected_readings(()), modelled.equation_terms(weather_hypotheses(weather)).flow
    along = np.array([s["v_n"], s["v_e"]]) / np.maximum(np.hypot(s["v_n"], s["v_e"]), 1.0)
    H = np.stack([flow.Va, *along, *(along * flow.height / 100.0)], axis=1)[modelled.ok]
    e = modelled.residuals(weather_hypotheses(weather))[modelled.ok, CHANNELS.index("airspeed")]
    precision = H.T @ H / (RAW_ROWS_PER_SAMPLE * max(e.var(), _MIN_AIRSPEED_STD**2))
    precision = precision + np.diag(np.array(_PRIOR_STD) ** -2.0)
    scale = float(np.sqrt(np.linalg.inv(precision)[0, 0]))
    out = {"airspeed_scale:log_scale": max(scale, modelled.base.spread["airspeed_scale:log_scale"])}
    for axis in ("w_n", "w_e"):
        out[f"wind_steady:{axis}"] = max(_WIND_SPREAD, modelled.base.spread[f"wind_steady:{axis}"])
    return out


def _chance_gains(base: Baseline, duration_ratio: float) -> dict[str, float]:
    """Return the chance gains for the rest of the flight, `duration_ratio` times longer than a piece.

    A permanent effect was active in the past and is part of the baseline: its gain is unreachable.
    """
    out = {kind: max(_MIN_GAIN, duration_ratio * gain) for kind, gain in base.chance.items()}
    for effect in catalogue().values():
        for target in effect.targets or ("",):
            label = f"{effect.name}:{target}" if target else effect.name
            for onset in effect.onsets:
                out.setdefault(f"{label}|{onset}", _MIN_GAIN)
                if onset is Onset.ALWAYS:
                    out[f"{label}|{onset}"] = UNREACHABLE_GAIN
    return out
