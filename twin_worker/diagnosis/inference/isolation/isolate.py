"""Scan all effects, targets and onsets; one whitened Jacobian per effect and target serves all onsets."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fleet.effects import Effect, Onset, catalogue
from twin_worker.diagnosis.data.fault_hypothesis import ALWAYS, Guess, When
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.model.baseline import Baseline

PRICE = 9.0  # gain that each parameter must add [-]
WELL = 0.6  # share of variance explained from which an equation counts as calibrated
_SURFACE = {"aileron": "L", "elevator": "M", "rudder": "N"}
_SHOWS_IN = {"roll": "L", "pitch": "M", "yaw": "N", "thrust": "X", "drag": "X", "lift": "alpha"}
_EDGE_S = 15.0, 20.0  # no onset closer to the start and the end of the flight [s]
_EVERY = 5  # rows between two tested onsets, unless the onset is resolved to the row
_RAMPS_S = (20.0, 40.0, 60.0, 90.0, 130.0)
_BUMPS_S = (3.0, 5.0, 8.0, 14.0, 25.0, 45.0)


@dataclass(frozen=True)
class Found:
    """A hypothesis and its gain: decrease of the whitened sum of squares."""

    gain: float
    guess: Guess

    @property
    def kind(self) -> str:
        """Return `label|onset kind`, the key of `Baseline.chance`."""
        return f"{self.guess.label}|{self.guess.when.kind}"

    @property
    def worth(self) -> float:
        """Return the gain less the cost of its parameters."""
        return self.gain - PRICE * self.guess.size


def scan(sight: Sight) -> list[Found]:
    """Return the best hypothesis of every effect, target and kind of onset, best first."""
    out = []
    for effect, of in candidates(sight):
        out += _by_start(sight, effect, of) if effect.starts else _by_slope(sight, effect, of)
    return sorted(out, key=lambda found: -found.worth)


def candidates(sight: Sight) -> Iterator[tuple[Effect, str]]:
    """Yield every effect and target that the calibration covers, except effects on the variance alone."""
    for effect in catalogue().values():
        if not effect.variance:
            for of in effect.of or ("",):
                if covered(sight.base, effect, of):
                    yield effect, of


def covered(base: Baseline, effect: Effect, of: str) -> bool:
    """Return whether the equation that an effect acts on is sufficiently calibrated."""
    if effect.channel in ("gyro", "imu"):
        return base.vane  # an estimator's rates and velocity no longer contain the fault
    equation = _SURFACE.get(of) or _SHOWS_IN.get(effect.channel)
    return equation is None or base.r2.get(equation, 1.0) > WELL


def _by_slope(sight: Sight, effect: Effect, of: str) -> list[Found]:
    step = np.array([p.step for p in effect.parameters])
    nothing = Guess(effect, of, (0.0,) * effect.size)
    plain = sight.plain_slopes(nothing, step)
    J = sight.whole(plain)
    scale = np.sqrt((J**2).sum(axis=(0, 1)))
    if not (scale > 1e-9).all():
        return []
    J = J / scale
    sharp = (
        sight.base.vane and Onset.STEP in effect.onsets
    )  # a force derived from the velocity does not resolve the first rows
    jumps = sight.begun(plain) / scale if sharp else None
    out = []
    for kind in effect.onsets:
        gates, whens = gates_of(sight.case.t, kind, 1 if sharp else _EVERY)
        if not len(gates):
            continue
        sums = normals(sight, J, gates, kind)
        if kind is Onset.STEP and jumps is not None:
            sums = _begun(sight, J, jumps, gates, sums)
        gain, x = solved(sight, *sums)
        best = int(np.argmax(gain))
        out.append(Found(float(gain[best]), nothing.at(x[best] / scale, whens[best])))
    return out


def gates_of(t: np.ndarray, kind: Onset, every: int = _EVERY) -> tuple[np.ndarray, list[When]]:
    """Return the gates (m, n) to test and their onset profiles; for steps, rows (m,), `stride` apart, replace gates."""
    first, last = t[0] + _EDGE_S[0], t[-1] - _EDGE_S[1]
    if kind is Onset.ALWAYS:
        return np.ones((1, len(t))), [ALWAYS]
    if kind is Onset.STEP:
        rows = np.flatnonzero((t > first) & (t < last))[::every]
        return rows, [When(kind, float(t[i])) for i in rows]
    lengths = _RAMPS_S if kind is Onset.RAMP else _BUMPS_S
    whens = []
    for T in lengths:
        apart = 10.0 if kind is Onset.RAMP else max(T / 6, 1.0)
        end = last - 10.0 if kind is Onset.RAMP else t[-1] - T
        whens += [When(kind, float(t0), T) for t0 in np.arange(t[0] + 5.0, end, apart)]
    return np.stack([when.gate(t) for when in whens]) if whens else np.empty((0, len(t))), whens


def normals(sight: Sight, J: np.ndarray, gates: np.ndarray, kind: Onset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum the normal equations of slopes J, (n, c, k), per onset: (m, k, k), (m, k), (m, k, nuisances)."""
    A = np.einsum("tci,tcj->tij", J, J)
    b = -np.einsum("tci,tc->ti", J, sight.e)
    C = np.einsum("tci,tcj->tij", J, sight.Jn)
    if kind is Onset.STEP:
        return tuple(np.cumsum(x[::-1], axis=0)[::-1][gates] for x in (A, b, C))  # type: ignore[return-value]
    flat = [x.reshape(len(x), -1) for x in (A, b, C)]
    sums = (gates**2 @ flat[0], gates @ flat[1], gates @ flat[2])
    return tuple(s.reshape(len(gates), *x.shape[1:]) for s, x in zip(sums, (A, b, C), strict=True))  # type: ignore[return-value]


def _begun(
    sight: Sight, J: np.ndarray, jumps: np.ndarray, rows: np.ndarray, sums: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Replace the first two rows after each step by `onset_slopes`, (2, n, c, k), which start from zero."""
    A, b, C = sums
    for late, jump in enumerate(jumps):
        at = rows + late
        new, old, e, Jn = jump[at], J[at], sight.e[at], sight.Jn[at]
        A = A + np.einsum("mci,mcj->mij", new, new) - np.einsum("mci,mcj->mij", old, old)
        b = b - np.einsum("mci,mc->mi", new - old, e)
        C = C + np.einsum("mci,mcj->mij", new - old, Jn)
    return A, b, C


def solved(sight: Sight, A: np.ndarray, b: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve for the gain (m,) and the parameters (m, k) of each onset, the nuisances free within their spread."""
    inverse = np.linalg.inv(sight.Ann)
    A = A - C @ inverse @ np.swapaxes(C, 1, 2)
    b = b - C @ (inverse @ sight.bn)
    k = A.shape[1]
    trace = np.einsum("mii->m", A)
    A = A + (1e-9 * trace + 1e-12)[:, None, None] * np.eye(k)
    x = np.linalg.solve(A, b[..., None])[..., 0]
    return (b * x).sum(axis=1), x


def _by_start(sight: Sight, effect: Effect, of: str) -> list[Found]:
    """Scan the start values of an effect without a slope at zero; a step gains the sum over the rows after it."""
    out: dict[Onset, Found] = {}
    before = (sight.e**2).sum(axis=1)
    t = sight.case.t
    rows = np.flatnonzero((t > t[0] + _EDGE_S[0]) & (t < t[-1] - _EDGE_S[1]))
    for start in effect.starts:
        guess = Guess(effect, of, start)
        gain = before - (sight.clipped((guess,)) ** 2).sum(axis=1)
        since = np.cumsum(gain[::-1])[::-1][rows]
        i = int(np.argmax(since))
        tried = {
            Onset.ALWAYS: Found(float(gain.sum()), guess),
            Onset.STEP: Found(float(since[i]), guess.at(np.array(start), When(Onset.STEP, float(t[rows[i]])))),
        }
        for kind, found in tried.items():
            if kind in effect.onsets and (kind not in out or found.gain > out[kind].gain):
                out[kind] = found
    return list(out.values())
