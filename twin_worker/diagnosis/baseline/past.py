"""Calibrate on the trusted first part of a flight, to diagnose the rest without other flights.

A short past excites few axes. Every uncertain direction of the coefficients that the later flight excites becomes a
nuisance. An equation that does not predict the left-out pieces is not covered. Effects present from the start are
part of the baseline and never a finding.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fleet.effects import Stage
from fleet.process.sanitise import format_below
from twin_worker.diagnosis.baseline.calibrate import with_chance_gains, with_statistics
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
from twin_worker.diagnosis.data.card import AircraftCard, FaultHypothesis
from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNELS, IGNORED_SIGMA, Baseline, Noise, exclude_equations
from twin_worker.diagnosis.model.equations import TERMS
from twin_worker.diagnosis.model.residual import EquationTerms, ModelledFlight
from twin_worker.diagnosis.model.weather import RAW_ROWS_PER_SAMPLE, weather_hypotheses

PIECES = 4  # pieces of the past, each predicted from the others
MIN_PAST_S = 40.0  # least length of valid past
CONTEXT_S = 30.0  # past included in the diagnosed part, as data before an onset
_RIDGE = 0.02  # ridge share for short data
ROWS_PER_SAMPLE = 4.0  # whitened rows per independent sample: whitening is incomplete
_MIN_VISIBLE_SHARE = 0.1  # least effect of an uncertain direction, as a share of the equation scatter
_MIN_DETERMINED = 3.0  # least derivative of a surface, in standard deviations
_DERIVATIVES = {"aileron": ("L", "delta_a"), "elevator": ("M", "delta_e"), "rudder": ("N", "delta_r")}
_WIND_SPREAD = 2.5  # least spread of the mean wind [m/s]
_MIN_AT_AIRSPEED = 0.3  # least share of the past at an airspeed that it tells the flight at [-]
_BIAS_RANGE = 50.0  # prior of a sensor bias, in floors
_MIN_AIRSPEED_STD = 0.3  # least scatter of airspeed [m/s]
_PRIOR_STD = (0.1, 10.0, 10.0, 1.0, 1.0)  # airspeed scale, wind [m/s], wind shear [m/s per 100 m]
_MIN_R2 = -0.5  # least share of variance predicted; equations below are ignored

ReportProgress = Callable[[str], None]


class CoefficientUncertainty(NamedTuple):
    """Square root of the posterior covariance of one equation's coefficients, (k, k), and scatter of the equation."""

    root: np.ndarray
    scatter: float


class CommandedAirspeeds(NamedTuple):
    """Quantiles of the commanded airspeed in the past, (101,), and scatter of the flown one about it [m/s]."""

    quantiles: np.ndarray
    scatter: float

    def contain(self, speed: float) -> bool:
        """Return whether enough of the past was flown at an airspeed [m/s]."""
        return float((np.abs(self.quantiles - speed) <= self.scatter).mean()) >= _MIN_AT_AIRSPEED


@dataclass(frozen=True)
class PastModel:
    """Calibration on a trusted part of flight, for any later part.

    Attributes:
        base: with the uncertain directions that the past excites
        uncertainty: equation -> uncertainty of its coefficients
        weather: of the past, (4,)
        seconds: valid flight [s]
        airspeeds: commanded airspeeds; None: not reported
    """

    base: Baseline
    uncertainty: dict[str, CoefficientUncertainty]
    weather: np.ndarray
    seconds: float
    airspeeds: CommandedAirspeeds | None = None

    def baseline(self, flight: FlightData) -> Baseline:
        """Return the baseline to diagnose a later flight with."""
        ratio = max(flight.seconds / self.seconds, 1.0)  # the longer the flight, the larger a gain by chance
        return replace(
            self.base,
            others=_visible_directions(flight, self.base, self.uncertainty, self.weather),
            chance={kind: ratio * gain for kind, gain in self.base.chance.items()},
        )


def calibrate_past(
    past: FlightData,
    card: AircraftCard,
    progress: ReportProgress = lambda message: None,
    concealed: FlightData | None = None,
) -> PastModel:
    """Calibrate on a trusted part of flight.

    Args:
        past: the trusted part
        card: the aircraft, or `card.UNKNOWN`
        progress: callback for progress messages
        concealed: the same part with concealed channels, to estimate noise and chance gains
    Raises:
        ValueError: if the past is too short; the message gives its length.
    """
    if past.seconds < MIN_PAST_S:
        raise ValueError(
            f"{past.name}: found {format_below(past.seconds, MIN_PAST_S)} s of trusted flight before "
            f"{past.t[-1] if len(past.t) else 0.0:.0f} s, expected {MIN_PAST_S:.0f} s at least; trust a longer past, "
            "or calibrate on other flights"
        )
    progress(f"{past.name}: calibrating on its own past, {past.seconds:.0f} s of trusted flight")
    timing = fit_timing([past], card, past.vane)
    card = replace(card, body=replace(card.body, lag=timing.servo + timing.delay))
    base, (weather,) = fit([past], card, timing, past.vane, _RIDGE)
    pieces = split(past)
    partial_fits = [fit([replace(past, ok=past.ok & ~piece.ok)], card, timing, past.vane, _RIDGE) for piece in pieces]
    partial_bases, winds = [partial for partial, _ in partial_fits], [w for _, (w,) in partial_fits]
    modelled_flights = list(map(ModelledFlight, pieces, partial_bases))
    modelled_past = ModelledFlight(past, base)
    uncertainty = _coefficient_uncertainty(modelled_past, weather)
    base = replace(
        base,
        others=_visible_directions(past, base, uncertainty, weather),
        r2=_predicted_share(modelled_flights, winds),
        undetermined=_undetermined_surfaces(base, uncertainty),
    )
    if concealed is not None:
        concealed_pieces = [replace(concealed, ok=piece.ok) for piece in pieces]
        modelled_flights = list(map(ModelledFlight, concealed_pieces, partial_bases))
    base = with_statistics(base, modelled_flights, winds, remove_mean=True)
    base = with_chance_gains(base, [_LeftOut(modelled_flights, base)], [weather], progress)
    base = exclude_equations(base, [name for name, share in base.r2.items() if share < _MIN_R2])
    modelled_past = modelled_past.with_base(base)
    # the barometer drifts over minutes, and the pieces of the past are too short: ignore it
    is_baro = np.arange(len(CHANNELS)) == CHANNELS.index("baro")
    base = replace(
        base,
        noise=Noise(base.noise.ar, np.where(is_baro, IGNORED_SIGMA, base.noise.sigma)),
        block_sigma=np.where(is_baro, IGNORED_SIGMA, base.block_sigma),
        spread=base.spread | _bias_spreads(modelled_past, weather) | _weather_spreads(modelled_past, weather),
    )
    return PastModel(base, uncertainty, weather, past.seconds, _airspeeds(past))


def commanded_airspeed(flight: FlightData) -> np.ndarray | None:
    """Return the airspeed setpoint, (n,) [m/s]; None where the autopilot does not report it."""
    if not {"Va", "slow"} <= set(flight.readings):
        return None
    return np.asarray(flight.readings["Va"] + flight.readings["slow"])


def _airspeeds(past: FlightData) -> CommandedAirspeeds | None:
    speed = commanded_airspeed(past)
    if speed is None:
        return None
    quantiles = np.quantile(speed[past.ok], np.linspace(0.0, 1.0, 101))
    return CommandedAirspeeds(quantiles, float(past.readings["slow"][past.ok].std()))


class _LeftOut(ModelledFlight):
    """The past as one flight, each piece under the coefficients of the others.

    Args:
        pieces: the same flight with disjoint valid rows, each under a baseline
        base: of all pieces
    """

    def __init__(self, pieces: list[ModelledFlight], base: Baseline) -> None:
        flight = replace(pieces[0].flight, ok=np.logical_or.reduce([piece.flight.ok for piece in pieces]))
        super().__init__(flight, base, template=pieces[0])
        self._pieces = pieces
        self._which = np.argmax([piece.ok for piece in pieces], axis=0)

    def with_base(self, base: Baseline) -> "_LeftOut":
        """Return the same flight, the coefficients of each piece changed like those of the baseline."""
        pieces = []
        for piece in self._pieces:
            coef = {name: x + base.coef[name] - self.base.coef[name] for name, x in piece.base.coef.items()}
            pieces.append(piece.with_base(replace(base, coef=coef, airspeed=piece.base.airspeed)))
        return _LeftOut(pieces, base)

    def _compute_residuals(self, hypotheses: tuple[FaultHypothesis, ...]) -> np.ndarray:
        rows = np.arange(len(self.t))
        out = np.stack([piece.residuals(hypotheses) for piece in self._pieces])[self._which, rows]
        out.flags.writeable = False
        return out


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


def _coefficient_uncertainty(modelled: ModelledFlight, weather: np.ndarray) -> dict[str, CoefficientUncertainty]:
    """Return the posterior uncertainty of the coefficients of every equation.

    The prior lets each term alone explain all variance.
    Source: Klein & Morelli 2006, section 5.1 (Bayesian estimation).
    """
    out = {}
    for name, data in _regressions(modelled.equation_terms(weather_hypotheses(weather))).items():
        x = stacked_coef(modelled.base.coef, name)
        whiten = data.whitener(x)
        A, e = whiten(data.A)[data.lagged_ok], whiten(data.y - data.A @ x)[data.lagged_ok]
        prior_std = np.sqrt((data.y[data.ok] ** 2).mean() / ((data.A[data.ok] ** 2).mean(axis=0) + 1e-12))
        precision = A.T @ A / (ROWS_PER_SAMPLE * e.var()) + np.diag(prior_std**-2.0)
        root = np.linalg.cholesky(np.linalg.inv(precision))
        out[name] = CoefficientUncertainty(root, float(data.residuals(x).std()))
    return out


def _visible_directions(
    flight: FlightData, base: Baseline, uncertainty: dict[str, CoefficientUncertainty], weather: np.ndarray
) -> tuple[dict[str, np.ndarray], ...]:
    """Return the uncertain coefficient directions that a flight excites, one standard deviation each.

    The principal axes of the uncertainty in its effect on the flight.
    Source: Golub & Van Loan 2013, section 8.7.
    """
    out = []
    for name, data in _regressions(ModelledFlight(flight, base).equation_terms(weather_hypotheses(weather))).items():
        root, scatter = uncertainty[name]
        B = data.A[data.ok] @ root
        eigenvalues, eigenvectors = np.linalg.eigh(B.T @ B / len(B))
        visible = np.sqrt(np.maximum(eigenvalues, 0.0)) > _MIN_VISIBLE_SHARE * scatter
        out += [coef_change(base.coef, name, d) for d in (root @ eigenvectors[:, visible]).T]
    return tuple(out)


def _undetermined_surfaces(base: Baseline, uncertainty: dict[str, CoefficientUncertainty]) -> tuple[str, ...]:
    """Return the surfaces whose derivative is within `_MIN_DETERMINED` standard deviations of zero.

    A surface that moves in proportion to another, as a rudder mixed with the aileron, has no derivative of its own:
    a fault of either shows as one of the other.
    """
    out = []
    for surface, (equation, term) in _DERIVATIVES.items():
        k = TERMS[equation].index(term)
        if abs(base.coef[equation][k]) < _MIN_DETERMINED * np.linalg.norm(uncertainty[equation].root[k]):
            out.append(surface)
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
