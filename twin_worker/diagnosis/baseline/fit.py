"""Fit the coefficients of the baseline to nominal flights, jointly with the wind of each flight."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from twin_worker.diagnosis.data.card import Card
from twin_worker.diagnosis.data.flight import Flight
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.baseline import Baseline, Timing
from twin_worker.diagnosis.model.residual import RHO_0, Case, Terms
from twin_worker.diagnosis.model.weather import CORRELATED, fit_wind, scale, wind
from twin_worker.numerics.ridge_regression import ridge

RIDGE = 3e-4  # ridge weight, as a share of the regressor norm
_ORDER = 3  # order of the residual autoregression
_WHITENINGS = {True: 2, False: 1}  # rounds with and without fast accelerometer, where terms are noisier
_ROUNDS = 2
_FADED = 4.0  # whitened rows per independent sample: whitening is incomplete
_LAGS = (0.0, 0.03, 0.06, 0.1, 0.14, 0.18, 0.22, 0.28, 0.35)  # [s]
_DELAYS = (0.0, 0.02, 0.04, 0.06)  # [s]
_ENGINES = {  # by fast accelerometer; electric motors respond in 0.1 s, piston engines in seconds [s]
    True: (0.1, 0.14, 0.19, 0.27, 0.37, 0.51, 0.71, 0.98, 1.36, 1.88, 2.6, 3.61, 5.0),
    False: (0.1, 0.25, 0.5),
}


def fit(
    flights: Sequence[Flight], card: Card, timing: Timing, vane: bool, pull: float = RIDGE
) -> tuple[Baseline, list[np.ndarray]]:
    """Fit every equation and the weather of each flight, (4,); short data need a larger `ridge_share`.

    Raises:
        ValueError: if the flights do not excite an equation at all.
    """
    speed = float(np.median(np.concatenate([np.hypot(f.readings["v_n"], f.readings["v_e"])[f.ok] for f in flights])))
    base = Baseline(card, {}, speed, timing=timing, vane=vane, flights=tuple(f.name for f in flights))
    winds = [np.zeros(4) for _ in flights]
    base = replace(base, airspeed=scale([Case(flight, base) for flight in flights]))
    cases = [Case(flight, base) for flight in flights]
    for _ in range(_ROUNDS):
        winds = [fit_wind(case, w) for case, w in zip(cases, winds, strict=True)]
        made = [case.terms(wind(w)) for case, w in zip(cases, winds, strict=True)]
        base = replace(base, airspeed=_airspeed(cases, made))
        alpha = _solve(Rows(cases, made, "alpha", pull), 0)[0]
        base = replace(base, coef={"alpha": alpha, "beta": _side(Rows(cases, made, "beta", pull), made, vane)})
        cases = _with(cases, base)
        base = _moments(cases, [case.terms(wind(w)) for case, w in zip(cases, winds, strict=True)], base, pull)
        cases = _with(cases, base)
    return base, winds


def _with(cases: list[Case], base: Baseline) -> list[Case]:
    return [Case(case.flight, base, like=case) for case in cases]


def _moments(cases: list[Case], made: list[Terms], base: Baseline, pull: float) -> Baseline:
    """Fit forces and moments for known flow angles."""
    coef, r2 = dict(base.coef), {}
    both, r2["X"] = _solve(axial(cases, made, pull), 0)
    coef["X"], coef["T"] = both[: len(eq.X)], both[len(eq.X) :]
    coef["M"], r2["M"] = _solve(pitch(cases, made, coef, pull))
    for name in ("L", "N"):
        coef[name], r2[name] = _solve(Rows(cases, made, name, pull))
    for name in ("alpha", "beta"):
        rows = Rows(cases, made, name)
        r2[name] = _r2(rows.A[rows.ok] @ coef[name], rows.y[rows.ok])
    return replace(base, coef=coef, r2=r2)


def _side(rows: "Rows", made: list[Terms], vane: bool) -> np.ndarray:
    """Fit the sideslip equation; with a fast accelerometer, regress side force on sideslip and invert.

    Sideslip over the ground lacks the gusts in the side force: a regression on the force would be biased to zero.
    A side force derived from the velocity is itself noisy: there sideslip is regressed on the force.
    """
    if not vane:
        return _solve(rows, 0)[0]
    force = rows.A[:, 1].copy()
    rows.A[:, 1] = np.concatenate([m.measured["beta"] for m in made])
    rows.y = force
    c = _solve(rows)[0]
    return np.array([-c[0], 1.0, *(-c[2:])]) / c[1]


class Rows:
    """Regression data of one equation over all flights: dimensional regressors (n, k), measured side (n,), masks."""

    def __init__(
        self,
        cases: list[Case],
        made: list[Terms],
        name: str,
        pull: float = RIDGE,
        more: Callable[[Terms], np.ndarray] | None = None,
    ) -> None:
        self.pull = pull
        A, y, ok, whole = [], [], [], []
        for case, m in zip(cases, made, strict=True):
            rows = m.terms[name] * m.scale.get(name, 1.0)
            A.append((rows if more is None else np.concatenate([rows, more(m)])).T)
            y.append(m.measured[name])
            ok.append(case.ok)
            good = case.ok.copy()
            for k in range(1, _ORDER + 1):
                good[k:] &= case.ok[:-k]
            good[:_ORDER] = False
            whole.append(good)
        self.A, self.y = np.concatenate(A), np.concatenate(y)
        self.vane = cases[0].base.vane
        known = cases[0].base.card.known and self.vane
        self.usual = np.array(eq.USUAL[name] if known and name in eq.USUAL else [np.inf] * self.A.shape[1])
        self.ok, self.whole = np.concatenate(ok), np.concatenate(whole)

    def told(self, x: np.ndarray) -> np.ndarray:
        """Return measured less simulated on valid rows, (m,)."""
        return (self.y - self.A @ x)[self.ok]

    def whitener(self, x: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Return the autoregressive filter that whitens the residuals of these coefficients."""
        e = self.y - self.A @ x
        lags = np.stack([np.roll(e, k) for k in range(1, _ORDER + 1)], axis=1)
        ar = np.linalg.lstsq(lags[self.whole], e[self.whole], rcond=None)[0]
        return lambda z: z - sum(a * np.roll(z, k + 1, axis=0) for k, a in enumerate(ar))


def _solve(rows: Rows, whitenings: int | None = None) -> tuple[np.ndarray, float]:
    """Solve by generalised least squares; return coefficients and the share of variance explained.

    Residuals in gusts under feedback control are coloured, and ordinary least squares biases the derivatives to zero.
    The autoregression of the residuals therefore filters both sides.
    Source: Clarke 1967 (generalised least squares); Klein & Morelli 2006, section 5.2.
    """
    x = _held(rows.A[rows.ok], rows.y[rows.ok], rows, CORRELATED)
    r2 = _r2(rows.A[rows.ok] @ x, rows.y[rows.ok])
    for _ in range(_WHITENINGS[rows.vane] if whitenings is None else whitenings):
        white = rows.whitener(x)
        x = _held(white(rows.A)[rows.whole], white(rows.y)[rows.whole], rows, _FADED)
    return x, r2


def _surprise(rows: Rows) -> float:
    """Return the logarithm of the innovations' variance after the fit."""
    x, _ = _solve(rows, 1)
    return float(np.log(np.var(rows.whitener(x)(rows.y - rows.A @ x)[rows.whole])))


def _r2(fitted: np.ndarray, y: np.ndarray) -> float:
    return float(1.0 - ((y - fitted) ** 2).sum() / max(((y - y.mean()) ** 2).sum(), 1e-12))


def _held(A: np.ndarray, y: np.ndarray, of: Rows, as_one: float) -> np.ndarray:
    """Solve by least squares with a ridge and the prior `data.prior_std` of the coefficients.

    `rows_per_sample` residual rows count as one independent sample.
    """
    x = ridge(A, y, of.pull)
    noise = np.sqrt(as_one * np.mean((y - A @ x) ** 2))
    length = np.linalg.norm(A, axis=0) + 1e-12
    return ridge(A, y, np.maximum(of.pull, noise / (of.usual * length)))


def loose(cases: list[Case], winds: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Return the joint uncertainty of the drag coefficients that flight data do not separate: one standard deviation.

    The elevator coefficient, limited by its prior, changes by its standard deviation; correlated coefficients follow.
    """
    coef = cases[0].base.coef
    rows = axial(cases, [case.terms(wind(w)) for case, w in zip(cases, winds, strict=True)])
    A, k = rows.A[rows.ok], eq.X.index("delta_e")
    noise = CORRELATED * np.mean(rows.told(np.concatenate([coef["X"], coef["T"]])) ** 2)
    pull = rows.pull * np.linalg.norm(A, axis=0)
    doubt = np.linalg.inv((A.T @ A + np.diag(pull**2)) / noise + np.diag(rows.usual**-2.0))
    change = doubt[:, k] / np.sqrt(doubt[k, k])
    still = {name: np.zeros_like(x) for name, x in coef.items()}
    return {**still, "X": change[: len(eq.X)], "T": change[len(eq.X) :]}


def _airspeed(cases: list[Case], made: list[Terms]) -> float:
    """Fit the ratio of reported to indicated airspeed."""
    if any("Va" not in case.flight.readings for case in cases):
        return 1.0
    rows = zip(cases, made, strict=True)
    x, y = np.concatenate(
        [np.stack([m.flow.Va * np.sqrt(m.flow.rho / RHO_0), m.measured["airspeed"]])[:, c.ok] for c, m in rows], axis=1
    )
    return float((x @ y) / (x @ x))


def fit_timing(flights: Sequence[Flight], card: Card, vane: bool) -> Timing:
    """Fit the lags and the delay with the least innovation variance, lag and delay of the servos jointly.

    Pitch and yaw determine the servos: in roll, damping and lag are not separable within the band. Axial force
    determines the engine.
    """
    best = Timing()
    base, winds = fit(flights, card, best, vane)
    cases = [Case(flight, base) for flight in flights]

    def left(timing: Timing) -> dict[str, float]:
        """Return the log innovation variance of pitch and yaw (servo) and of axial force (engine)."""
        timed = _with(cases, replace(base, timing=timing))
        made = [case.terms(wind(w)) for case, w in zip(timed, winds, strict=True)]
        along = axial(timed, made)
        coef = {"T": _solve(along, 0)[0][len(eq.X) :]}
        yaw = Rows(timed, made, "N")
        return {"servo": _surprise(pitch(timed, made, coef)) + _surprise(yaw), "engine": _surprise(along)}

    # lag and delay are strongly correlated: a search in turn would miss the best pair
    pairs = [replace(best, servo=servo, delay=delay) for servo in _LAGS for delay in _DELAYS]
    best = min(pairs, key=lambda timing: left(timing)["servo"])
    engines = [replace(best, engine=engine) for engine in _ENGINES[vane]]
    return min(engines, key=lambda timing: left(timing)["engine"])


def pitch(cases: list[Case], made: list[Terms], coef: dict[str, np.ndarray], pull: float = RIDGE) -> Rows:
    """Return the regression data of the pitching moment, with the moment of thrust as a term."""
    return Rows(cases, made, "M", pull, more=lambda m: (coef["T"] @ m.terms["T"])[None])


def axial(cases: list[Case], made: list[Terms], pull: float = RIDGE) -> Rows:
    """Return the regression data of axial force, drag terms before thrust terms."""
    return Rows(cases, made, "X", pull, more=lambda m: m.terms["T"])
