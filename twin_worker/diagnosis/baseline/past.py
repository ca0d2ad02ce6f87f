"""Calibrate on the trusted first part of a flight, to diagnose the rest without other flights.

A short past excites few axes. Every uncertain direction of the coefficients that the rest of the flight excites becomes
a nuisance. An equation that does not predict the left-out pieces is not covered. Effects present from the start are
part of the baseline and never a finding.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fleet.effects import Onset, Stage, catalogue
from fleet.process.sanitise import below
from twin_worker.diagnosis.baseline.calibrate import settled
from twin_worker.diagnosis.baseline.fit import Rows, axial, fit, fit_timing, pitch
from twin_worker.diagnosis.data.card import Card
from twin_worker.diagnosis.data.flight import Flight
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.baseline import CHANNELS, DEAF, Baseline, Noise, silenced
from twin_worker.diagnosis.model.residual import Case, Terms
from twin_worker.diagnosis.model.weather import CORRELATED, wind

PIECES = 4  # pieces of the past, each predicted from the others
LEAST_S = 40.0  # least length of valid past
BEFORE_S = 30.0  # past included in the diagnosed part, as data before an onset
NEVER = 1e9  # a gain that no hypothesis reaches
_RIDGE = 0.02  # ridge share for short data
_FADED = 4.0  # whitened rows per independent sample: whitening is incomplete
_SHOWS = 0.1  # least effect of an uncertain direction, as a share of the equation scatter
_LEAST_GAIN = 400.0  # least chance gain of any effect
_WIND = 2.5  # least spread of the mean wind [m/s]
_ANY_BIAS = 50.0  # prior of a sensor bias, in floors
_AIRSPEED = 0.3  # least scatter of airspeed [m/s]
_PRIOR = (0.1, 10.0, 10.0, 1.0, 1.0)  # airspeed scale, wind [m/s], wind shear [m/s per 100 m]
_WORSE = -0.5  # least share of variance predicted; equations below are ignored

Say = Callable[[str], None]


def calibrate_past(
    flight: Flight, until: float, card: Card, say: Say = lambda word: None, shown: Flight | None = None
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
    past = before(flight, until)
    if past.seconds < LEAST_S:
        raise ValueError(
            f"{flight.name}: found {below(past.seconds, LEAST_S)} s of trusted flight before {until:.0f} s, expected "
            f"{LEAST_S:.0f} s at least; trust a longer past, or calibrate on other flights"
        )
    say(f"{flight.name}: calibrating on its own past, {past.seconds:.0f} s of trusted flight")
    timing = fit_timing([past], card, past.vane)
    card = replace(card, body=replace(card.body, lag=timing.servo + timing.delay))
    base, (weather,) = fit([past], card, timing, past.vane, _RIDGE)
    pieces = split(past)
    left = [fit([replace(past, ok=past.ok & ~piece.ok)], card, timing, past.vane, _RIDGE) for piece in pieces]
    winds = [w for _, (w,) in left]
    cases = [Case(piece, without) for piece, (without, _) in zip(pieces, left, strict=True)]
    base = replace(base, others=_doubts(flight, past, base, weather), r2=_foretold(cases, winds))
    if shown is not None:
        veiled = [replace(before(shown, until), ok=piece.ok) for piece in pieces]
        cases = [Case(piece, case.base) for piece, case in zip(veiled, cases, strict=True)]
    base = settled(base, cases, winds, say, level=True)
    later = since(flight, until).seconds
    base = silenced(base, [name for name, share in base.r2.items() if share < _WORSE])
    here = Case(past, base)
    return replace(
        base,
        noise=_without_baro(base.noise),
        spread=base.spread | _biases(here, weather) | _weather(here, weather),
        chance=_chance(base, max(later, past.seconds) * len(pieces) / past.seconds),
    )


def before(flight: Flight, until: float) -> Flight:
    """Return the part of a flight before `until` [s, on its own clock]."""
    return _part(flight, slice(0, int(np.searchsorted(flight.t, until))))


def since(flight: Flight, start: float) -> Flight:
    """Return the part of a flight from `start` on [s, on its own clock]."""
    return _part(flight, slice(int(np.searchsorted(flight.t, start)), None))


def _part(flight: Flight, rows: slice) -> Flight:
    readings = {name: x[rows] for name, x in flight.readings.items()}
    t, commands, place, ok = (x[rows] for x in (flight.t, flight.commands, flight.place, flight.ok))
    return replace(flight, t=t, readings=readings, commands=commands, place=place, ok=ok)


def split(past: Flight, pieces: int = PIECES) -> list[Flight]:
    """Split the past into pieces of equal valid length, with disjoint valid rows."""
    edges = np.quantile(past.t[past.ok], np.linspace(0.0, 1.0, pieces + 1)[1:-1])
    which = np.searchsorted(edges, past.t, side="right")
    return [replace(past, ok=past.ok & (which == k)) for k in range(pieces)]


def _rows(cases: list[Case], made: list[Terms]) -> dict[str, Rows]:
    """Return the regression data of every separately fitted equation."""
    coef = cases[0].base.coef
    out = {name: Rows(cases, made, name) for name in ("alpha", "beta", "L", "N")}
    return out | {"X": axial(cases, made), "M": pitch(cases, made, coef)}


def _joined(coef: dict[str, np.ndarray], name: str) -> np.ndarray:
    return np.concatenate([coef["X"], coef["T"]]) if name == "X" else coef[name]


def _foretold(cases: list[Case], winds: list[np.ndarray]) -> dict[str, float]:
    """Return the share of variance of every equation that the other pieces predict."""
    missed: dict[str, list[np.ndarray]] = {}
    told: dict[str, list[np.ndarray]] = {}
    for case, w in zip(cases, winds, strict=True):
        for name, rows in _rows([case], [case.terms(wind(w))]).items():
            for kept, x in ((missed, rows.told(_joined(case.base.coef, name))), (told, rows.y[rows.ok])):
                kept.setdefault(name, []).append(x - x.mean())  # trim may differ
    sums = {name: [float((np.concatenate(kept[name]) ** 2).sum()) for kept in (missed, told)] for name in missed}
    return {name: 1.0 - left / max(whole, 1e-12) for name, (left, whole) in sums.items()}


def _doubts(flight: Flight, past: Flight, base: Baseline, weather: np.ndarray) -> tuple[dict[str, np.ndarray], ...]:
    """Return the uncertain coefficient directions that the flight excites, one standard deviation each.

    The posterior covariance of the coefficients of each equation, under a prior in which each term alone may explain
    all variance, in the principal axes of its effect on the whole flight.
    Source: Klein & Morelli 2006, section 5.1 (Bayesian estimation); Golub & Van Loan 2013, section 8.7.
    """
    here, whole = Case(past, base), Case(flight, base)
    known, used = (_rows([case], [case.terms(wind(weather))]) for case in (here, whole))
    out = []
    for name, rows in known.items():
        x = _joined(base.coef, name)
        white = rows.whitener(x)
        A, e = white(rows.A)[rows.whole], white(rows.y - rows.A @ x)[rows.whole]
        widest = np.sqrt((rows.y[rows.ok] ** 2).mean() / ((rows.A[rows.ok] ** 2).mean(axis=0) + 1e-12))
        precision = A.T @ A / (_FADED * e.var()) + np.diag(widest**-2.0)
        root = np.linalg.cholesky(np.linalg.inv(precision))
        B = used[name].A[used[name].ok] @ root
        felt, turned = np.linalg.eigh(B.T @ B / len(B))
        kept = np.sqrt(np.maximum(felt, 0.0)) > _SHOWS * rows.told(x).std()
        out += [_direction(base, name, d) for d in (root @ turned[:, kept]).T]
    return tuple(out)


def _direction(base: Baseline, name: str, d: np.ndarray) -> dict[str, np.ndarray]:
    out = {equation: np.zeros_like(x) for equation, x in base.coef.items()}
    if name == "X":
        return out | {"X": d[: len(eq.X)], "T": d[len(eq.X) :]}
    return out | {name: d}


def _without_baro(noise: Noise) -> Noise:
    """Return noise that ignores the barometer: it drifts over minutes, and the pieces of the past are too short."""
    return Noise(noise.ar, np.where(np.arange(len(CHANNELS)) == CHANNELS.index("baro"), DEAF, noise.sigma))


def _biases(case: Case, weather: np.ndarray) -> dict[str, float]:
    """Return spreads of at least twice the sensor biases in the past, so that they are no finding later."""
    sight = Sight(case, wind(weather))
    floors = np.array([n.floor for n in sight.nuisances])
    sensors = np.array([n.effect.stage is Stage.SENSOR for n in sight.nuisances])
    k = len(floors)
    precision = sight.precision.copy()
    precision[:k] = np.where(sensors, (_ANY_BIAS * floors) ** -2.0, precision[:k])
    x = np.linalg.solve(sight.Ann - np.diag(sight.precision) + np.diag(precision), sight.bn)[:k]
    told = zip(sight.nuisances, x, sensors, strict=True)
    return {n.name: max(case.base.spread[n.name], 2.0 * abs(float(bias))) for n, bias, sensor in told if sensor}


def _weather(case: Case, weather: np.ndarray) -> dict[str, float]:
    """Return spreads of wind and airspeed scale, which a past with few headings does not determine.

    Airspeed over the headings and heights of the past determines scale, wind and wind shear jointly.
    """
    s, flow = case.sensed(()), case.terms(wind(weather)).flow
    along = np.array([s["v_n"], s["v_e"]]) / np.maximum(np.hypot(s["v_n"], s["v_e"]), 1.0)
    H = np.stack([flow.Va, *along, *(along * flow.height / 100.0)], axis=1)[case.ok]
    e = case.residuals(wind(weather))[case.ok, CHANNELS.index("airspeed")]
    precision = H.T @ H / (CORRELATED * max(e.var(), _AIRSPEED**2)) + np.diag(np.array(_PRIOR) ** -2.0)
    scale = float(np.sqrt(np.linalg.inv(precision)[0, 0]))
    out = {"airspeed_scale:log_scale": max(scale, case.base.spread["airspeed_scale:log_scale"])}
    for axis in ("w_n", "w_e"):
        out[f"wind_steady:{axis}"] = max(_WIND, case.base.spread[f"wind_steady:{axis}"])
    return out


def _chance(base: Baseline, longer: float) -> dict[str, float]:
    """Return the chance gains for the rest of the flight, `duration_ratio` times longer than a piece.

    A permanent effect was active in the past and is part of the baseline: its gain is unreachable.
    """
    out = {kind: max(_LEAST_GAIN, longer * gain) for kind, gain in base.chance.items()}
    for effect in catalogue().values():
        for of in effect.of or ("",):
            label = f"{effect.name}:{of}" if of else effect.name
            for onset in effect.onsets:
                out.setdefault(f"{label}|{onset}", _LEAST_GAIN)
                if onset is Onset.ALWAYS:
                    out[f"{label}|{onset}"] = NEVER
    return out
